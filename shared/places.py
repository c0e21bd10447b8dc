"""The part of the kernel that looks for places around a spawn point.

Only servers use it (`server.game.spawning`). This source runs compiled and, unchanged, in plain Python. It adds,
subtracts, multiplies and compares floats, so their bits are the same everywhere.
"""

from typing import Any

from shared.jit import decorators
from shared.layout import ID, WIDTH_SHIFT, X, Y
from shared.units import BLOCK

jit, inlined = decorators(__name__)

RINGS = 24
"""Number of rings of places around a spawn point, including the point itself."""
SIDE = 2 * RINGS + 1
"""Number of places along each axis, with one more at each end, which is no place."""
APART = 2
"""Distance of neighbouring places and rings, in blocks."""
STEPS = 1.0 / (APART * BLOCK)
"""Factor from grid steps to the distance of neighbouring places. It is a power of two, so the product is exact."""
ROUND = 1.5 * (1 << 52)
"""Number at which neighbouring floats differ by 1: adding it rounds to a whole number, and halves to an even one."""


@jit
def mark_near(e: Any, spawn: Any, order: Any, near: Any) -> None:
    """Marks the places that an entity is near, at any height: each entity is near the place that is nearest to it.

    Args:
        e: array of the entities, 16 values per row.
        spawn: x and y of the spawn point, in grid steps.
        order: [SIDE * SIDE] number of the place at each offset from the spawn point, by x and y.
        near: gets 1 for each place that an entity is near, by number.
    """
    for at in range(0, len(e), 1 << WIDTH_SHIFT):
        if e[at + ID] != 0:
            i = int((e[at + X] - spawn[0]) * STEPS + ROUND - ROUND) + RINGS
            j = int((e[at + Y] - spawn[1]) * STEPS + ROUND - ROUND) + RINGS
            if 0 <= i < SIDE and 0 <= j < SIDE:
                near[order[i * SIDE + j]] = 1
