"""Phases: the ticks of worlds are spread over the tick's time, whatever comes and goes."""

import random
from collections import Counter
from collections.abc import Iterable

import pytest

from server.hosting.phases import STEPS, Phases


def gaps(phases: Iterable[float]) -> list[float]:
    """Returns the distances between neighbouring phases around the tick's time."""
    found = sorted(phases)
    return [b - a for a, b in zip(found, [*found[1:], found[0] + 1], strict=True)]


def test_each_world_takes_the_middle_of_the_largest_gap() -> None:
    phases = Phases()
    assert [phases.take(name) for name in "abcde"] == [0.0, 0.5, 0.25, 0.75, 0.125]


def test_a_phase_that_is_given_back_is_a_gap_again() -> None:
    phases = Phases()
    for name in "abcd":
        phases.take(name)
    phases.give("b")
    phases.give("b")
    phases.give("nobody")
    assert phases.take("e") == 0.5
    phases.give("a")
    phases.give("c")
    assert phases.take("f") == 0.125  # between 0.75 and 0.5 around the end of the tick's time: the gap is 0.75 long
    assert phases.take("f") == 0.125, "a world has one phase"


def test_the_first_worlds_get_different_phases_and_further_ones_those_that_the_fewest_have() -> None:
    phases = Phases()
    for times in range(1, 4):
        for step in range(STEPS):
            phases.take(f"{times} {step}")
        counts = Counter(phases._steps.values())
        assert sorted(counts) == list(range(STEPS))
        assert set(counts.values()) == {times}
    phases.give("2 5")
    freed = phases.take("another")
    assert freed == phases.take("another")
    assert max(Counter(phases._steps.values()).values()) == 3


@pytest.mark.parametrize("most", [20, 400])
def test_after_any_coming_and_going_as_many_more_worlds_are_spread_evenly(most: int) -> None:
    r, phases, now = random.Random(1), Phases(), dict[str, float]()
    for step in range(3 * most):
        if now and (r.random() < 0.4 or len(now) >= most):
            name = r.choice([*now])
            phases.give(name)
            del now[name]
        else:
            now[f"{step}"] = phases.take(f"{step}")
        assert all(0 <= phase < 1 for phase in now.values())
    for step in range(2 * len(now)):
        now[f"more {step}"] = phases.take(f"more {step}")
    counts = Counter(now.values())
    assert max(gaps(counts)) <= max(6 / len(now), 1 / STEPS)
    assert max(counts.values()) <= len(now) / STEPS + 1
