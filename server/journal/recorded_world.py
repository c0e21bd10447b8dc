"""A world with pens: they note every change for recordings (format: `server.journal.records`) and for a store."""

import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import product
from typing import Any, Protocol

import msgpack
import numpy as np

from server.journal.records import (
    FILL,
    HASH_TICKS,
    LOAD,
    MAGIC,
    NOTE,
    PUT,
    REBASE,
    REMOVE,
    UNLOAD,
    VERSION,
    WRITE,
    Call,
    JournalError,
    input_record,
    mark,
)
from shared import terrain
from shared.blocks import pack
from shared.checks import Cell, SceneError
from shared.inputs import Input
from shared.layout import ID, Int64s
from shared.scene import Scene
from shared.world import World
from shared.world_state import WorldState

FRESHENED_PER_TICK = 1
"""Digests of changed segments that are computed after each step, so that no later tick has to compute many at once."""


class Sink(Protocol):
    """The target of a recording: a binary file."""

    def write(self, data: bytes, /) -> object:
        """Writes all of `data`."""

    def flush(self) -> object:
        """Hands everything that was written to the system."""


class Saves(Protocol):
    """The store of a world as the game uses it (`server.persistence.store`)."""

    kept: Any
    """Result of the game's `keep()` for the loaded checkpoint; None for a new world."""
    trouble: str
    """Reason why nothing can be saved at the moment; empty: saving works. Commands are refused while there is one."""

    @property
    def notes(self) -> Sequence[tuple[int, Any]]:
        """Notes since the loaded checkpoint in order, each with the tick that followed it."""
        ...

    @property
    def durable_tick(self) -> int:
        """Newest tick that a crash cannot undo. Verdicts of commands up to this tick may be sent."""
        ...


