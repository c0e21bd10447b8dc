"""Phases: the ticks of worlds are spread over the tick's time, whatever comes and goes."""

import random

from server.hosting.phases import Phases


def gaps(phases: dict[str, float]) -> list[float]:
    """Returns the distances between neighbouring phases around the tick's time."""
    found = sorted(phases.values())
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


def test_any_coming_and_going_leaves_the_largest_gap_at_most_twice_an_even_one_after_as_many_have_come() -> None:
    r, phases, now = random.Random(1), Phases(), dict[str, float]()
    for step in range(400):
        if now and r.random() < 0.4:
            name = r.choice([*now])
            phases.give(name)
            del now[name]
        else:
            now[f"{step}"] = phases.take(f"{step}")
        assert all(0 <= phase < 1 for phase in now.values())
        assert len(set(now.values())) == len(now)
    for step in range(2 * len(now)):
        now[f"more {step}"] = phases.take(f"more {step}")
    assert max(gaps(now)) <= 2 * 3 / len(now)
