"""Tests of the clock of an edge, in simulated time."""

import math
import random

import pytest

from server.scale.clock import LEAD_S, LEAD_S_MAX, WINDOW_S, EdgeClock

RATE = 32


@pytest.mark.parametrize("drift", [0.0, 2e-4, -2e-4])
def test_the_deadline_follows_the_earliest_records(drift: float) -> None:
    rng, clock = random.Random(1), EdgeClock(RATE)
    for tick in range(1, 20_000):
        ends = tick / RATE * (1 + drift)
        clock.arrived(tick, 0, ends + 0.001 + 0.004 * rng.random())
        if tick > 2 * RATE:
            assert abs(clock.due(tick + 1) - (ends + 1 / RATE + 0.001 - LEAD_S)) < 0.002


def test_after_a_pause_of_the_sequencer_the_deadline_is_right_again() -> None:
    clock = EdgeClock(RATE)
    for tick in range(1, 100):
        clock.arrived(tick, 0, tick / RATE)
    paused_s = 3.0
    for tick in range(100, 100 + round(3 * WINDOW_S * RATE)):
        clock.arrived(tick, 0, tick / RATE + paused_s)
    assert clock.due(200) == pytest.approx(200 / RATE + paused_s - LEAD_S)


def test_the_lead_grows_with_late_batches_and_falls_slowly() -> None:
    clock = EdgeClock(RATE)
    for tick in range(1, 20):
        clock.arrived(tick, 1, tick / RATE)
    assert clock.lead_s == LEAD_S_MAX
    assert clock.late == 19
    for tick in range(20, 60_000):
        clock.arrived(tick, 0, tick / RATE)
    assert clock.lead_s == LEAD_S


def test_without_a_record_there_is_no_deadline() -> None:
    clock = EdgeClock(RATE)
    assert clock.due(1) == math.inf
    clock.arrived(1, 0, 0.0)
    clock.restart()
    assert clock.due(2) == math.inf
