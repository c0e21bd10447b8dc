"""Tests of the clock of an edge, in simulated time."""

import math
import random
from collections.abc import Callable
from functools import partial

import pytest

from server.scale.clock import LEAD_S, STEP_TICKS, EdgeClock
from shared.priced import MEMORY_S

RATE = 32


@pytest.mark.parametrize("drift", [0.0, 2e-4, -2e-4])
def test_the_deadline_follows_the_earliest_records(drift: float) -> None:
    rng, clock = random.Random(1), EdgeClock(RATE)
    for tick in range(1, 20_000):
        ends = tick / RATE * (1 + drift)
        clock.arrived(tick, 0, ends + 0.001 + 0.004 * rng.random())
        if tick > 2 * RATE:
            assert abs(clock.due(tick + 1) - (ends + 1 / RATE + 0.001 - LEAD_S)) < 0.002


def test_a_stall_of_some_records_is_no_step() -> None:
    clock = EdgeClock(RATE)
    for tick in range(1, 100):
        clock.arrived(tick, 0, tick / RATE)
    for tick in range(100, 110):  # they come at once
        clock.arrived(tick, 0, 110 / RATE)
    assert clock.due(120) == pytest.approx(120 / RATE - LEAD_S)


def test_after_a_pause_of_the_sequencer_the_deadline_is_right_again() -> None:
    clock = EdgeClock(RATE)
    for tick in range(1, 100):
        clock.arrived(tick, 0, tick / RATE)
    paused_s = 3.0
    for tick in range(100, 100 + STEP_TICKS):
        clock.arrived(tick, 0, tick / RATE + paused_s)
    assert clock.due(200) == pytest.approx(200 / RATE + paused_s - LEAD_S)


class Loop:
    """A sequencer and the clock of an edge, joined by a bus whose messages take the times of a function."""

    def __init__(self, delay: Callable[[random.Random], float]) -> None:
        self.rng, self.delay, self.clock = random.Random(1), delay, EdgeClock(RATE)
        self.up = self.down = 0.0
        self.tick = 0

    def run(self, seconds: float) -> None:
        """Runs that many seconds. Batches and records keep their order."""
        for _ in range(round(seconds * RATE)):
            self.tick += 1
            ends, due = self.tick / RATE, self.clock.due(self.tick)
            missing = 0
            if due < math.inf:
                self.clock.sent(self.tick, due)
                self.up = max(self.up, due + self.delay(self.rng))
                missing = int(self.up > ends)
            self.down = max(self.down, ends + self.delay(self.rng))
            self.clock.arrived(self.tick, missing, self.down)
            if due < math.inf:
                self.clock.learn(self.tick, ends - self.up)


QUIET, JITTER, WORSE = (partial(lambda most, rng: 0.001 + most * rng.random(), most) for most in (0.0005, 0.004, 0.015))


@pytest.mark.parametrize(("delay", "lead_s_max"), [(QUIET, 0.004), (JITTER, 0.012), (WORSE, 0.033)])
def test_a_learned_lead_is_as_short_as_a_bus_allows(delay: Callable[[random.Random], float], lead_s_max: float) -> None:
    loop = Loop(delay)
    loop.run(20)
    before = loop.clock.late
    loop.run(120)
    assert loop.clock.late - before < 0.002 * 120 * RATE
    assert 0.002 <= loop.clock.lead_s < lead_s_max < 1 / RATE + 0.002


def test_a_lead_rises_at_once_and_falls_slowly() -> None:
    loop = Loop(QUIET)
    loop.run(20)
    short = loop.clock.lead_s
    loop.delay, before = WORSE, loop.clock.late
    loop.run(20)
    assert loop.clock.lead_s > 4 * short
    assert loop.clock.late - before < 20
    loop.delay = QUIET
    loop.run(MEMORY_S + 20)
    assert loop.clock.lead_s < 2 * short


def test_rare_stops_are_not_worth_a_lead() -> None:
    loop = Loop(lambda rng: 0.001 + (0.08 if rng.random() < 1 / (60 * RATE) else 0.0))
    loop.run(300)
    assert loop.clock.lead_s < 0.006
    assert 0 < loop.clock.late < 0.01 * 300 * RATE


def test_a_batch_that_was_sent_again_teaches_nothing() -> None:
    loop = Loop(QUIET)
    loop.run(20)
    lead_s, tick = loop.clock.lead_s, loop.tick
    loop.clock.sent(tick + 1, tick / RATE)
    loop.clock.learn(tick + 1, -0.3)
    loop.run(1)
    assert loop.clock.lead_s == pytest.approx(lead_s, abs=1e-4)


def test_without_a_record_there_is_no_deadline() -> None:
    clock = EdgeClock(RATE)
    assert clock.due(1) == math.inf
    clock.arrived(1, 0, 0.0)
    clock.restart()
    assert clock.due(2) == math.inf
