"""The long forms of tests, which `scripts/test --long` runs."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any, TypeVar

import pytest
from hypothesis import settings

T = TypeVar("T")
VARIANTS = 3
"""Number of variants of one test in a short run, besides those that are long ones by themselves. A long run has all."""
EXAMPLES = 100
"""Number of examples of a property test in a long run, unless the test has a number of its own (`examples`)."""


def long(*values: Any) -> list[Any]:
    """Returns parameters of a test that make a long run of it. A tuple has the values of several parameters."""
    every = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*value, marks=pytest.mark.slow) for value in every]


def contained(*values: Any) -> list[Any]:
    """Returns parameters of a short run that `scripts/test --all` leaves out.

    Use it where a long run of the same test does everything that the short one does, and more of it.
    """
    every = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*value, marks=pytest.mark.contained) for value in every]


def long_but(short: Collection[Any], every: Iterable[Any]) -> list[Any]:
    """Returns the parameters `every` of a test. All but `short` make a long run of it."""
    found = list(every)
    assert all(value in found for value in short)
    return [parameter for value in found for parameter in ([value] if value in short else long(value))]


def examples(most: int) -> int:
    """Returns the number of examples of a property test: `most` in a long run, a fifth of it in a short one."""
    return most * settings().max_examples // EXAMPLES


def sampled(count: int) -> set[int]:
    """Returns the places of the variants of a test that a short run has: at most `VARIANTS`, evenly spread."""
    if count <= VARIANTS:
        return set(range(count))
    return {round(k * (count - 1) / (VARIANTS - 1)) for k in range(VARIANTS)}


def spread(longest: Sequence[T], rest: Sequence[T], workers: int) -> list[T]:
    """Returns all tests in an order in which every worker has its share of the longest ones early.

    pytest-xdist deals one run of successive tests to each worker. A long test that comes last would leave the other
    workers idle. The longest ones come a little behind the first test of a worker, because the runs need not begin
    where these do; at the beginning, if there are few tests.
    """
    order: list[T] = []
    for worker in range(workers):
        share = rest[worker * len(rest) // workers : (worker + 1) * len(rest) // workers]
        before = min(len(longest), len(share) // 8)
        order += [*share[:before], *longest[worker::workers], *share[before:]]
    return order
