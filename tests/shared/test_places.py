"""Places near entities: every form of the kernel marks the same ones as numpy's rounding."""

import random

import numpy as np

from server.game.fast_rows import Arguments, lent
from server.game.spawning import NO_PLACE, OFFSETS, ORDER
from shared import kernels
from shared.layout import COLUMNS, ID, Int64s, X, Y
from shared.places import APART
from shared.units import BLOCK, RANGE_BLOCKS


def test_a_place_is_near_an_entity_if_the_distance_rounds_to_its_offset(compiled: bool) -> None:
    kernel, rng = kernels.get(compiled), random.Random(5)
    for _ in range(60):
        entities, x, y = rows(rng), point(rng), point(rng)
        spawn, near = Arguments(kernel, "d", values=(x, y)), Arguments(kernel, "B", NO_PLACE + 1)
        kernel.mark_near(kernel.lent(entities), spawn.lent, lent(kernel, ORDER, "i"), near.lent)
        assert near.values.tolist()[:NO_PLACE] == expected(entities, x, y)


def rows(rng: random.Random) -> Int64s:
    """Returns entities, and free rows among them: around, on the borders between places, and far away."""
    entities = np.zeros((40, len(COLUMNS)), np.int64)
    for row in entities:
        row[ID] = rng.randint(0, 3)
        for column in (X, Y):
            row[column] = rng.choice(
                (
                    rng.randint(-60 * BLOCK, 60 * BLOCK),
                    rng.randint(-50, 50) * BLOCK,
                    rng.randint(-50, 50) * BLOCK + rng.randint(-1, 1),
                    rng.randint(-RANGE_BLOCKS * BLOCK, RANGE_BLOCKS * BLOCK),
                )
            )
    return entities


def point(rng: random.Random) -> float:
    """Returns a coordinate of a spawn point in grid steps."""
    return rng.choice((0.0, 3.0, rng.uniform(-9, 9), 1e-20, float(RANGE_BLOCKS), rng.randint(-30, 30) + 1e-15)) * BLOCK


def expected(entities: Int64s, x: float, y: float) -> list[bool]:
    """Returns what is marked, computed for all entities at once."""
    there = entities[entities[:, ID] != 0]
    steps = np.rint((there[:, X : Y + 1] - np.array((x, y))) / (APART * BLOCK))
    near = set(map(tuple, steps.tolist()))
    return [offset in near for offset in OFFSETS]
