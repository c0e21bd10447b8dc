"""The world compared with the oracle in exact rationals, over random worlds (`tests.twins`); a failure names its
seed."""

import pytest

from tests.lengths import long
from tests.twins import Twins

BLOCKS = 3
"""Number of tests that share the seeds, so that a failure and the time it takes are easy to find.

More of them have no other kind of world.
"""


@pytest.mark.parametrize("seeds", [range(10), *long(range(10, 25), range(25, 50), range(50, 75))], ids=str)
def test_a_few_random_worlds(compiled: bool, seeds: range) -> None:
    for seed in seeds:
        Twins(seed, compiled=compiled).run()


@pytest.mark.slow
@pytest.mark.parametrize("block", range(BLOCKS))
def test_many_small_worlds(compiled: bool, block: int) -> None:
    count = 120 if compiled else 30
    start = (10_000 if compiled else 20_000) + block * count
    for seed in range(start, start + count):
        Twins(seed, compiled=compiled).run()


@pytest.mark.slow
@pytest.mark.parametrize("block", range(BLOCKS))
def test_crowded_worlds(compiled: bool, block: int) -> None:
    count = 10 if compiled else 3
    start = (30_000 if compiled else 40_000) + block * count
    for seed in range(start, start + count):
        Twins(seed, compiled=compiled, bodies=50, ticks=40).run()
