"""Queries of rays and boxes among entities and blocks: on the server in the past, on a client in what it draws."""

from collections.abc import Collection, Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

from shared import layout
from shared.arrays import PLAIN, Float64s, np
from shared.checks import Cell, Vec, vector
from shared.layout import Int64s
from shared.rays import Ray
from shared.scene import Scene
from shared.units import BLOCK

MARGIN = 1e-3
"""Blocks by which boxes are enlarged in the quick test in floats. Boxes that pass it are tested exactly."""


class Hit(NamedTuple):
    """A hit of a ray: an entity or a block (the other is None), its distance and the point, in blocks."""

    entity: int | None
    block: Cell | None
    distance: float
    point: Vec


class Targets:
    """The boxes of entities at one moment, and the blocks around them.

    Args:
        ids: numbers of the entities, [n].
        low: low corners of their boxes in blocks, [n, 3].
        high: high corners, [n, 3].
        own: entity that no query finds.
    """

    def __init__(self, ids: Int64s, low: Float64s, high: Float64s, own: int) -> None:
        self._ids, self._low, self._high, self._own = ids, low, high, own

    def solid(self, cell: Cell) -> bool:
        """Returns whether a block, or a place that is not loaded, stops a ray."""
        raise NotImplementedError

    def ray(
        self, origin: Sequence[float], direction: Sequence[float], length: float, but: Collection[int] = ()
    ) -> list[Hit]:
        """Returns the hits of a ray, nearest first. It ends at the first solid block, or at a place that is not loaded.

        Args:
            origin: start of the ray in blocks.
            direction: direction of the ray, of any length except zero.
            length: length of the ray in blocks, at most 1024.
            but: entities to ignore, besides the player's own.

        Raises:
            SceneError: a number is not finite or out of range, or the direction is zero.
        """
        ray = Ray(origin, direction, length)
        wall = ray.meets(self.solid)
        met: list[tuple[Fraction, int]] = []
        for i in self._near(ray):
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
        """Returns the entities that overlap the box between two corners (in blocks), in ascending order.

        Raises:
            SceneError: a number is not finite.
        """
        hits = (self._low < np.array(vector(high, "high"), np.float64)).all(axis=1)
        hits &= (self._high > np.array(vector(low, "low"), np.float64)).all(axis=1)
        return sorted(entity for entity in self._ids[hits].tolist() if entity != self._own)

    def _near(self, ray: Ray) -> Iterable[int]:
        """Returns the indices of the entities that the ray may hit, by the slab test in floats with a margin."""
        largest = max(map(abs, ray.direction))
        if PLAIN:
            boxes = zip(self._low.tolist(), self._high.tolist(), strict=True)
            return (i for i, box in enumerate(boxes) if _may_hit(ray, largest, *box))
        origin, way = np.array(ray.origin), np.array(ray.direction) / largest
        low, high = self._low - origin - MARGIN, self._high - origin + MARGIN
        steep = np.abs(way) > 1e-12
        inside = ((low <= 0) & (high >= 0)).all(axis=1, where=~steep)
        ends_low, ends_high = low[:, steep] / way[steep], high[:, steep] / way[steep]
        first = np.minimum(ends_low, ends_high).max(axis=1)
        last = np.maximum(ends_low, ends_high).min(axis=1)
        reach = ray.length + 2 * MARGIN
        near: list[int] = np.flatnonzero(inside & (first <= last) & (last >= -MARGIN) & (first <= reach)).tolist()
        return near


def _may_hit(ray: Ray, largest: float, low: list[float], high: list[float]) -> bool:
    """Returns whether a ray may hit a box, as `Targets._near`."""
    first, last = -MARGIN, ray.length + 2 * MARGIN
    for origin, part, a, b in zip(ray.origin, ray.direction, low, high, strict=True):
        way, a, b = part / largest, a - origin - MARGIN, b - origin + MARGIN
        if abs(way) > 1e-12:
            ends = sorted((a / way, b / way))
            first, last = max(first, ends[0]), min(last, ends[1])
        elif a > 0 or b < 0:
            return False
    return first <= last


def boxes_of(scene: Scene) -> list[list[float]]:
    """Returns low corner (relative to the position) and sides of the box of each template, in blocks."""
    rows = scene.kernel_tables()[0].tolist()
    return [[part / BLOCK for part in row[layout.LO_X : layout.LO_X + 6]] for row in rows]
