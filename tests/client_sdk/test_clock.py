"""The server's clock, the timeline and the lead, with exact figures."""

import random
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest

from client_sdk.timing.lead import (
    CALM_S,
    FASTER,
    FIRST_INPUTS_S,
    HURRY,
    JUMP_S,
    SAFETY_S,
    SHIFT_S,
    PricedLead,
)
from client_sdk.timing.server_clock import PING_FIRST_S, PING_LATER_S, PINGS, ServerClock
from client_sdk.timing.timeline import Timeline
from shared.priced import FIRST_S, MEMORY_S, PRICE_S, Excesses
from tests.lengths import long

RATE = 32.0
FIRST_INPUTS, JUMP, PRICE, SHIFT = int(FIRST_INPUTS_S * RATE), JUMP_S * RATE, PRICE_S * RATE, SHIFT_S * RATE
SAFETY = 0.03


def clock_at(phase: float = 100.0, rtt_s: float = 0.0, spread_s: float = 0.0) -> ServerClock:
    """Returns a clock that has enough samples to be ready."""
    clock = ServerClock()
    clock.rate = RATE
    for i in range(PINGS):
        sent, took = float(i), rtt_s + (spread_s if i == 0 else 0.0)
        clock.answered(sent, RATE * (sent + took / 2) + phase, sent + took)
    return clock


class Loop:
    """A lead controller and a link without a network in between: need(i) is the phase that input i needs."""

    def __init__(self, need: Callable[[int], float], lead: PricedLead | None = None, delay: int = 0) -> None:
        self.clock = clock_at()
        self.lead = lead or PricedLead()
        self.timeline = Timeline(RATE, self.lead.start(self.clock, 0.0), 0.0)
        self.phases: list[float] = []
        self.late: list[int] = []
        self.jumps = 0
        self._need, self._delay, self._reported = need, delay, 0

    def run(self, inputs: int) -> "Loop":
        """Runs `inputs` ticks. Inputs that arrived in one burst are reported at once, `delay` ticks later. Returns
        itself."""
        for i in range(len(self.phases), len(self.phases) + inputs):
            self.jumps += self.timeline.steer(self.lead, self.clock, i / RATE)
            self.phases.append(self.timeline.phase)
            if self.timeline.phase < self._need(i):
                self.late.append(i)
            while self._reported <= i and self._reported + self._need(self._reported) - 101 + self._delay <= i:
                told, phase = self._reported, self.phases[self._reported]
                self.lead.observe(told, phase - self._need(told), phase, i / RATE)
                self._reported += 1
        return self

    def speeds(self) -> Iterator[float]:
        """Returns the change of the phase in each tick."""
        return (after - before for before, after in pairwise(self.phases))


# -- the server's clock ------------------------------------------------------------------------------------


def test_no_ping_is_due_before_the_rate_is_known() -> None:
    clock = ServerClock()
    assert not clock.due(5.0)
    assert clock.next_ping == float("inf")
    assert not clock.ready


def test_pings_come_quickly_first_and_slowly_later() -> None:
    clock = ServerClock()
    clock.rate = RATE
    sent, now = [], 0.0
    while now < 4:
        if clock.due(now):
            sent.append(now)
        now += 0.01
    gaps = [after - before for before, after in pairwise(sent)]
    assert gaps[: PINGS - 1] == pytest.approx([PING_FIRST_S] * (PINGS - 1), abs=0.011)
    assert gaps[PINGS - 1 :] == pytest.approx([PING_LATER_S] * len(gaps[PINGS - 1 :]), abs=0.011)


def test_the_phase_is_exact_where_both_ways_take_the_same() -> None:
    clock = clock_at(phase=123.25, rtt_s=0.25)
    assert clock.ready
    assert clock.phase == 123.25
    assert clock.tick(10.0) == 123.25 + 320
    assert (clock.rtt_s, clock.spread_s) == (0.25, 0.0)


def test_pings_that_stood_in_a_queue_do_not_count() -> None:
    clock = clock_at(phase=50.0, rtt_s=0.0625)
    for i in range(8):  # half a second, all of it in one direction
        clock.answered(10.0 + i, RATE * (10.0 + i + 0.03125) + 50.0, 10.5 + i)
    assert clock.phase == pytest.approx(50.0)
    assert clock.rtt_s == 0.0625
    assert clock.spread_s == 0.4375


