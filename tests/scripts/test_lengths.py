"""The variants of a test that a short run has: a few, evenly spread; a long run has the others."""

import ast
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.lengths import VARIANTS, sampled, spread


@pytest.mark.parametrize("count", [1, 2, VARIANTS])
def test_a_test_with_few_variants_keeps_all(count: int) -> None:
    assert sampled(count) == set(range(count))


@pytest.mark.parametrize("count", [VARIANTS + 1, 2 * VARIANTS, 240])
def test_a_test_with_many_keeps_the_first_the_last_and_some_between(count: int) -> None:
    kept = sorted(sampled(count))
    assert (len(kept), kept[0], kept[-1]) == (VARIANTS, 0, count - 1)
    gaps = [b - a for a, b in pairwise(kept)]
    assert max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize("workers", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 5, 7])
def test_every_worker_begins_with_its_share_of_the_longest(count: int, workers: int) -> None:
    longest, rest = [f"long {k}" for k in range(count)], [f"short {k}" for k in range(1000)]
    order = spread(longest, rest, workers)
    assert sorted(order) == sorted([*longest, *rest])
    assert [test for test in order if test in rest] == rest
    dealt = [order[k * len(order) // workers : (k + 1) * len(order) // workers] for k in range(workers)]
    for number, tests in enumerate(dealt):
        assert [test for test in tests if test in longest] == longest[number::workers]
        assert all(tests.index(test) < 3 * count for test in tests if test in longest)


def calls_of_contained(source: str) -> Iterator[str]:
    """Yields the source of each list of parameters that has `contained`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.List) and any(ast.unparse(each).startswith("*contained(") for each in node.elts):
            yield ast.unparse(node)


def test_a_contained_form_has_a_long_one_beside_it() -> None:
    files = sorted(Path(__file__).parents[1].rglob("test_*.py"))
    texts = {file: file.read_text("utf-8") for file in files if file.name != Path(__file__).name}
    found = {file: list(calls_of_contained(text)) for file, text in texts.items() if "*contained(" in text}
    assert len(found) > 20
    for file, lists in found.items():
        for each in lists:
            assert "*long(" in each or "mark.slow" in each, (file, each)
    assert sum(map(len, found.values())) == sum(text.count("*contained(") for text in texts.values())
