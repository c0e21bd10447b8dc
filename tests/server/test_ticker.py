"""The schedule, exactly; the ticker with a simulated clock and alarm."""

import logging
from collections.abc import Callable

import pytest

from server.config.limits import catch_up_ticks
from server.runtime.alarm import Alarm
from server.runtime.ticker import FAILURES_MAX, Schedule, Ticker

RATE = 32  # a power of two: every deadline below is exact
PERIOD = 1 / RATE
CATCH_UP_MAX = catch_up_ticks(RATE)


def taken(schedule: Schedule, now: float) -> list[float]:
    """Returns the deadlines of all ticks that are due at `now`, in periods, if ticks take no time."""
    deadlines = []
    while (deadline := schedule.take(now)) is not None:
        deadlines.append(deadline * RATE)
    return deadlines


def test_one_tick_per_deadline_and_none_before_it() -> None:
    schedule = Schedule(RATE, 0.0)
    assert taken(schedule, -1e-9) == []
    for n in range(100):
        assert schedule.deadline == n * PERIOD
        assert taken(schedule, n * PERIOD) == [n]
        assert taken(schedule, (n + 0.999) * PERIOD) == []


def test_deadlines_do_not_drift() -> None:
    schedule = Schedule(60, 1000.0)
    for _ in range(60 * 3600):
        assert schedule.take(schedule.deadline) is not None
    assert schedule.deadline == 4600.0
    assert schedule.skipped == 0


def test_a_short_stall_is_caught_up_entirely() -> None:
    schedule = Schedule(RATE, 0.0)
    assert taken(schedule, 0.0) == [0]
    assert taken(schedule, 4.5 * PERIOD) == [1, 2, 3, 4]
    assert schedule.deadline == 5 * PERIOD
    assert schedule.skipped_s == 0


def test_a_long_stall_is_caught_up_by_four_ticks_and_the_rest_is_counted() -> None:
    schedule = Schedule(RATE, 0.0)
    assert taken(schedule, 0.0) == [0]
    assert taken(schedule, 3.0) == [93, 94, 95, 96]  # the earliest are dropped; these keep the server's time
    assert schedule.deadline == 3.0 + PERIOD
    assert schedule.skipped == 96 - 4
    assert schedule.skipped_s == 92 * PERIOD
    assert taken(schedule, 3.0 + PERIOD) == [97]


def test_one_more_than_four_is_one_skipped() -> None:
    schedule = Schedule(RATE, 0.0)
    assert taken(schedule, 4 * PERIOD) == [1, 2, 3, 4]
    assert (schedule.skipped, schedule.deadline) == (1, 5 * PERIOD)


def test_ticks_of_twice_the_period_never_fall_far_behind() -> None:
    schedule, now, lags, ran = Schedule(RATE, 0.0), 0.0, [], 0
    while now < 100.0:
        deadline = schedule.take(now)
        if deadline is None:
            now = schedule.deadline
        else:
            lags.append((now - deadline) * RATE)
            now += 2 * PERIOD
            ran += 1
    assert max(lags) <= CATCH_UP_MAX + 1
    assert ran == pytest.approx(50 * RATE, abs=CATCH_UP_MAX)
    assert ran + schedule.skipped == pytest.approx(100 * RATE, abs=2 * CATCH_UP_MAX)


@pytest.mark.parametrize("rate", [1, 7, 30, 60, 128, 240])
@pytest.mark.parametrize("start", [0.0, 12345.678, 3e8])
def test_giving_up_ends_at_the_first_deadline_to_come_whatever_the_rounding(rate: int, start: float) -> None:
    for stall in range(5, 500, 7):
        now = start + stall / rate
        schedule = Schedule(rate, start)
        while schedule.take(now) is not None:
            pass
        assert now < schedule.deadline <= now + 1.001 / rate + 1e-6
        assert schedule.skipped == pytest.approx(max(stall + 1 - catch_up_ticks(rate), 0), abs=1)


