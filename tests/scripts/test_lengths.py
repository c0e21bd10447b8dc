"""The variants of a test that a short run has: a few, evenly spread; a long run has the others."""

from itertools import pairwise

import pytest

from tests.lengths import VARIANTS, sampled


@pytest.mark.parametrize("count", [1, 2, VARIANTS])
def test_a_test_with_few_variants_keeps_all(count: int) -> None:
    assert sampled(count) == set(range(count))


@pytest.mark.parametrize("count", [VARIANTS + 1, 2 * VARIANTS, 240])
def test_a_test_with_many_keeps_the_first_the_last_and_some_between(count: int) -> None:
    kept = sorted(sampled(count))
    assert (len(kept), kept[0], kept[-1]) == (VARIANTS, 0, count - 1)
    gaps = [b - a for a, b in pairwise(kept)]
    assert max(gaps) - min(gaps) <= 1
