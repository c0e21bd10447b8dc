"""A recording: the world at its start and every call that changed it since; a replay ends in the same hashes.

file      8 bytes "\\x89SNJ\\r\\n\\x1a\\n"   u16 format version   records
record    u32 length   u32 check of the length   u32 check of the payload   payload (MessagePack)
          each check is the CRC-32 of its bytes, begun with the payload check of the record before
          (the first one: with the CRC-32 of the 10 bytes ahead of it; in formats 1 and 2 with 0)
start     [scene, tick, next_id, states, segments]         the first record
          scene: its table   states: n * 12 int64   segments: [x, y, z, packed kinds or nil for as generated]
tick      [inputs, calls, mark] or, every 32 ticks, [inputs, calls, mark, hash]
          calls, in order, ahead of the step   inputs: [id, move_x, move_y, buttons, id, ...] that differ from the
          ones before   mark: CRC-32 of the states that the tick changed (nil in the first tick, which has a hash)
          hash: 20 bytes, the world's after the step (16 in formats 1 and 2: `server.journal.former`)
end       [nil, calls, nil, hash]                           the last record, if the recording was ended

call      [PUT, 12 numbers per state ...]   [REMOVE, id]   [FILL, x0, y0, z0, x1, y1, z1, kind, push]
          [LOAD, x, y, z, packed kinds or nil for as generated]   [UNLOAD, x, y, z]
          [WRITE, x, y, z, blocks, kinds]   [REBASE, tick]   [NOTE, packed value] (since format 2)

All numbers are little-endian. Each tick's record is handed to the system at once: a process that is killed loses
nothing, and what a crash of the machine leaves of the last record is ignored. Spawns, teleports and throws are
recorded as what they come to: whole states. A call that fails half-way and takes itself back is recorded too,
since it may have woken someone. A note is what the game wants told again: it changes nothing in the world. The
writing side is `server.journal.recorded_world`.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgpack
import numpy as np

from server.journal import former
from shared import states, terrain
from shared.blocks import unpack
from shared.checks import SceneError
from shared.inputs import Input
from shared.layout import FALLING, FLAGS, ID, Int64s
from shared.scene import Scene
from shared.states import STATES
from shared.world import World

MAGIC = b"\x89SNJ\r\n\x1a\n"
VERSION = 3
UNCHECKED_HEAD = 2
"""Up to this format no check is over the head of the file."""
HASH_TICKS = 32
"""A full hash so often, in ticks."""
FRAME = struct.Struct("<III")

PUT, REMOVE, FILL, LOAD, UNLOAD, WRITE, REBASE, NOTE = range(8)
Call = list[Any]


class JournalError(ValueError):
    """A file that is not a recording this program can read; the message says where and why."""


class DivergedError(JournalError):
    """A replay is not what was recorded; `tick` is the first that differs."""

    def __init__(self, tick: int, reason: str) -> None:
        super().__init__(f"tick {tick}: {reason}")
        self.tick = tick


def mark(world: World) -> int:
    """A check of the entities that the latest step changed: cheap, and names the very tick that differs."""
    rows = world.changed
    states = rows[np.argsort(rows[:, ID]), :STATES]
    states[:, FLAGS] &= FALLING
    return zlib.crc32(states.astype("<i8", copy=False).tobytes())


class Moment(NamedTuple):
    """One tick of a replay: the world (the same object throughout), after this tick, and what led to it."""

    world: World
    inputs: dict[int, Input]
    """Those that differ from the tick before."""
    calls: list[Call]
    """What was done ahead of the step."""
    hashed: bool
    """Whether the whole world has been compared, not just what the tick changed."""
    ended: bool
    """Whether this is not a tick, but the end of a recording that was ended on purpose."""


class Recording:
    """A recording that is being read.

    Args:
        file: opened for reading bytes.
        compiled: as for `World`.

    Raises:
        JournalError: not a recording, of a newer format, or damaged.
    """

    def __init__(self, file: BinaryIO, *, compiled: bool | None = None) -> None:
        self._file = file
        self._chain = 0
        self.torn = 0
        """Bytes of a last record that was never finished, once they have been reached."""
        head = file.read(len(MAGIC) + 2)
        if head[: len(MAGIC)] != MAGIC[: len(head)] or not head:
            raise JournalError("not a recording: it does not begin like one")
        if len(head) < len(MAGIC) + 2:
            raise JournalError("a recording that broke off before its start was written")
        (version,) = struct.unpack("<H", head[len(MAGIC) :])
        if not 1 <= version <= VERSION:
            raise JournalError(f"a recording in format {version}: this program reads formats up to {VERSION}")
        if version > UNCHECKED_HEAD:
            self._chain = zlib.crc32(head)
        start = self._read()
        if start is None:
            raise JournalError("a recording that broke off before its start was written")
        try:
            self.world = self._start(start, compiled)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise JournalError(f"its start state cannot be used ({error})") from error
        self.scene = self.world.scene
        """The rules under which it was recorded."""

    def __iter__(self) -> Iterator[Moment]:
        """Goes through the ticks, comparing every one with what was recorded.

        Raises:
            DivergedError: a tick came out otherwise.
            JournalError: the file is damaged.
        """
        while (record := self._read()) is not None:
            try:
                moment = redo(self.world, record)
            except (LookupError, TypeError, ValueError, OverflowError) as error:
                if isinstance(error, JournalError):
                    raise
                raise DivergedError(self.world.tick + 1, f"what was recorded cannot be done ({error})") from error
            yield moment
            if moment.ended:
                if self._file.read(1):
                    raise self._damaged("there is more after the end")
                return

    def _start(self, record: list[Any], compiled: bool | None) -> World:
        table, tick, next_id, states, segments = record
        world = World(Scene.from_table(table), compiled=compiled)
        for x, y, z, packed in segments:
            apply(world, [LOAD, x, y, z, packed])
        world.write(checked_states(world.scene, np.frombuffer(states, "<i8").astype(np.int64)))
        world.next_id = next_id
        world.rebase(tick)
        return world

    def _read(self) -> list[Any] | None:
        """The next record; None at the end, and where the rest is less than a record."""
        frame = self._file.read(FRAME.size)
        if len(frame) < FRAME.size:
            self.torn = len(frame)
            return None
        length, length_check, check = FRAME.unpack(frame)
        if zlib.crc32(frame[:4], self._chain) != length_check:
            raise self._damaged("the length of a record does not match its check")
        payload = self._file.read(length)
        if len(payload) < length:
            self.torn = len(frame) + len(payload)
            return None
        if zlib.crc32(payload, self._chain) != check:
            raise self._damaged("a record does not match its check")
        self._chain = check
        record: list[Any] = msgpack.unpackb(payload)
        return record

    def _damaged(self, reason: str) -> JournalError:
        after = f" (after tick {self.world.tick})" if hasattr(self, "world") else ""
        return JournalError(f"damaged before byte {self._file.tell()}{after}: {reason}")


def replay(path: str | Path, *, compiled: bool | None = None) -> Iterator[Moment]:
    """Replays a file tick by tick, comparing every one with what was recorded.

    Raises:
        DivergedError: a tick came out otherwise.
        JournalError: not a recording, of a newer format, or damaged.
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as file:
        yield from Recording(file, compiled=compiled)