def test_a_pong_from_the_future_is_ignored() -> None:
    clock = clock_at(phase=7.0)
    clock.answered(99.0, 0.0, 98.0)
    clock.answered(float("nan"), 0.0, 98.0)
    assert clock.phase == 7.0


def test_the_phase_follows_a_drift_of_200_ppm() -> None:
    clock, rng = ServerClock(), random.Random(1)
    clock.rate = RATE
    for i in range(600):
        sent, there, back = float(i), rng.uniform(0.01, 0.02), rng.uniform(0.01, 0.02)
        clock.answered(sent, RATE * (sent + there) * 1.0002, sent + there + back)
    assert clock.tick(600.0) == pytest.approx(RATE * 600 * 1.0002, abs=0.2)


# -- the timeline ------------------------------------------------------------------------------------------


def test_a_timeline_is_a_phase() -> None:
    timeline = Timeline(RATE, 5.5, 0.0)
    assert timeline.tick(2.0) == 69.5
    assert timeline.when(69.5) == 2.0


def test_a_timeline_reports_jumps_only() -> None:
    class To:
        phase = 0.0

        def start(self, clock: ServerClock, now: float) -> float:
            return 0.0

        def observe(self, tick: int, margin: float, phase: float, now: float) -> None: ...

        def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
            assert elapsed >= 0
            return self.phase

        def step(self, clock: ServerClock) -> float:
            return 0.0

    to, timeline, clock = To(), Timeline(RATE, 0.0, 0.0), clock_at()
    to.phase = JUMP
    assert not timeline.steer(to, clock, 1.0)
    to.phase = 2.5 * JUMP
    assert timeline.steer(to, clock, 0.5)  # a clock that goes back counts as a clock that stands
    assert timeline.phase == 2.5 * JUMP


# -- the lead ----------------------------------------------------------------------------------------------


def test_it_starts_on_the_safe_side() -> None:
    lead = PricedLead()
    assert lead.start(clock_at(phase=100.0, rtt_s=0.25), 9.0) == 100 + 0.125 * RATE + 2
    assert lead.start(clock_at(phase=100.0, rtt_s=0.25, spread_s=0.5), 9.0) == 100 + 0.625 * RATE + 2
    # A program that was busy while it joined must not be ahead of all that it can predict, or it would send nothing.
    assert lead.start(clock_at(phase=100.0, rtt_s=0.25, spread_s=5.0), 9.0) == 100 + 0.625 * RATE + 2


def test_a_steady_path_gets_what_it_needs_and_the_safety() -> None:
    loop = Loop(lambda i: 101.0).run(2000)
    assert loop.phases[-1] == pytest.approx(101 + SAFETY, abs=0.01)
    assert not loop.late


def test_it_holds_still_until_it_has_seen_enough() -> None:
    loop = Loop(lambda i: 101.0).run(FIRST_INPUTS)
    assert set(loop.phases) == {102.0}


def test_the_lead_allows_for_its_own_steering_with_any_delay() -> None:
    """The distance is covered once, at full speed: no overshoot and no ringing with a round trip of two seconds."""
    for delay in (0, 8, 64):
        loop = Loop(lambda i: 101.0 if i < 1000 else 105.0, delay=delay).run(2000)
        rise = loop.phases[1000:]
        assert min(after - before for before, after in pairwise(rise)) > -1e-4
        assert max(rise) == pytest.approx(105 + SAFETY, abs=0.03)


def test_one_stall_is_ignored_however_long_its_burst() -> None:
    loop = Loop(lambda i: 101.0 + max(0, 5 - (i - 5000)) * (5000 <= i < 5005)).run(8000)
    assert loop.late == [5000, 5001, 5002, 5003, 5004]
    assert max(loop.phases[4000:]) == pytest.approx(101 + SAFETY, abs=0.01)


