"""Lag compensation: what a player saw when acting, answered by the server a moment later.

Theory of operation. A client draws everybody else a little in the past, between two ticks; by the time its shot is
here, they are elsewhere. So the last half second is kept (`Limits.rewind_s`), as what each tick has undone: for the
rows of the world's matrix that the tick changed, what they held before, and likewise the blocks. A `Past` starts from
the newest tick and takes those back, one after the other: that costs what has changed, and nothing for what sleeps.
Between two ticks it is computed in the same floats as `client_sdk.interpolation`, so a target is exactly where its
shooter drew it. Blocks are those of the tick before: what is edited in a tick is there when that tick is over.

What the rules do (place, remove, change, spawn) takes effect at the end of its tick: until then an entity that they
placed is where it was. A client that was not sent every tick draws between two ticks that are further apart: its *gaps*
say which, and the second of the two is when all that they did in between takes effect for it.
"""

import math
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from server.rewind.rays import Ray
from shared import layout
from shared.checks import Cell, Vec, finite, vector
from shared.layout import ID, TEMPLATE, Int64s, X
from shared.scene import Scene
from shared.units import BLOCK, SEGMENT_SHIFT
from shared.world import World

WINDOW_S = 0.5
"""How far back a query may go by default, in seconds."""
KEPT = [ID, TEMPLATE, X, X + 1, X + 2]
"""The columns that are kept of a row."""
MARGIN = 1e-3
"""Boxes are sorted out in floats with this much to spare, in blocks; what is left is decided exactly."""

Floats = npt.NDArray[np.float64]


class Hit(NamedTuple):
    """What a ray has met: an entity or a block (the other is None), how far away and where, in blocks."""

    entity: int | None
    block: Cell | None
    distance: float
    point: Vec


class _Undo(NamedTuple):
    """What a tick has changed, as it was before: rows of the matrix ([n, 6], each after its number), and blocks.

    `placed`: the entities that did not move there, but were placed.
    """

    rows: Int64s
    blocks: dict[Cell, int]
    placed: set[int]


class Rewind:
    """The recent past of one world. Record each tick once, after its step.

    Args:
        world: stepped elsewhere.
        window_s: how far back it goes, in seconds. It takes 48 bytes for each entity that a tick of it has changed.
    """

    def __init__(self, world: World, window_s: float = WINDOW_S) -> None:
        self._world = world
        self._reach = window_s * world.scene.tick_rate
        self._undo: deque[_Undo] = deque()
        self._placed_at = -math.inf
        """The newest tick in which an entity was placed."""
        self._boxes = _boxes(world.scene)
        self._tick = -1
        self._alive = 0
        self._now = np.zeros((0, len(KEPT)), np.int64)
        self._begin()

    def record(self) -> None:
        """Takes in what the step has changed."""
        world = self._world
        if world.tick != self._tick + 1:  # it has been put elsewhere in time
            self._begin()
            return
        w = world.arrays
        more = (len(w.entities) >> layout.WIDTH_SHIFT) - len(self._now)
        if more > 0:
            self._now = np.concatenate((self._now, np.zeros((more, len(KEPT)), np.int64)))
        n = int(w.lengths[layout.N_CHANGED])
        rows = np.empty((n, 1 + len(KEPT)), np.int64)
        now, before = world.kernel.lent(self._now), world.kernel.lent(rows)
        self._alive += world.kernel.recall(w.entities, w.changed, now, before, n)
        if self._alive != len(world):  # some have been removed
            matrix = world.matrix
            gone = np.flatnonzero(self._now[: len(matrix), 0] != matrix[:, ID])
            rows = np.concatenate((rows, np.column_stack((gone, self._now[gone]))))
            self._now[gone] = 0
            self._alive = len(world)
        self._undo.append(_Undo(rows, world.edited, world.placed))
        self._tick = world.tick
        if world.placed:
            self._placed_at = world.tick
        kept = math.ceil(self._reach)
        # Within the reach, a gap of up to that length may be drawn: it begins as much earlier.
        if self._tick - self._placed_at <= 2 * kept:
            kept *= 2
        while len(self._undo) > kept:
            self._undo.popleft()

    def at(self, seen: float, own: int = 0, gaps: Iterable[tuple[int, int]] = ()) -> "Past":
        """The world at a moment, which need not be a whole tick; clamped to what is kept.

        Args:
            seen: the server's tick, as a fraction.
            own: an entity that no query finds: who asks.
            gaps: the asking client was sent the two ticks of each, and none between.

        Raises:
            SceneError: `seen` is not a finite number.
        """
        kept = self._tick - len(self._undo)
        seen = min(max(finite(seen, "seen"), self._tick - self._reach, kept), float(self._tick))
        tick = math.floor(seen)
        first, last = next((gap for gap in gaps if gap[0] <= seen < gap[1]), (tick, tick + 1))
        first = max(first, kept)
        states = after = self._now.copy()
        blocks = dict(self._world.editing)
        placed: set[int] = set()
        for undone in range(self._tick, first, -1):
            undo = self._undo[undone - self._tick - 1]
            if undone == last:
                after = states.copy()
            if undone <= last:
                placed |= undo.placed
            states[undo.rows[:, 0]] = undo.rows[:, 1:]
            if undone > tick:
                blocks |= undo.blocks
        entities = _between(states, after, (seen - first) / (last - first), placed)
        return Past(self._world, seen, entities, self._boxes, blocks, own)

    def _begin(self) -> None:
        """Knows the present and no past."""
        self._undo.clear()
        self._tick = self._world.tick
        self._now = np.ascontiguousarray(self._world.matrix[:, KEPT])
        self._alive = len(self._world)