def test_how_late_a_tick_is_does_not_depend_on_what_is_dropped() -> None:
    schedule = Schedule(RATE, 0.0)
    schedule.take(0.0)
    schedule.take(3.0)
    assert schedule.late_s == 3.0 - PERIOD
    schedule.take(3.0)
    assert schedule.late_s == 2 * PERIOD


def test_catching_up_is_a_matter_of_time_not_of_ticks() -> None:
    assert [catch_up_ticks(rate) for rate in (1, 20, 32, 60, 128, 240)] == [4, 4, 4, 8, 16, 30]


class Bench:
    """A ticker with a clock that the test moves and an alarm that the test rings."""

    def __init__(self, work_s: float = 0.0) -> None:
        self.now = 100.0
        self.at: float | None = None
        self.work_s = work_s
        self.calls: list[tuple[float, float]] = []
        self.broken = 0
        self.raising = False
        self.ticker = Ticker(RATE, self.tick, self.breaks, self.alarm, clock=lambda: self.now)

    def alarm(self, ring: Callable[[], None]) -> Alarm:
        self.ring = ring
        return self

    def set(self, at: float) -> None:
        self.at = at

    def close(self) -> None:
        self.at = None

    def tick(self, deadline: float, now: float) -> None:
        self.calls.append((deadline, now))
        self.now += self.work_s
        if self.raising:
            raise ZeroDivisionError

    def breaks(self) -> None:
        self.broken += 1

    def run(self, rings: int, late_s: float = 0.0) -> None:
        for _ in range(rings):
            if self.at is not None:
                self.now = max(self.now, self.at + late_s)
            self.ring()


def test_the_first_tick_is_due_at_once_and_each_gets_its_deadline_and_the_time() -> None:
    bench = Bench()
    assert bench.at == 100.0
    bench.run(3, late_s=0.001)
    assert bench.calls == [(100.0 + n * PERIOD, 100.0 + n * PERIOD + 0.001) for n in range(3)]


def test_lateness_and_work_are_measured() -> None:
    bench = Bench(work_s=0.002)
    bench.run(99, late_s=0.001)
    bench.run(1, late_s=0.05)
    stats = bench.ticker.stats()
    assert stats["tick_lateness_ms"]["p50"] == pytest.approx(1.0, rel=0.07)
    assert stats["tick_lateness_ms"]["max"] == 50
    assert stats["tick_work_ms"]["p50"] == pytest.approx(2.0, rel=0.07)
    assert (stats["ticks"], stats["ticks_late"], stats["skipped_s"]) == (100, 1, 0)


def test_the_loop_gets_a_turn_between_two_ticks_of_a_catch_up() -> None:
    bench = Bench()
    bench.run(1)
    bench.now += 3.0
    for n in range(CATCH_UP_MAX):
        bench.ring()
        assert len(bench.calls) == 2 + n
    bench.ring()
    assert len(bench.calls) == 1 + CATCH_UP_MAX
    assert bench.ticker.stats()["skipped_s"] == 92 * PERIOD


def test_an_early_ring_runs_nothing() -> None:
    bench = Bench()
    bench.run(1)
    bench.now += PERIOD / 2
    bench.ring()
    assert len(bench.calls) == 1
    assert bench.at == 100.0 + PERIOD


def test_a_tick_that_raises_is_logged_and_the_next_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    for _ in range(3):
        bench.raising = True
        bench.run(FAILURES_MAX - 1)
        bench.raising = False
        bench.run(1)
    assert (bench.broken, bench.ticker.failures) == (0, 3 * (FAILURES_MAX - 1))
    assert len([r for r in caplog.records if r.levelno == logging.ERROR and r.exc_info]) == 2, "the 1st and the 10th"


def test_ten_ticks_in_a_row_that_raise_break_the_ticker() -> None:
    bench = Bench()
    bench.raising = True
    bench.run(FAILURES_MAX + 5)
    assert (bench.broken, len(bench.calls), bench.at) == (1, FAILURES_MAX, None)