def test_stalls_that_come_often_are_covered() -> None:
    """Five of a hundred inputs are late: 1 % by 5 ticks, 1 % by 4, and on. Covering 1 % is worth two ticks."""
    loop = Loop(lambda i: 101.0 + max(0, 5 - i % 100)).run(8000)
    assert loop.phases[-1] == pytest.approx(106 + SAFETY, abs=0.01)
    assert max(loop.late) < 600


@pytest.mark.parametrize(("every", "top"), [(150, 108), (300, 101)])
def test_stalls_are_covered_where_they_come_often_enough_to_be_worth_it(every: int, top: int) -> None:
    """A stall of 7 inputs needs 7 ticks. No late input at all is worth 200 ticks, so the limit is one stall in 200
    inputs."""
    loop = Loop(lambda i: 101.0 + max(0, 7 - i % every)).run(16_000)
    assert loop.phases[-1] == pytest.approx(top + SAFETY, abs=0.02)
    assert {i % every for i in loop.late if i >= 4000} == (set() if top > 101 else set(range(7)))


def test_a_spike_is_followed_and_left_behind_at_once() -> None:
    """In one second all needs are 3 ticks higher: the lead is up within half a second, down again as fast, and nothing
    is learnt."""
    loop = Loop(lambda i: 101.0 + 3 * (4000 <= i < 4032)).run(6000)
    assert 4000 <= min(loop.late) <= max(loop.late) <= 4012
    assert max(loop.phases[4000:4032]) == pytest.approx(104 + SAFETY, abs=0.02)
    assert loop.phases[4032 + 40] == pytest.approx(101 + SAFETY, abs=0.1)
    assert loop.phases[-1] == pytest.approx(101 + SAFETY, abs=0.02)


def test_it_hurries_only_while_every_input_is_late() -> None:
    loop = Loop(lambda i: 101.0 + 4 * (i >= 4000)).run(5000)
    speeds = list(loop.speeds())
    assert max(speeds) == pytest.approx(HURRY)
    assert min(speeds) >= -FASTER - 1e-9
    caught_up = max(loop.late)
    assert max(speeds[caught_up + 2 :]) <= FASTER + 1e-9


def test_it_rises_at_once_and_falls_slowly() -> None:
    rough = Loop(lambda i: 101.0 + (i * 7919 % 100) / 50 * (i < 4000)).run(4000)
    assert rough.phases[-1] == pytest.approx(103 + SAFETY, abs=0.1)
    high = rough.phases[-1]
    rough.run(int(MEMORY_S * RATE / 2))
    assert rough.phases[-1] == pytest.approx(high, abs=0.1)
    rough.run(int(MEMORY_S * RATE))
    assert rough.phases[-1] == pytest.approx(101 + SAFETY, abs=0.1)
    assert min(rough.speeds()) > -0.04


def test_stalls_within_a_long_frame_are_covered_and_no_more() -> None:
    """A frame took ten seconds, and every eighth input in it was stalled."""
    loop = Loop(lambda i: 101.0).run(1000)
    phase = loop.timeline.phase
    for i in range(1000, 1320):
        loop.lead.observe(i, phase - (101.0 + 5 * (i % 8 == 0)), phase, 1320 / RATE)
    loop.timeline.steer(loop.lead, loop.clock, 1320 / RATE)
    assert loop.timeline.phase == pytest.approx(106, abs=0.5)


def test_beyond_ten_ticks_it_jumps_both_ways() -> None:
    loop = Loop(lambda i: 101.0 + 40 * (3000 <= i < 4000)).run(5000)
    assert loop.jumps == 2
    assert loop.phases[3999] == pytest.approx(141 + SAFETY, abs=0.02)
    assert loop.phases[-1] == pytest.approx(101 + SAFETY, abs=0.02)


def test_no_stall_makes_it_jump() -> None:
    """This holds even for a stall in the very first inputs."""
    loop = Loop(lambda i: 101.0 + max(0, 7 - (i - 20)) * (i >= 20) + 8 * (i == 20)).run(3000)
    assert loop.jumps == 0


@pytest.mark.parametrize("ppm", [-200, 200])
def test_a_drift_costs_nothing(ppm: int) -> None:
    def need(i: int) -> float:
        return 101.0 + i * ppm * 1e-6

    loop = Loop(need).run(40_000)
    assert not loop.late
    above = [phase - need(i) for i, phase in enumerate(loop.phases)][1000:]
    assert 0 < min(above) <= max(above) < SAFETY + 0.1