class Observer:
    """The notes on one world: the calls since the last tick, and the inputs that differ from the last ones.

    Args:
        first: whether the first tick gets no mark, because states written before it may be among its changes without a
            call.
        hashed_max: number of entities up to which a tick gets a hash of the world (with 10,000 entities it takes 2 ms).
            Every tick gets a mark.
        stale_max: number of segments without a present digest up to which a tick gets a hash (40 us each).
    """

    def __init__(self, *, first: bool = True, hashed_max: float = math.inf, stale_max: float = math.inf) -> None:
        self.calls: list[Call] = []
        self._held: dict[int, Input] = {}
        self._first = first
        self._hashed_max, self._stale_max = hashed_max, stale_max

    def forget(self, entities: list[int]) -> None:
        """Forgets the latest inputs of entities, so that the next ones are recorded again."""
        for entity in entities:
            self._held.pop(entity, None)

    def touch(self, segment: Cell) -> None:
        """Is called before the blocks of a segment may change."""

    def tick(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        """Is called after each step of the world with the inputs of the step."""
        raise NotImplementedError

    def taken(self, world: WorldState, inputs: Mapping[int, Input]) -> list[Any]:
        """Makes the record of a tick: `[inputs, calls, mark]`, and the hash if one is due. Clears the calls."""
        calls, self.calls = self.calls, []
        held, aim = self._held, world.scene.aim
        changed: list[int] = []
        for entity, input_ in inputs.items():
            if held.get(entity) != input_:
                held[entity] = input_
                changed += input_record(entity, input_, aim=aim)
        first, self._first = self._first, False
        if world.turns is not None:
            self.forget([*world.turns.steered, *world.turns.vanished])
        parts: list[Any] = [changed, calls, None if first else mark(world)]
        due = world.tick % HASH_TICKS == 0 and len(world) <= self._hashed_max
        if first or (due and world.blocks.stale <= self._stale_max):
            parts.append(world.state_hash())
        return parts


class Pens:
    """The observer of a recorded world (`shared.world_changes.Observer`): it notes each change with all pens."""

    def __init__(self) -> None:
        self.all: tuple[Observer, ...] = ()

    def note(self, call: Call) -> None:
        """Adds a call to the calls before the coming tick."""
        for pen in self.all:
            pen.calls.append(call)

    def touching(self, low: Cell, high: Cell) -> None:
        if self.all:
            (x0, y0, z0), (x1, y1, z1) = low, high
            for z, y, x in product(range(z0, z1 + 1), range(y0, y1 + 1), range(x0, x1 + 1)):
                for pen in self.all:
                    pen.touch((x, y, z))

    def filled(self, low: Cell, high: Cell, kind: int, push: bool) -> None:
        self.note([FILL, *low, *high, kind, push])

    def loaded(self, world: WorldState, segment: Cell) -> None:
        if self.all:
            self.note([LOAD, *segment, packed(world, segment)])

    def unloaded(self, segment: Cell) -> None:
        self.note([UNLOAD, *segment])

    def wrote_blocks(self, segment: Cell, offsets: list[int], kinds: list[int]) -> None:
        self.note([WRITE, *segment, offsets, kinds])

    def put(self, states: Int64s) -> None:
        if self.all:
            self._forget(states[:, ID].tolist())
            self.note([PUT, *states.ravel().tolist()])

    def removed(self, entity: int) -> None:
        self._forget([entity])
        self.note([REMOVE, entity])

    def rebased(self, tick: int) -> None:
        self.note([REBASE, tick])

    def restoring(self) -> None:
        if self.all:
            raise JournalError("a world that is being recorded cannot become another; end the recording first")

    def stepped(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        world.blocks.freshen(FRESHENED_PER_TICK)
        for pen in self.all:
            pen.tick(world, inputs)

    def _forget(self, entities: list[int]) -> None:
        for pen in self.all:
            pen.forget(entities)


class RecordedWorld(World):
    """A world whose changes are noted with pens. Without any, a change costs one more call than in a `World`."""

    def __init__(self, scene: Scene, *, compiled: bool | None = None) -> None:
        super().__init__(scene, compiled=compiled)
        self.observer = self._pens = Pens()

    @property
    def recorded(self) -> bool:
        """Whether there is a pen."""
        return bool(self._pens.all)

    def attach(self, pen: Observer) -> None:
        """Adds a pen. It is notified of every change from now on."""
        self._pens.all = (*self._pens.all, pen)

    def detach(self, pen: Observer) -> None:
        """Removes a pen. Does nothing if it is not attached."""
        self._pens.all = tuple(each for each in self._pens.all if each is not pen)

    def record(self, file: Sink, failed: Callable[[OSError], None] | None = None) -> None:
        """Starts a recording. Writes the present state at once, and one record per tick from now on.

        Args:
            file: a file opened for writing bytes.
            failed: called with the error if the file cannot be written; the recording ends, and the world goes on.
                None: the error is raised instead.

        Raises:
            JournalError: the world is being recorded already.
        """
        if any(isinstance(pen, _FilePen) for pen in self._pens.all):
            raise JournalError("this world is being recorded already")
        pen = _FilePen(file, self, failed or _reraise)
        self.attach(pen)
        pen.begin()

    def end_recording(self) -> None:
        """Ends the recording with a hash. Then the file can be closed. Does nothing if there is no recording."""
        for pen in self._pens.all:
            if isinstance(pen, _FilePen):
                pen.end()
                self.detach(pen)

    def note(self, value: Any) -> None:
        """Records a value of the game that is not in the world, in order with the calls before the coming tick.

        Args:
            value: any MessagePack value; it is packed at once.

        Raises:
            TypeError, ValueError, OverflowError: MessagePack cannot encode the value.
        """
        if self._pens.all:
            self._pens.note([NOTE, msgpack.packb(value)])


class _FilePen(Observer):
    """A pen that writes a recording."""

    def __init__(self, file: Sink, world: RecordedWorld, failed: Callable[[OSError], None]) -> None:
        super().__init__()
        self._file, self._world, self._failed = file, world, failed
        self._chain = 0

    def begin(self) -> None:
        """Writes the present state of the world."""
        world = self._world
        segments = [[*index, packed(world, index)] for index in sorted(world.blocks)]
        states = world.states().astype("<i8").tobytes()
        head = MAGIC + struct.pack("<H", VERSION)
        self._chain = zlib.crc32(head)
        self._record([world.scene.to_table(), world.tick, world.next_id, states, segments], head)

    def tick(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        self._record(self.taken(world, inputs))

    def end(self) -> None:
        """Writes the last record, with a hash."""
        self._record([None, self.calls, None, self._world.state_hash()])

    def _record(self, parts: list[Any], head: bytes = b"") -> None:
        payload = msgpack.packb(parts)
        length = struct.pack("<I", len(payload))
        check = zlib.crc32(payload, self._chain)
        try:
            self._file.write(head + length + struct.pack("<II", zlib.crc32(length, self._chain), check) + payload)
            self._file.flush()
        except OSError as error:
            self._world.detach(self)
            self._failed(error)
        self._chain = check


def packed(world: WorldState, index: Cell) -> bytes | None:
    """Returns the packed blocks of a loaded segment; None if they are as generated."""
    if world.blocks.generated.get(index) == world.blocks.version(index):
        return None
    kinds = world.blocks.segment(index)
    with suppress(SceneError):
        if np.array_equal(terrain.generate(world.scene.terrain, index), kinds.reshape(-1)):
            return None
    return pack(kinds)


def _reraise(error: OSError) -> None:
    raise error
