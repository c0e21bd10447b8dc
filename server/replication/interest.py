"""Interest: the segments around an entity. A segment leaves the view at a larger distance than it enters it."""

import functools
import itertools
from collections.abc import Callable

from shared.checks import Cell


def distance(a: Cell, b: Cell) -> int:
    """Returns the distance of two segments in segments, along the axis where it is largest."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))


def around(centre: Cell, see: int, exists: Callable[[Cell], bool]) -> tuple[Cell, ...]:
    """Returns the existing segments around a segment, nearest first.

    The centre itself is included even if it does not exist (below the floor, for example).

    Args:
        centre: the segment with the entity.
        see: maximum distance in segments.
        exists: returns whether a segment exists.
    """
    return (centre, *filter(exists, _others(centre, see)))


@functools.lru_cache(256)
def _others(centre: Cell, see: int) -> tuple[Cell, ...]:
    """Returns the segments around a segment, nearest first, without itself."""
    x, y, z = centre
    return tuple((x + i, y + j, z + k) for i, j, k in _nearest_first(see)[1:])


@functools.cache
def _nearest_first(see: int) -> tuple[Cell, ...]:
    """Returns the offsets of the segments around a segment, nearest first, and those at one distance in order."""
    span = range(-see, see + 1)
    return tuple(sorted(itertools.product(span, span, span), key=lambda at: (distance(at, (0, 0, 0)), at)))


def update(sees: set[Cell], near: tuple[Cell, ...], keep: int) -> tuple[list[Cell], list[Cell]]:
    """Returns the segments to add to a view, nearest first, and the segments to drop from it.

    Args:
        sees: the segments of the view.
        near: the result of `around` for the entity; its first segment is the entity's own.
        keep: distance in segments beyond which a segment is dropped.
    """
    added = [segment for segment in near if segment not in sees]
    dropped = [segment for segment in sees if distance(segment, near[0]) > keep]
    return added, dropped
