"""Checkpoints: copies a world at the end of a tick while the world goes on, and restores a world from such a copy."""

import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.journal import former
from server.journal.recorded_world import RecordedWorld
from server.journal.records import checked_states
from shared.blocks import DIGEST_BYTES, Kinds, digest_of, pack, unpack
from shared.checks import Cell
from shared.layout import FALLING, FLAGS, ID, Int64s
from shared.scene import Scene
from shared.states import STATES
from shared.world import World
from shared.world_state import hash_of

Segment = tuple[int, int, int, bytes | None]
"""Index of a loaded segment, and its packed blocks (None: as generated)."""


class Known(NamedTuple):
    """The state of a segment in a checkpoint: the version of its blocks in this process, and their digest."""

    version: int
    digest: bytes


Saved = Mapping[Cell, Known | None]
"""Segments of the last checkpoint; None: its content of the segment is not known."""


class Checkpoint(NamedTuple):
    """A whole world at the end of a tick, ready to be written."""

    tick: int
    next_id: int
    states: bytes
    """States of all entities with their extra columns, int64, little-endian, ascending by the entity's number."""
    hash: bytes
    """State hash of the world at that tick (`World.state_hash`)."""
    kept: bytes
    """State of the game beside its world, in MessagePack."""
    segments: list[Segment]
    """Segments that differ from the last checkpoint."""
    gone: list[Cell]
    """Segments that were loaded in the last checkpoint and no longer are."""


class Copy:
    """A copy of a world at one moment, whose blocks are copied piece by piece later.

    The data that the kernel changes are copied at once: the state of each entity. Of the segments only the
    versions are copied at once. `pieces` copies and packs the segments that were touched since the last checkpoint, one
    by one, in another thread. The world may go on meanwhile if it calls `touch` before every change of a segment, which
    copies that segment first.

    Args:
        world: the world, between two ticks.
        kept: state of the game beside its world, in MessagePack; it goes into the checkpoint unchanged.
    """

    def __init__(self, world: World, kept: bytes) -> None:
        blocks = world.blocks
        self.tick, self._next_id, self._kept = world.tick, world.next_id, kept
        self._entities = world.matrix[:, :STATES].copy()
        self._extra = world.extra_rows[: len(self._entities)].copy() if world.extras.count else None
        self._rows = dict(blocks.rows)
        self._versions = blocks.versions[: blocks.count].copy()
        self.saved: dict[Cell, Known | None] = {}
        """State of all segments in the checkpoint, complete when `pieces` is done."""
        self._blocks = blocks
        self._lock = threading.Lock()  # held while one segment is copied, about 5 us
        self._taken: dict[Cell, Kinds | None] = {}  # copied segments; None: already packed

    def touch(self, segment: Cell) -> None:
        """Copies a segment whose blocks are about to change, if that is needed."""
        with self._lock:
            if segment in self._rows and segment not in self._taken:
                self._taken[segment] = self._blocks.segment(segment).copy()

    def pieces(self, saved: Saved) -> Iterator[Checkpoint | None]:
        """Makes the checkpoint in pieces of about a millisecond. Yields None after each, and the checkpoint at last.

        Args:
            saved: the segments of the last checkpoint.
        """
        states = self._entities if self._extra is None else np.concatenate((self._entities, self._extra), axis=1)
        states = states[states[:, ID] != 0]
        states = states[np.argsort(states[:, ID])]
        states[:, FLAGS] &= FALLING
        yield None
        segments: list[Segment] = []
        for cell, row in self._rows.items():
            known, version = saved.get(cell), int(self._versions[row])
            if known is None or known.version != version:
                kinds = self._fetch(cell)
                known = Known(version, digest_of(kinds))
                segments.append((*cell, pack(kinds)))
                yield None
            self.saved[cell] = known
        checked = hash_of(self.tick, *_parts(self.saved), states)
        yield None
        gone = [cell for cell in saved if cell not in self.saved]
        packed = states.astype("<i8", copy=False).tobytes()
        yield Checkpoint(self.tick, self._next_id, packed, checked, self._kept, segments, gone)

    def _fetch(self, cell: Cell) -> Kinds:
        with self._lock:
            kinds = self._taken.get(cell)
            if kinds is None:
                kinds = self._blocks.segment(cell).copy()
            self._taken[cell] = None
        return kinds


def generated(
    scene: Scene, *, compiled: bool | None = None, terrain: World | None = None
) -> tuple[RecordedWorld, Checkpoint]:
    """Returns a new world of a scene with all its terrain, and its checkpoint. Arguments as for `Store`."""
    world = RecordedWorld(scene, compiled=compiled)
    if terrain is None:
        world.load_terrain()
    else:
        world.restore(terrain)
    segments: list[Segment] = [(*cell, None) for cell in world.blocks]
    return world, Checkpoint(world.tick, world.next_id, b"", world.state_hash(), NOTHING, segments, [])


def restored(
    scene: Scene, checkpoint: Checkpoint, *, compiled: bool | None = None, terrain: World | None = None
) -> RecordedWorld:
    """Restores the world of a checkpoint that has all segments. Arguments as for `Store`.

    Raises:
        ValueError: the hash of the result differs from the saved one.
    """
    world = RecordedWorld(scene, compiled=compiled)
    if terrain is not None:
        world.restore(terrain)
    as_generated = [(x, y, z) for x, y, z, packed in checkpoint.segments if packed is None]
    world.load_terrain(cell for cell in as_generated if cell not in world.blocks)
    loaded = {
        (x, y, z): world.blocks.segment((x, y, z)).reshape(-1) if packed is None else unpack(packed)
        for x, y, z, packed in checkpoint.segments
    }
    states = checked_states(scene, np.frombuffer(checkpoint.states, "<i8").astype(np.int64))
    if _hash(checkpoint, loaded, states) != checkpoint.hash:  # before the kernel gets them: it does not check its rows
        raise ValueError(f"the world of tick {checkpoint.tick} is not the one that was saved")
    for cell in [cell for cell in world.blocks if cell not in loaded]:
        world.unload_segment(cell)
    for x, y, z, packed in checkpoint.segments:
        if packed is not None:
            world.load_segment((x, y, z), loaded[x, y, z])
    world.write(states)
    world.next_id = checkpoint.next_id
    world.rebase(checkpoint.tick)
    return world


def saved_of(world: World) -> dict[Cell, Known | None]:
    """Returns the segments of a world that equals its checkpoint, as input for the next checkpoint."""
    blocks = world.blocks
    return {cell: Known(blocks.version(cell), blocks.digest(cell)) for cell in blocks}


def _hash(checkpoint: Checkpoint, loaded: Mapping[Cell, Kinds], states: Int64s) -> bytes:
    """Returns the hash of the content of a checkpoint, of the same kind (present or former) as its own hash."""
    cells = np.array(list(loaded), np.int64).reshape(-1, 3)
    if len(checkpoint.hash) == former.HASH_BYTES:
        return former.hash_of(checkpoint.tick, cells, list(loaded.values()), states)
    return hash_of(checkpoint.tick, cells, _digests(map(digest_of, loaded.values())), states)


def _parts(saved: Saved) -> tuple[Int64s, npt.NDArray[np.uint8]]:
    """Returns indices and digests of segments in the form that `hash_of` needs."""
    cells = np.array(list(saved), np.int64).reshape(-1, 3)
    return cells, _digests(known.digest for known in saved.values() if known is not None)


def _digests(digests: Iterable[bytes]) -> npt.NDArray[np.uint8]:
    return np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES)


NOTHING = b"\xc0"
"""Encoding of nil in MessagePack."""
