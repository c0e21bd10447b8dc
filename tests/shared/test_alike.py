"""States that count for an entity: the kernel compared with the same rule in numpy."""

import random

import numpy as np
import pytest

from shared import kernels
from shared.layout import CELL, ID, TEMPLATE, Int64s, X
from tests.lengths import long_but

REACH = 10
ALWAYS = np.array([0, 1, 0], np.int64)


def that_count(states: Int64s, entity: int) -> Int64s:
    mine = states[states[:, ID] == entity]
    if not len(mine):
        return states
    ways = np.abs(states[:, X : X + 3] - mine[0, X : X + 3]).max(axis=1)
    near: Int64s = states[(ways < REACH) | (ALWAYS[states[:, TEMPLATE]] != 0)]
    return near


def drawn(rng: random.Random) -> Int64s:
    """Returns up to six entities on a line of 40 steps; half of them are where the own one (1) could meet them."""
    states = np.zeros((6, CELL), np.int64)
    states[:, ID] = range(1, 7)
    states[:, TEMPLATE] = [rng.randrange(3) for _ in states]
    for axis in range(3):
        states[:, X + axis] = [rng.randrange(-REACH - 1, REACH + 2) for _ in states]
    kept: Int64s = states[sorted(rng.sample(range(6), rng.randrange(7)))]
    return kept


def changed(states: Int64s, rng: random.Random) -> Int64s:
    """Returns states with a few other values, or without one of the entities."""
    other = states.copy()
    for _ in range(rng.randrange(3)):
        if len(other):
            other[rng.randrange(len(other)), rng.randrange(TEMPLATE + 1, CELL)] += rng.choice((-1, 1))
    if len(other) and rng.random() < 0.3:
        other = np.delete(other, rng.randrange(len(other)), axis=0)
    return other


@pytest.mark.parametrize("seed", long_but(range(3), range(8)))
def test_states_are_alike_if_the_rows_that_count_are_equal(seed: int, compiled: bool) -> None:
    rng = random.Random(seed)
    kernel = kernels.get(compiled)
    found = set()
    for _ in range(200):
        a = drawn(rng)
        b = changed(a, rng)
        flat, other, always = map(kernel.lent, (a, b, ALWAYS))
        alike = bool(kernel.alike(flat, len(a), other, len(b), 1, REACH, always))
        assert alike == np.array_equal(that_count(a, 1), that_count(b, 1))
        found.add((alike, np.array_equal(a, b)))
    assert found == {(True, True), (True, False), (False, False)}
