"""Recordings: the format of their files, reading, and replay.

A recording has a world's start and all inputs and calls that changed it since. A replay ends in the same hashes.

file      8 bytes "\\x89SNJ\\r\\n\\x1a\\n"   u16 format version   records
record    u32 length   u32 check of the length   u32 check of the payload   payload (MessagePack)
          each check is the CRC-32 of its bytes, begun with the payload check of the record before
          (the first one: with the CRC-32 of the 10 bytes before it; in formats 1 and 2 with 0)
start     [scene, tick, next_id, states, segments]         the first record
          scene: its table   states: n * 12 int64, and the extra columns (`shared.extras`) of scenes that have any
          segments: [x, y, z, packed kinds or nil if as generated]
tick      [inputs, calls, mark] or, every 32 ticks, [inputs, calls, mark, hash]
          calls: in order, before the step   inputs: [id, move_x, move_y, buttons, id, ...] that differ from the
          previous ones; in a scene with aim, aim_x, aim_y and aim_z follow each buttons
          mark: CRC-32 of the states that the tick changed, with their extra columns (nil in the first tick, which has
          a hash)
          hash: 20 bytes, the world's after the step (16 in formats 1 and 2: `server.journal.former`)
end       [nil, calls, nil, hash]                           the last record, if the recording was ended

call      [PUT, all numbers of the states ...]   [REMOVE, id]   [FILL, x0, y0, z0, x1, y1, z1, kind, push]
          [LOAD, x, y, z, packed kinds or nil if as generated]   [UNLOAD, x, y, z]
          [WRITE, x, y, z, blocks, kinds]   [REBASE, tick]   [NOTE, packed value] (since format 2)

All numbers are little-endian. Each tick's record is handed to the system at once, so a process that is killed loses
nothing. An incomplete last record, as a crash of the machine leaves it, is ignored. Spawns, teleports and throws are
recorded by their results: whole states. A call that fails half-way and undoes itself is recorded, too, since it may
have woken entities. A note is a value of the game, which a replay passes over: it changes nothing in the world.
`server.journal.recorded_world` writes recordings.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgpack
import numpy as np

from server.journal import former
from shared import states, terrain
from shared.aim import NO_AIM
from shared.behaviours import Behaviour, BehaviourError
from shared.blocks import unpack
from shared.checks import SceneError
from shared.inputs import NEUTRAL, Input, checked_input
from shared.layout import FALLING, FLAGS, ID, Int64s
from shared.scene import Scene
from shared.states import STATES
from shared.world import World
from shared.world_state import WorldState

MAGIC = b"\x89SNJ\r\n\x1a\n"
"""First bytes of a recording."""
VERSION = 3
"""Newest version of the format."""
UNCHECKED_HEAD = 2
"""Newest version of the format in which no check covers the head of the file."""
HASH_TICKS = 32
"""Ticks between two hashes of the whole world."""
FRAME = struct.Struct("<III")
"""Format of the numbers before the payload of a record."""

PUT, REMOVE, FILL, LOAD, UNLOAD, WRITE, REBASE, NOTE = range(8)
Call = list[Any]


class JournalError(ValueError):
    """A file that this program cannot read as a recording. The message says where and why."""


class DivergedError(JournalError):
    """A replay that differs from the recording. `tick` is the first tick that differs."""

    def __init__(self, tick: int, reason: str) -> None:
        super().__init__(f"tick {tick}: {reason}")
        self.tick = tick


def mark(world: WorldState) -> int:
    """Returns a checksum of the entities that the latest step changed.

    It is cheap enough for every tick, so a replay finds the exact tick that differs.
    """
    rows = world.changed
    if world.extras.count:
        ids = {*rows[:, ID].tolist(), *(entity for entity in world.fields_set if entity in world)}
        return zlib.crc32(world.states_of(sorted(ids)).astype("<i8", copy=False).tobytes())
    states = rows[np.argsort(rows[:, ID]), :STATES]
    states[:, FLAGS] &= FALLING
    return zlib.crc32(states.astype("<i8", copy=False).tobytes())


class Moment(NamedTuple):
    """One tick of a replay: the world after the tick (always the same object), and its inputs and calls."""

    world: World
    inputs: dict[int, Input]
    """Inputs by entity that differ from the tick before."""
    calls: list[Call]
    """Calls before the step."""
    hashed: bool
    """Whether the whole world was compared, and not only the entities that the tick changed."""
    ended: bool
    """Whether this is not a tick, but the end of a recording that was ended regularly."""


class Recording:
    """A recording that is being read.

    Args:
        file: the file, opened for reading bytes.
        compiled: whether the kernel is compiled, as for `World`.
        behaviours: this program's classes of the behaviours of the recorded scene.

    Raises:
        JournalError: the file is not a recording, has a newer format, or is damaged.
        BehaviourError: a class of a behaviour is missing, or differs from the recorded one.
    """

    def __init__(
        self, file: BinaryIO, *, compiled: bool | None = None, behaviours: Iterable[type[Behaviour]] = ()
    ) -> None:
        self._file, self._behaviours = file, behaviours
        self._chain = 0
        self.torn = 0
        """Bytes of an incomplete last record, once the replay has reached it."""
        head = file.read(len(MAGIC) + 2)
        if head[: len(MAGIC)] != MAGIC[: len(head)] or not head:
            raise JournalError("not a recording: the first bytes are not those of one")
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
        except BehaviourError:
            raise
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise JournalError(f"its start state cannot be used ({error})") from error
        self.scene = self.world.scene
        """Scene of the recorded world."""

    def __iter__(self) -> Iterator[Moment]:
        """Replays the ticks and compares each with the recording.

        Raises:
            DivergedError: a tick differs from the recording.
            JournalError: the file is damaged.
        """
        while (record := self._read()) is not None:
            try:
                moment = redo(self.world, record)
            except (LookupError, TypeError, ValueError, OverflowError) as error:
                if isinstance(error, JournalError):
                    raise
                raise DivergedError(
                    self.world.tick + 1, f"a recorded input or call cannot be repeated ({error})"
                ) from error
            yield moment
            if moment.ended:
                if self._file.read(1):
                    raise self._damaged("there is more after the end")
                return

    def _start(self, record: list[Any], compiled: bool | None) -> World:
        table, tick, next_id, states, segments = record
        world = World(Scene.from_table(table).bound(self._behaviours), compiled=compiled)
        for x, y, z, packed in segments:
            apply(world, [LOAD, x, y, z, packed])
        world.write(checked_states(world.scene, np.frombuffer(states, "<i8").astype(np.int64)))
        world.next_id = next_id
        world.rebase(tick)
        return world

    def _read(self) -> list[Any] | None:
        """Returns the next record; None at the end, or if the last record is incomplete."""
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


def replay(
    path: str | Path, *, compiled: bool | None = None, behaviours: Iterable[type[Behaviour]] = ()
) -> Iterator[Moment]:
    """Replays a recording tick by tick and compares each tick with it.

    Args:
        path: the file.
        compiled: whether the kernel is compiled, as for `World`.
        behaviours: this program's classes of the behaviours of the recorded scene.

    Raises:
        DivergedError: a tick differs from the recording.
        JournalError: the file is not a recording, has a newer format, or is damaged.
        BehaviourError: a class of a behaviour is missing, or differs from the recorded one.
        OSError: the file cannot be read.
    """
    with Path(path).open("rb") as file:
        yield from Recording(file, compiled=compiled, behaviours=behaviours)


def redo(world: World, record: list[Any]) -> Moment:
    """Repeats one recorded tick in a world and compares the result.

    Raises:
        DivergedError: the tick differs from the recording.
        LookupError, TypeError, ValueError, OverflowError: the record is invalid.
    """
    inputs, calls, marked, *hashes = record
    for call in calls:
        apply(world, call)
    given: dict[int, Input] = {}
    if inputs is not None:
        given = recorded_inputs(inputs, aim=world.scene.aim)
        world.step(given)
        if marked is not None and mark(world) != marked:
            raise DivergedError(world.tick, "the entities that changed are not the recorded ones")
    if hashes and not has_hash(world, hashes[0]):
        raise DivergedError(world.tick, "the world is not the recorded one")
    return Moment(world, given, calls, bool(hashes), inputs is None)


def input_record(entity: int, input_: Input, *, aim: bool) -> list[int]:
    """Returns the numbers of one input in a record. A scene without aim has none of it in its records."""
    x, y, buttons, aimed = (*input_, NO_AIM)[:4]
    return [int(part) for part in (entity, x, y, buttons, *(aimed if aim else ()))]


def recorded_inputs(numbers: list[int], *, aim: bool) -> dict[int, Input]:
    """Returns the inputs of a record by entity: what `input_record` returned for each of them, in a row."""
    width = len(input_record(0, NEUTRAL, aim=aim))
    rows = [numbers[i : i + width] for i in range(0, len(numbers), width)]
    return {
        entity: checked_input((x, y, buttons, tuple(aimed) or NO_AIM), "input")
        for entity, x, y, buttons, *aimed in rows
    }


def has_hash(world: World, recorded: bytes) -> bool:
    """Returns whether a world has a recorded hash, of the present or the former kind."""
    return (former.state_hash(world) if len(recorded) == former.HASH_BYTES else world.state_hash()) == recorded


def checked_states(scene: Scene, numbers: Int64s) -> Int64s:
    """Checks states from a file and returns them, [n, 12]. The kernel does not check its rows, and files may be forged.

    Raises:
        ValueError: the numbers are not states, or are not possible in the scene.
    """
    try:
        rows = numbers.reshape(-1, STATES + scene.extras.count)
        return states.checked_states(rows, len(scene.templates), scene.extras)
    except SceneError as error:
        raise ValueError(f"a state is out of range ({error})") from error


def apply(world: World, call: Call) -> None:
    """Repeats a recorded call in a world.

    Raises:
        ValueError: there is no such call.
    """
    match call:
        case [int(op), *numbers] if op == PUT:
            world.write(checked_states(world.scene, np.array(numbers, np.int64)))
        case [int(op), entity] if op == REMOVE:
            world.remove(entity)
        case [int(op), x0, y0, z0, x1, y1, z1, kind, push] if op == FILL:
            with suppress(SceneError):  # it failed when it was recorded, too
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