def test_nothing_runs_after_stop_not_even_a_ring_under_way() -> None:
    bench = Bench()
    bench.run(2)
    bench.ticker.stop()
    bench.ticker.stop()
    bench.ring()
    assert (len(bench.calls), bench.at) == (2, None)


@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5, 0.75])
def test_a_phase_puts_the_deadlines_between_the_whole_multiples_of_the_ticks_time(phase: float) -> None:
    bench = Bench()
    bench.ticker.stop()
    bench.now = 103 * PERIOD + 0.3 * PERIOD
    bench.ticker.resume(phase)
    first = 104 if phase < 0.3 else 103
    bench.run(3)
    assert [deadline / PERIOD - phase for deadline, _ in bench.calls] == [first, first + 1, first + 2]


def test_a_ticker_that_rests_runs_nothing_and_skips_nothing() -> None:
    bench = Bench()
    bench.run(2)
    bench.ticker.stop()
    assert bench.at is None
    bench.ring()
    bench.now += 60.0
    bench.ticker.resume(0.5)
    bench.ticker.resume(0.25)  # it runs already
    before = bench.now
    bench.run(2)
    assert len(bench.calls) == 4
    assert before < bench.calls[2][0] <= before + PERIOD
    assert bench.calls[2][0] % PERIOD == PERIOD / 2
    assert (bench.ticker.ticks, bench.ticker.stats()["skipped_s"]) == (4, 0.0)


def test_a_paused_ticker_has_no_alarm_until_it_is_resumed() -> None:
    bench = Bench()
    made: list[Alarm] = []

    def alarm(ring: Callable[[], None]) -> Alarm:
        made.append(bench.alarm(ring))
        return made[-1]

    ticker = Ticker(RATE, bench.tick, bench.breaks, alarm, clock=lambda: bench.now, paused=True)
    assert not made
    ticker.stop()
    ticker.resume(0.0)
    assert len(made) == 1


def test_ticks_that_take_longer_than_the_time_between_two_are_counted() -> None:
    bench = Bench(work_s=PERIOD)
    bench.run(3)
    assert bench.ticker.overruns == 0
    bench.work_s = 1.5 * PERIOD
    bench.run(2)
    assert bench.ticker.overruns == 2


def test_a_world_with_long_ticks_delays_another_by_one_of_its_ticks_at_most_and_costs_it_none() -> None:
    now = 0.0
    waiting: dict[Callable[[], None], float] = {}
    works = {"slow": 3 * PERIOD, "quick": PERIOD / 64}

    class Loop:
        """A timer of a simulated event loop, which calls the function whose time is the earliest."""

        def __init__(self, ring: Callable[[], None]) -> None:
            self.ring = ring

        def set(self, at: float) -> None:
            waiting[self.ring] = at

        def close(self) -> None:
            waiting.pop(self.ring, None)

    def tick_of(name: str) -> Callable[[float, float], None]:
        def tick(deadline: float, began: float) -> None:
            nonlocal now
            now += works[name]

        return tick

    tickers = {
        name: Ticker(RATE, tick_of(name), lambda: None, Loop, clock=lambda: now, paused=True, yields=True)
        for name in works
    }
    for phase, ticker in enumerate(tickers.values()):
        ticker.resume(phase / 2)
    while now < 20.0:
        ring = min(waiting, key=waiting.__getitem__)
        now = max(now, waiting.pop(ring))
        ring()
    slow, quick = tickers["slow"], tickers["quick"]
    assert quick.lateness.max_s <= works["slow"] + 4 * works["quick"]
    assert quick.skipped_s == 0.0
    assert quick.ticks >= 20.0 * RATE - 4
    assert slow.overruns == slow.ticks > 20.0 * RATE / 7
    assert slow.skipped_s > 15.0
