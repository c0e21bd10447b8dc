"""The world against the oracle in exact rationals, over random worlds; a failure names its seed."""

import pytest

from tests.twins import Twins


@pytest.mark.parametrize("block", range(4))
def test_random_worlds(compiled: bool, block: int) -> None:
    for seed in range(block * 20, block * 20 + 20):
        Twins(seed, compiled=compiled).run()