def redo(world: World, record: list[Any]) -> Moment:
    """Does to a world what a record says, and compares.

    Raises:
        DivergedError: the tick came out otherwise.
        LookupError, TypeError, ValueError, OverflowError: this is not what a record says.
    """
    inputs, calls, marked, *hashes = record
    for call in calls:
        apply(world, call)
    news: dict[int, Input] = {}
    if inputs is not None:
        news = {inputs[i]: Input(*inputs[i + 1 : i + 4]) for i in range(0, len(inputs), 4)}
        world.step(news)
        if marked is not None and mark(world) != marked:
            raise DivergedError(world.tick, "the entities that changed are not the recorded ones")
    if hashes and not has_hash(world, hashes[0]):
        raise DivergedError(world.tick, "the world is not the recorded one")
    return Moment(world, news, calls, bool(hashes), inputs is None)


def has_hash(world: World, recorded: bytes) -> bool:
    """Whether a world has a recorded hash, of today's kind or of the former one."""
    return (former.state_hash(world) if len(recorded) == former.HASH_BYTES else world.state_hash()) == recorded


def checked_states(scene: Scene, numbers: Int64s) -> Int64s:
    """States from a file, [n, 12]: the kernel trusts its rows, and a file may be anybody's.

    Raises:
        ValueError: they are no states, or there is none like that in such a scene.
    """
    try:
        return states.checked_states(numbers.reshape(-1, STATES), len(scene.templates))
    except SceneError as error:
        raise ValueError(f"a state is out of range ({error})") from error


def apply(world: World, call: Call) -> None:
    """Does what a call did."""
    match call:
        case [int(op), *numbers] if op == PUT:
            world.write(checked_states(world.scene, np.array(numbers, np.int64)))
        case [int(op), entity] if op == REMOVE:
            world.remove(entity)
        case [int(op), x0, y0, z0, x1, y1, z1, kind, push] if op == FILL:
            with suppress(SceneError):  # as it went then
                world.fill((x0, y0, z0), (x1, y1, z1), kind, push=push)
        case [int(op), x, y, z, packed] if op == LOAD:
            cell = (x, y, z)
            kinds = terrain.generate(world.scene.terrain, cell) if packed is None else unpack(packed)
            world.load_segment(cell, kinds)
        case [int(op), x, y, z] if op == UNLOAD:
            world.unload_segment((x, y, z))
        case [int(op), x, y, z, offsets, kinds] if op == WRITE:
            world.write_blocks((x, y, z), offsets, kinds)
        case [int(op), tick] if op == REBASE:
            world.rebase(tick)
        case [int(op), bytes()] if op == NOTE:
            pass
        case _:
            raise ValueError(f"no such call: {call!r}"[:80])
