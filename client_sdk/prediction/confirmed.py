"""The confirmed world: the server's world as of the newest snapshot, as far as this client sees it.

Theory of operation. The confirmed world is never stepped. A snapshot contains states, turns, removed entities and
edits. States are written; turns are applied to entities that changed their motion in this tick; all other entities are
extrapolated by the rules in `shared.snapshot`. Checksums in the snapshots show if the result differs from the server's.
"""

from collections.abc import Iterable
from typing import Any

from shared.arrays import Uint8s
from shared.bounds import bounds
from shared.checks import Cell
from shared.layout import FALLING, FLAGS, ID, Int64s, X
from shared.messages import ProtocolError, Snapshot
from shared.ring import Ring
from shared.scene import Scene
from shared.snapshot import ACTED, DROP, KEYFRAME, PLACED, DecodedDelta, checksum, decode_parts
from shared.units import SEGMENT, TO_SEGMENT
from shared.world import World

NEAR_BLOCKS = 5.0
"""Distance in blocks from the own entity within which an edit may explain a correction."""


class Confirmed:
    """The confirmed world of the client whose entity is `entity`; snapshots and terrain write it."""

    def __init__(self, scene: Scene, entity: int, *, compiled: bool | None = None) -> None:
        self.entity = entity
        self.world = World(scene, compiled=compiled)
        self.states = self.world.states()
        """States of the world, [n, 12], ascending by id. Do not write to them."""
        self.attributes: dict[int, dict[str, Any]] = {}
        """Attributes of the entities that the client sees, by entity and name."""
        self.attribute_changes = 0
        """Number of times that attributes have changed."""
        self.terrain_changed = self.edited_near = False
        """Whether blocks have changed, and whether any near the own entity has, since the last replay (it resets
        both)."""
        self._templates = len(scene.templates)
        self.follow_max = bounds(scene.tick_rate).history  # after more ticks, the server sends everything again
        self._exist = frozenset(scene.segments())
        self.placed: Ring[frozenset[int]] = Ring(self.follow_max)
        """Entities that the server's rules placed since the snapshot before, by the tick of the snapshot."""
        self._acted: set[int] = set()
        self._coming: Cell | None = None  # the segment whose pieces are arriving
        self._early: dict[int, int] = {}  # blocks of that segment that changed since the server packed it

    def expect_segment(self, segment: Cell) -> None:
        """Takes the first piece of a segment, which the server packed before all edits that arrive from now on.

        Raises:
            ProtocolError: the scene has no such segment.
        """
        if segment not in self._exist:
            raise ProtocolError(f"Terrain: the scene has no segment {segment}")
        self._coming, self._early = segment, {}

    def load_segment(self, segment: Cell, kinds: Uint8s) -> None:
        """Takes the blocks of a whole segment, and applies the edits that arrived while it was being sent."""
        self.world.load_segment(segment, kinds)
        if segment == self._coming:
            self.world.write_blocks(segment, self._early.keys(), self._early.values())
            self._coming = None
        self.terrain_changed = True

    def apply(self, snapshot: Snapshot) -> str:
        """Writes a snapshot into the confirmed world.

        Returns:
            A text that names a difference from the server's world; empty if there is none.

        Raises:
            ProtocolError: a part of the snapshot is malformed.
        """
        world = self.world
        parts, states, turns = decode_parts(snapshot.segments, self._templates, world.kernel)
        ticks = snapshot.tick - world.tick
        if len(turns) and ticks != 1:
            raise ProtocolError("segment.turns: not allowed without a snapshot of the tick before")
        drops: set[Cell] = set()
        if snapshot.drops:
            drops = {(x, y, z) for x, y, z in DROP.iter_unpack(snapshot.drops)}
        if drops or any(part.gone or part.ago == KEYFRAME for part in parts):
            self._take_away(parts, drops, set(states[:, ID].tolist()))
        if len(states):
            if max(states[:, FLAGS].tolist()) > FALLING:
                self._act(states, snapshot.tick)
            world.write(states)
        there = True
        for part in parts:
            if part.fields:
                there &= world.write_fields(world.extras.decode(part.fields))
            if part.edits:
                self._edit(part)
            if part.attributes:
                self.attribute_changes += 1
                self.attributes.update((entity, values) for entity, values in part.attributes if entity in world)
        for segment in drops:
            if segment == self._coming:
                self._coming = None
            if segment in world.blocks and not len(world.in_segment(segment)):
                world.unload_segment(segment)
                self.terrain_changed = True
        there &= world.follow(turns, min(ticks, self.follow_max), snapshot.tick)
        self.states = world.states()
        for part in parts:
            if part.check and part.segment in world.blocks and checksum(world, part.segment) != part.check:
                return f"segment {part.segment} differs from the server's"
        return "" if there else "entities are missing"

    def grounded(self) -> bool:
        """Whether the blocks of all segments around the own entity have arrived, as far as the scene has them."""
        place = self.world.state(self.entity)[X : X + 3]
        x, y, z = (part >> TO_SEGMENT for part in place)
        around = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
        return all(segment in self.world.blocks for segment in around & self._exist)

    def take_acted(self) -> frozenset[int]:
        """Returns the entities on which the server's rules have acted since the last call."""
        acted, self._acted = frozenset(self._acted), set()
        return acted

    def _act(self, states: Int64s, tick: int) -> None:
        """Notes which entities the server's rules acted on or placed, and clears these flags in the states."""
        flags, ids = states[:, FLAGS], states[:, ID]
        self._acted.update(ids[flags & ACTED != 0].tolist())
        self.placed.put(tick, frozenset(ids[flags & PLACED != 0].tolist()))
        flags &= FALLING

    def _edit(self, part: DecodedDelta) -> None:
        """Writes the changed blocks of a segment."""
        offsets, kinds = zip(*part.edits, strict=True)
        if part.segment in self.world.blocks:
            self.world.write_blocks(part.segment, offsets, kinds)
            self.terrain_changed = True
            self.edited_near |= self._near(part.segment, offsets)
        if part.segment == self._coming:
            self._early.update(part.edits)

    def _near(self, segment: Cell, offsets: Iterable[int]) -> bool:
        """Returns whether one of these blocks is within `NEAR_BLOCKS` of the own entity, along every axis."""
        if self.entity not in self.world:
            return False
        inside = SEGMENT - 1
        x, y, z = (
            part * SEGMENT - place for part, place in zip(segment, self.world.position(self.entity), strict=True)
        )
        return any(
            abs(x + (at & inside)) < NEAR_BLOCKS
            and abs(y + (at >> 5 & inside)) < NEAR_BLOCKS
            and abs(z + (at >> 10)) < NEAR_BLOCKS
            for at in offsets
        )

    def _take_away(self, parts: list[DecodedDelta], drops: set[Cell], here: set[int]) -> None:
        """Removes entities that have left the client's view.

        Args:
            parts: segment deltas of the snapshot, which list entities that are gone, and may be keyframes.
            drops: segments that the client no longer sees.
            here: entities whose states the snapshot contains; these stay.
        """
        whole = drops | {part.segment for part in parts if part.ago == KEYFRAME}
        gone = {(part.segment, entity) for part in parts for entity in part.gone if entity not in here}
        if not (whole or gone):
            return
        segments = (self.states[:, X : X + 3] >> TO_SEGMENT).tolist()
        for entity, (x, y, z) in zip(self.states[:, ID].tolist(), segments, strict=True):
            home = (x, y, z)
            if entity not in here and (home in whole or (home, entity) in gone):
                self.world.forget(entity)
                self.attribute_changes += self.attributes.pop(entity, None) is not None
