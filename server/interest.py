"""Who sees what: the segments around a client's entity, let go only further away than they were taken."""

from collections.abc import Callable

from shared.checks import Cell


def distance(a: Cell, b: Cell) -> int:
    """How many segments apart, along the longest axis."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))


def update(
    sees: set[Cell], centre: Cell, see: int, keep: int, exists: Callable[[Cell], bool]
) -> tuple[list[Cell], list[Cell]]:
    """What to add to `sees`, nearest first, and what to drop from it, for an entity in segment `centre`.

    The centre itself is always seen, also where no segment exists (below the floor).
    """
    x, y, z = centre
    span = range(-see, see + 1)
    around = [(x + i, y + j, z + k) for k in span for j in span for i in span]
    added = [segment for segment in around if segment not in sees and (segment == centre or exists(segment))]
    added.sort(key=lambda segment: (distance(segment, centre), segment))
    dropped = [segment for segment in sees if distance(segment, centre) > keep]
    return added, dropped
