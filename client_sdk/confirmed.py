"""The server's world as of the newest snapshot, as far as this client sees it.

It is never stepped: what happens in it is told, and what goes on as it did goes on (`shared.snapshot`).
"""

from typing import Any

import numpy as np

from shared.bounds import bounds
from shared.checks import Cell
from shared.layout import FALLING, FLAGS, ID, Int64s, X
from shared.messages import ProtocolError, Snapshot
from shared.ring import Ring
from shared.scene import Scene
from shared.snapshot import ACTED, KEYFRAME, PLACED, SegmentPart, checksum, decode_parts
from shared.units import SEGMENT, TO_SEGMENT
from shared.world import World

NEAR_BLOCKS = 5.0
"""An edit this near may explain a correction."""


class Confirmed:
    """Is written by snapshots and terrain, for the client whose entity is `entity`."""

    def __init__(self, scene: Scene, entity: int, *, compiled: bool | None = None) -> None:
        self.entity = entity
        self.world = World(scene, compiled=compiled)
        self.states = self.world.states()
        """Those of the world, [n, 12], ascending by id. Not to be written to."""
        self.attributes: dict[int, dict[str, Any]] = {}
        """What the game's rules say of the entities that are seen."""
        self.terrain_changed = self.edited_near = False
        """Whether blocks have changed, and whether any near the own entity; whoever has seen to that takes it back."""
        self._templates = len(scene.templates)
        self.follow_max = bounds(scene.tick_rate).history  # after more ticks, everything is sent anew
        self._exist = frozenset(scene.segments())
        self.placed: Ring[frozenset[int]] = Ring(self.follow_max)
        """The entities that the server's rules placed before a snapshot and after the one before it, by its tick."""
        self._acted: set[int] = set()
        self._coming: Cell | None = None
        self._early: dict[int, int] = {}  # blocks of that one which changed since it was packed

    def expect_segment(self, segment: Cell) -> None:
        """The first piece of a segment has come: it was packed before any edit that comes from here on.

        Raises:
            ProtocolError: the scene has no such segment.
        """
        if segment not in self._exist:
            raise ProtocolError(f"Terrain: the scene has no segment {segment}")
        self._coming, self._early = segment, {}

    def load_segment(self, segment: Cell, kinds: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
        """The blocks of a segment have come."""
        self.world.load_segment(segment, kinds)
        if segment == self._coming:
            self.world.write_blocks(segment, self._early.keys(), self._early.values())
            self._coming = None
        self.terrain_changed = True

    def apply(self, snapshot: Snapshot) -> str:
        """Writes a snapshot into the confirmed world; what is wrong with the result, or nothing.

        Raises:
            ProtocolError: a part of it is malformed.
        """
        world = self.world
        parts, states, turns = decode_parts(snapshot.segments, self._templates, world.kernel)
        ticks = snapshot.tick - world.tick
        if len(turns) and ticks != 1:
            raise ProtocolError("segment.heads: the tick before was not told")
        drops: set[Cell] = set()
        if snapshot.drops:
            drops = {(x, y, z) for x, y, z in np.frombuffer(snapshot.drops, "<i4").reshape(-1, 3).tolist()}
        if drops or any(part.gone or part.ago == KEYFRAME for part in parts):
            self._take_away(parts, drops, set(states[:, ID].tolist()))
        if len(states):
            if max(states[:, FLAGS].tolist()) > FALLING:
                self._act(states, snapshot.tick)
            world.write(states)
        for part in parts:
            if len(part.edits):
                self._edit(part)
            if part.attributes:
                self.attributes.update((entity, said) for entity, said in part.attributes if entity in world)
        for segment in drops:
            if segment == self._coming:
                self._coming = None
            if segment in world.blocks and not len(world.in_segment(segment)):
                world.unload_segment(segment)
                self.terrain_changed = True
        there = world.follow(turns, min(ticks, self.follow_max), snapshot.tick)
        self.states = world.states()
        for part in parts:
            if part.check and part.segment in world.blocks and checksum(world, part.segment) != part.check:
                return f"segment {part.segment} is not the server's"
        return "" if there else "entities are missing"

    def grounded(self) -> bool:
        """Whether the blocks of every segment that exists around the own entity are there."""
        place = self.world.state(self.entity)[X : X + 3]
        x, y, z = (part >> TO_SEGMENT for part in place)
        around = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
        return all(segment in self.world.blocks for segment in around & self._exist)

    def take_acted(self) -> frozenset[int]:
        """The entities on which the server's rules have acted since the last call."""
        acted, self._acted = frozenset(self._acted), set()
        return acted

    def _act(self, states: Int64s, tick: int) -> None:
        """Takes the flags of the server's rules off the states of a snapshot."""
        flags, ids = states[:, FLAGS], states[:, ID]
        self._acted.update(ids[flags & ACTED != 0].tolist())
        self.placed.put(tick, frozenset(ids[flags & PLACED != 0].tolist()))
        flags &= FALLING

    def _edit(self, part: SegmentPart) -> None:
        """Blocks of a segment have changed."""
        changes = part.edits["block"].tolist(), part.edits["kind"].tolist()
        if part.segment in self.world.blocks:
            self.world.write_blocks(part.segment, *changes)
            self.terrain_changed = True
            self.edited_near |= self._near(part.segment, part.edits["block"].astype(np.int64))
        if part.segment == self._coming:
            self._early.update(zip(*changes, strict=True))

    def _near(self, segment: Cell, offsets: Int64s) -> bool:
        """Whether one of these blocks is so near to the own entity that it may have met it."""
        if self.entity not in self.world:
            return False
        inside = SEGMENT - 1
        blocks = (
            np.stack((offsets & inside, offsets >> 5 & inside, offsets >> 10), axis=1) + np.array(segment) * SEGMENT
        )
        ways = np.abs(blocks - np.array(self.world.position(self.entity)))
        return bool((ways.max(axis=1) < NEAR_BLOCKS).any())

    def _take_away(self, parts: list[SegmentPart], drops: set[Cell], here: set[int]) -> None:
        """Removes who is gone, or was in a segment that is not seen any more or sent whole, and is not `here`."""
        segments = (self.states[:, X : X + 3] >> TO_SEGMENT).tolist()
        whole = drops | {part.segment for part in parts if part.ago == KEYFRAME}
        gone = {(part.segment, entity) for part in parts for entity in part.gone}
        for entity, (x, y, z) in zip(self.states[:, ID].tolist(), segments, strict=True):
            home = (x, y, z)
            if entity not in here and (home in whole or (home, entity) in gone):
                self.world.remove(entity)
                self.attributes.pop(entity, None)
