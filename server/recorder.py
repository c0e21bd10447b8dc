"""A world whose changes go into a recording as they happen; its format is drawn in `server.journal`."""

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import msgpack
import numpy as np

from server.journal import (
    FILL,
    HASH_TICKS,
    LOAD,
    MAGIC,
    PUT,
    REBASE,
    REMOVE,
    UNLOAD,
    VERSION,
    WRITE,
    Call,
    JournalError,
    mark,
)
from shared import terrain
from shared.blocks import Kinds, digest_of, pack
from shared.checks import Cell, SceneError
from shared.inputs import Input
from shared.layout import ID, Int64s
from shared.world import STATES, OverlapError, World


class Sink(Protocol):
    """Where a recording goes: a binary file."""

    def write(self, data: bytes, /) -> object:
        """Takes all of `data`."""

    def flush(self) -> object:
        """Hands what was written to the system."""


class RecordedWorld(World):
    """A world that can be recorded. While it is not, a call costs one comparison more."""

    _writer: "_Writer | None" = None
    _inside = 0

    def record(self, file: Sink, failed: Callable[[OSError], None] | None = None) -> None:
        """Records from now on, into a file opened for writing bytes.

        Args:
            file: gets the start state at once, and one record per tick.
            failed: called with the error when the file can take no more; recording ends, the world goes on.

        Raises:
            JournalError: it is being recorded already.
        """
        if self._writer is not None:
            raise JournalError("this world is being recorded already")
        self._writer = _Writer(file, failed or _reraise)
        self._write(self._writer.begin)

    def end_recording(self) -> None:
        """Writes the last hash; the file can be closed. Does nothing if there is no recording."""
        if self._writer is not None:
            self._write(self._writer.end)
            self._writer = None

    # -- what changes a world --------------------------------------------------------------------------------

    def put(self, states: Iterable[tuple[int, ...]] | Int64s) -> None:
        if self._writer is not None and not self._inside:
            states = states if isinstance(states, np.ndarray) else list(states)
            rows = np.array(states, np.int64).reshape(-1, STATES)
            self._writer.forget(rows[:, ID].tolist())
            self._writer.calls.append([PUT, *rows.ravel().tolist()])
        super().put(states)

    def remove(self, entity: int) -> None:
        super().remove(entity)
        if self._writer is not None:
            self._writer.forget([entity])
            self._writer.calls.append([REMOVE, int(entity)])

    def fill(self, low: Cell, high: Cell, kind: int, *, push: bool = False) -> int:
        if self._writer is None:
            return super().fill(low, high, kind, push=push)
        call = [FILL, *map(int, low), *map(int, high), kind, push]
        self._inside += 1  # what it pushes is not a call of its own
        try:
            changed = super().fill(low, high, kind, push=push)
        except OverlapError:
            self._writer.calls.append(call)
            raise
        finally:
            self._inside -= 1
        self._writer.calls.append(call)
        return changed

    def load_segment(self, index: Cell, kinds: Kinds) -> None:
        super().load_segment(index, kinds)
        if self._writer is not None:
            self._writer.calls.append([LOAD, *index, _packed(self, index)])

    def unload_segment(self, index: Cell) -> None:
        super().unload_segment(index)
        if self._writer is not None:
            self._writer.calls.append([UNLOAD, *index])

    def write_blocks(self, segment: Cell, offsets: Iterable[int], kinds: Iterable[int]) -> None:
        offsets, kinds = list(offsets), list(kinds)
        super().write_blocks(segment, offsets, kinds)
        if self._writer is not None:
            self._writer.calls.append([WRITE, *segment, offsets, kinds])

    def rebase(self, tick: int) -> None:
        super().rebase(tick)
        if self._writer is not None:
            self._writer.calls.append([REBASE, tick])

    def restore(self, other: World) -> None:
        if self._writer is not None:
            raise JournalError("a world that is being recorded cannot become another: end the recording first")
        super().restore(other)

    def step(self, inputs: Mapping[int, Input] | None = None) -> None:
        super().step(inputs)
        if self._writer is not None:
            self._writer.inputs = inputs or {}
            self._write(self._writer.tick)

    def _write(self, part: Callable[[World], None]) -> None:
        writer = self._writer
        assert writer is not None
        try:
            part(self)
        except OSError as error:
            self._writer = None
            writer.failed(error)


class _Writer:
    """The pen: calls since the last tick, inputs that are held, and the file."""

    def __init__(self, file: Sink, failed: Callable[[OSError], None]) -> None:
        self.calls: list[Call] = []
        self.inputs: Mapping[int, Input] = {}
        self.failed = failed
        self._file = file
        self._held: dict[int, Input] = {}
        self._chain = 0
        self._first = True  # what was written ahead of the start is among its changes, and nobody knows

    def begin(self, world: World) -> None:
        """Writes the world as it is now."""
        segments = [[*index, _packed(world, index)] for index in sorted(world.blocks)]
        states = world.states().astype("<i8").tobytes()
        self._file.write(MAGIC + struct.pack("<H", VERSION))
        self._record([world.scene.to_table(), world.tick, world.next_id, states, segments])

    def forget(self, entities: list[int]) -> None:
        """The inputs of these entities are not known any more."""
        for entity in entities:
            self._held.pop(entity, None)

    def end(self, world: World) -> None:
        """Writes the end."""
        self._record([None, self.calls, None, world.state_hash()])

    def tick(self, world: World) -> None:
        """Writes a tick that has been stepped with `inputs`."""
        calls, self.calls = self.calls, []
        held = self._held
        news: list[int] = []
        for entity, wish in self.inputs.items():
            if held.get(entity) != wish:
                held[entity] = wish
                news += map(int, (entity, *wish))
        first, self._first = self._first, False
        parts: list[Any] = [news, calls, None if first else mark(world)]
        if first or world.tick % HASH_TICKS == 0:
            parts.append(world.state_hash())
        self._record(parts)

    def _record(self, parts: list[Any]) -> None:
        payload = msgpack.packb(parts)
        length = struct.pack("<I", len(payload))
        check = zlib.crc32(payload, self._chain)
        self._file.write(length + struct.pack("<II", zlib.crc32(length, self._chain), check) + payload)
        self._file.flush()
        self._chain = check


def _packed(world: World, index: Cell) -> bytes | None:
    """A loaded segment for the file; None if it is as the generator left it."""
    try:
        generated = digest_of(terrain.generate(world.scene.terrain, index))
    except SceneError:
        generated = -1
    return None if generated == world.blocks.digest(index) else pack(world.blocks.segment(index))


def _reraise(error: OSError) -> None:
    raise error
