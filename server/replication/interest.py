"""Who sees what: the segments around a client's entity, let go only further away than they were taken."""

from collections.abc import Callable

from shared.checks import Cell


def distance(a: Cell, b: Cell) -> int:
    """How many segments apart, along the longest axis."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))


def around(centre: Cell, see: int, exists: Callable[[Cell], bool]) -> tuple[Cell, ...]:
    """What an entity in segment `centre` sees in any case, nearest first.

    The centre itself is always seen, also where no segment exists (below the floor).
    """
    x, y, z = centre
    span = range(-see, see + 1)
    cube = [(x + i, y + j, z + k) for k in span for j in span for i in span]
    seen = [segment for segment in cube if segment == centre or exists(segment)]
    return tuple(sorted(seen, key=lambda segment: (distance(segment, centre), segment)))


def update(sees: set[Cell], near: tuple[Cell, ...], keep: int) -> tuple[list[Cell], list[Cell]]:
    """What to add to `sees`, nearest first, and what to drop from it, for an entity `around` which is `near`."""
    added = [segment for segment in near if segment not in sees]
    dropped = [segment for segment in sees if distance(segment, near[0]) > keep]
    return added, dropped
