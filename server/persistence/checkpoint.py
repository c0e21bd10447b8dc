"""A world as it was at the end of a tick, taken while it goes on, and a world from what was taken."""

import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.journal import former
from server.journal.recorded_world import RecordedWorld
from server.journal.records import checked_states
from shared import terrain
from shared.blocks import DIGEST_BYTES, Kinds, digest_of, pack, unpack
from shared.checks import Cell
from shared.layout import FALLING, FLAGS, ID, Int64s
from shared.scene import Scene
from shared.states import STATES
from shared.world import World, hash_of

Segment = tuple[int, int, int, bytes | None]
"""Index of a loaded segment, and its packed blocks (None: as the generator makes them)."""


class Known(NamedTuple):
    """A segment as a checkpoint holds it: the version of its blocks in this process, and their digest."""

    version: int
    digest: bytes


Saved = Mapping[Cell, Known | None]
"""The segments of the checkpoint before; None: it is not known what it holds of that one."""


class Checkpoint(NamedTuple):
    """All of a world at the end of a tick, ready for the disk."""

    tick: int
    next_id: int
    states: bytes
    """n * 12 int64, little-endian, ascending by id."""
    hash: bytes
    """`World.state_hash` at that tick."""
    kept: bytes
    """What the game wanted kept, in MessagePack."""
    segments: list[Segment]
    """Those that are not as they were in the checkpoint before,"""
    gone: list[Cell]
    """and those that were loaded then and are not any more."""


class Copy:
    """Takes a world at this instant; the blocks follow piece by piece.

    What the kernel writes to is copied at once: a row of 128 bytes per entity. Of the segments only the versions are
    copied at once; `pieces` copies and packs those that were touched since the checkpoint before, one after the other,
    in another thread. The world may go on meanwhile if it calls `touch` ahead of every change: then that segment is
    copied just before.

    Args:
        world: between two ticks.
        kept: goes into the checkpoint as it is.
    """

    def __init__(self, world: World, kept: bytes) -> None:
        blocks = world.blocks
        self.tick, self._next_id, self._kept = world.tick, world.next_id, kept
        self._entities = world.matrix.copy()
        self._rows = dict(blocks.rows)
        self._versions = blocks.versions[: blocks.count].copy()
        self.saved: dict[Cell, Known | None] = {}
        """All segments as the checkpoint holds them, once `pieces` is done."""
        self._blocks = blocks
        self._lock = threading.Lock()  # held for the copying of one segment at most, some 5 us
        self._taken: dict[Cell, Kinds | None] = {}  # None: it has been fetched, nobody needs it any more

    def touch(self, segment: Cell) -> None:
        """The blocks of this segment are about to change."""
        with self._lock:
            if segment in self._rows and segment not in self._taken:
                self._taken[segment] = self._blocks.segment(segment).copy()

    def pieces(self, saved: Saved) -> Iterator[Checkpoint | None]:
        """Does the work in pieces of a millisecond or so; yields None after each, and the checkpoint in the end.

        Args:
            saved: the segments of the checkpoint before.
        """
        states = self._entities[:, :STATES]
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


def generated(scene: Scene, *, compiled: bool | None = None) -> tuple[RecordedWorld, Checkpoint]:
    """A new world of a scene with all its terrain, and its checkpoint."""
    world = RecordedWorld(scene, compiled=compiled)
    world.load_terrain()
    segments: list[Segment] = [(*cell, None) for cell in world.blocks]
    return world, Checkpoint(world.tick, world.next_id, b"", world.state_hash(), NOTHING, segments, [])


def restored(scene: Scene, checkpoint: Checkpoint, *, compiled: bool | None = None) -> RecordedWorld:
    """The world of a checkpoint that holds all segments.

    Raises:
        ValueError: what comes out is not what was saved.
    """
    loaded = {
        (x, y, z): terrain.generate(scene.terrain, (x, y, z)) if packed is None else unpack(packed)
        for x, y, z, packed in checkpoint.segments
    }
    states = checked_states(scene, np.frombuffer(checkpoint.states, "<i8").astype(np.int64))
    if _hash(checkpoint, loaded, states) != checkpoint.hash:  # ahead of the kernel: it trusts its rows
        raise ValueError(f"the world of tick {checkpoint.tick} is not the one that was saved")
    world = RecordedWorld(scene, compiled=compiled)
    for cell, kinds in loaded.items():
        world.load_segment(cell, kinds)
    world.write(states)
    world.next_id = checkpoint.next_id
    world.rebase(checkpoint.tick)
    return world


def saved_of(world: World) -> dict[Cell, Known | None]:
    """The segments of a world that is as its checkpoint, for the next one."""
    blocks = world.blocks
    return {cell: Known(blocks.version(cell), blocks.digest(cell)) for cell in blocks}


def _hash(checkpoint: Checkpoint, loaded: Mapping[Cell, Kinds], states: Int64s) -> bytes:
    """The hash of what a checkpoint holds, of the kind that it has."""
    cells = np.array(list(loaded), np.int64).reshape(-1, 3)
    if len(checkpoint.hash) == former.HASH_BYTES:
        return former.hash_of(checkpoint.tick, cells, list(loaded.values()), states)
    return hash_of(checkpoint.tick, cells, _digests(map(digest_of, loaded.values())), states)


def _parts(saved: Saved) -> tuple[Int64s, npt.NDArray[np.uint8]]:
    """Indices and digests of segments, as `hash_of` wants them."""
    cells = np.array(list(saved), np.int64).reshape(-1, 3)
    return cells, _digests(known.digest for known in saved.values() if known is not None)


def _digests(digests: Iterable[bytes]) -> npt.NDArray[np.uint8]:
    return np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES)


NOTHING = b"\xc0"
"""MessagePack's nil."""