class Past:
    """The world at one moment of the recent past, for as long as no tick has passed since it was asked for.

    `seen` is the moment that was granted, in ticks of the server.
    """

    def __init__(
        self,
        world: World,
        seen: float,
        entities: tuple[Int64s, Floats],
        boxes: Floats,
        blocks: dict[Cell, int],
        own: int,
    ) -> None:
        self.seen = seen
        states, self._places = entities
        self._ids: Int64s = states[:, 0]
        box = boxes[states[:, 1]]
        self._low = self._places + box[:, 0]
        self._high = self._low + box[:, 1]
        self._world = world
        self._blocks = blocks
        self._floor = world.scene.origin[2] << SEGMENT_SHIFT
        self._own = own

    def __contains__(self, entity: int) -> bool:
        return bool((self._ids == entity).any())

    def position(self, entity: int) -> Vec:
        """Where an entity was, in blocks.

        Raises:
            KeyError: it did not exist.
        """
        found = np.flatnonzero(self._ids == entity)
        if not len(found):
            raise KeyError(entity)
        x, y, z = self._places[found[0]].tolist()
        return x, y, z

    def block(self, x: int, y: int, z: int) -> int | None:
        """The kind of a block; None where no segment is loaded (now: of whole segments there is no past)."""
        kind = self._blocks.get((x, y, z))
        return self._world.blocks.get(x, y, z) if kind is None else kind

    def ray(
        self, origin: Sequence[float], direction: Sequence[float], length: float, but: Collection[int] = ()
    ) -> list[Hit]:
        """What a ray meets, nearest first, up to the first block; what is not loaded is a block.

        Args:
            origin: in blocks.
            direction: of any length but zero.
            length: in blocks, at most 1024.
            but: ids that are left out, besides one's own.

        Raises:
            SceneError: a number is not finite or out of range, or the direction is zero.
        """
        ray = Ray(origin, direction, length)
        wall = ray.meets(self._solid)
        met: list[tuple[Fraction, int]] = []
        for i in self._near(ray).tolist():
            entity = int(self._ids[i])
            if entity == self._own or entity in but:
                continue
            t = ray.enters(self._low[i].tolist(), self._high[i].tolist())
            if t is not None and (wall is None or t <= wall[1]):
                met.append((t, entity))
        hits = [Hit(entity, None, ray.distance(t), ray.point(t)) for t, entity in sorted(met)]
        if wall is not None:
            hits.append(Hit(None, wall[0], ray.distance(wall[1]), ray.point(wall[1])))
        return hits

    def box(self, low: Sequence[float], high: Sequence[float]) -> list[int]:
        """The ids of the entities that overlap the box between two corners (in blocks), ascending.

        Raises:
            SceneError: a number is not finite.
        """
        hits = (self._low < np.array(vector(high, "high"))).all(axis=1)
        hits &= (self._high > np.array(vector(low, "low"))).all(axis=1)
        return sorted(entity for entity in self._ids[hits].tolist() if entity != self._own)

    def _solid(self, cell: Cell) -> bool:
        kind = self.block(*cell)
        return cell[2] >= self._floor if kind is None else kind != 0

    def _near(self, ray: Ray) -> Int64s:
        """The entities that the ray may hit: the slab test in floats, with a margin."""
        largest = max(map(abs, ray.direction))
        origin, way = np.array(ray.origin), np.array(ray.direction) / largest
        low, high = self._low - origin - MARGIN, self._high - origin + MARGIN
        steep = np.abs(way) > 1e-12
        inside = ((low <= 0) & (high >= 0)).all(axis=1, where=~steep)
        ends_low, ends_high = low[:, steep] / way[steep], high[:, steep] / way[steep]
        first = np.minimum(ends_low, ends_high).max(axis=1)
        last = np.maximum(ends_low, ends_high).min(axis=1)
        reach = ray.length + 2 * MARGIN
        return np.flatnonzero(inside & (first <= last) & (last >= -MARGIN) & (first <= reach))


def _between(old: Int64s, new: Int64s, share: float, placed: set[int]) -> tuple[Int64s, Floats]:
    """Returns the entities of `old` and their places: on the way to `new`, unless they are gone or were `placed`."""
    places = old[:, 2:] / BLOCK
    if share > 0:
        moves = old[:, 0] == new[:, 0]
        if placed:
            moves &= ~np.isin(old[:, 0], list(placed))
        was = places[moves]
        places[moves] = was + (new[moves, 2:] / BLOCK - was) * share
    there = old[:, 0] != 0
    return old[there], places[there]


def _boxes(scene: Scene) -> Any:
    """For each template its box's low corner from the position, and its sides: [n, 2, 3], in blocks."""
    rows = scene.kernel_tables()[0][:, layout.LO_X : layout.LO_X + 6]
    return rows.reshape(-1, 2, 3) / BLOCK