def test_bounded_jitter_never_makes_an_input_late() -> None:
    rng = random.Random(3)
    needs = [100.5 + rng.uniform(0, 1.28) for _ in range(20_000)]
    loop = Loop(needs.__getitem__).run(20_000)
    assert not loop.late
    assert sum(loop.phases[1000:]) / 19_000 < max(needs) + SAFETY + 0.05


@pytest.mark.parametrize("price", [10.0, *long(50.0, 2.5)])
def test_the_cover_is_where_one_tick_more_is_worth_one_tick(price: float) -> None:
    """Needs fall off as exp(-2 x), so one tick more is worth 2 exp(-2 x) prices: 1 in 2 prices is late."""
    rng = random.Random(4)
    needs = [100.0 + rng.expovariate(2.0) for _ in range(40_000)]
    loop = Loop(needs.__getitem__, PricedLead(price / RATE, safety_s=0.0)).run(40_000)
    assert len([i for i in loop.late if i > 4000]) / 36_000 == pytest.approx(1 / (2 * price), rel=0.2)


def test_a_change_of_the_path_for_good_is_the_path_after_a_while() -> None:
    loop = Loop(lambda i: 101.0 + 2.0 * (i >= 3000)).run(3000 + int(3 * CALM_S * RATE))
    assert loop.phases[-1] == pytest.approx(103 + SAFETY, abs=0.02)
    assert len(loop.late) <= 12


@pytest.mark.slow
def test_a_long_way_at_a_high_rate_is_learnt_like_any() -> None:
    """The round trip is two seconds at 240 ticks a second, so a stall may take 1,020 inputs."""
    clock = ServerClock()
    clock.rate = 240.0
    for i in range(PINGS):
        clock.answered(float(i), clock.rate * (i + 1), i + 2.0)
    lead = PricedLead()
    timeline = Timeline(clock.rate, lead.start(clock, 2.0), 2.0)
    need = timeline.phase - 5.0
    for i in range(20_000):
        timeline.steer(lead, clock, 2.0 + i / clock.rate)
        lead.observe(i, timeline.phase - need, timeline.phase, 2.0 + i / clock.rate)
    assert timeline.phase == pytest.approx(need + SAFETY_S * clock.rate, abs=0.1)


@pytest.mark.parametrize("slope", [0.0, 1e-3, -1e-3, 0.05])
def test_the_base_is_that_of_its_definition_after_every_input(slope: float) -> None:
    """The earlier inputs do not matter: needs fall, rise or stay equal, and stalls get longer."""
    rng = random.Random(5)
    lead, clock = PricedLead(), clock_at(rtt_s=0.1)
    lead.start(clock, 0.0)
    needs: list[float] = []
    for i in range(3000):
        needs.append(100.0 + i * slope + rng.choice((0.0, 0.25, 0.5, 1.5)))
        lead.observe(i, -needs[-1], 0.0, 0.0)
        least = min(needs[-lead._stall :])
        calm = min(needs[-max(int(CALM_S * RATE), lead._stall) :])
        assert lead._base == (least if least > calm + SHIFT else calm)
        if i % 500 == 250:
            clock.rtt_s = (0.1, 3.0, 0.5)[i // 500 % 3]
            lead.steer(100.0, 1.0, clock, 0.0)


@pytest.mark.parametrize("top", [0.001, 0.4, 8.0, 1000.0])
def test_the_cover_is_the_best_of_all_excesses_though_few_are_looked_at(top: float) -> None:
    rng = random.Random(6)
    excesses = Excesses(PRICE, FIRST_S * RATE, MEMORY_S * RATE)
    known: list[float] = []
    for _ in range(600):
        known.append(rng.choice((rng.uniform(-top, top), rng.uniform(0, top / 10), 0.0)))
        excesses.add(known[-1])
        falling = sorted(known, reverse=True)
        costs = [excess + PRICE * (i / max(len(falling), FIRST_S * RATE)) for i, excess in enumerate(falling)]
        assert excesses.best() == falling[costs.index(min(costs))]
