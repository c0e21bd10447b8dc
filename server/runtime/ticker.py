"""The ticker: runs ticks at a fixed rate, with absolute deadlines.

Overrun policy. The deadline of tick n is `start + n / rate`, regardless of earlier ticks, so the schedule does not
drift. A tick whose deadline has passed runs at once. Between two such ticks the event loop runs once, so that messages
that arrived meanwhile are received. At most `limits.catch_up_ticks` ticks run in a row that way. If more deadlines were
missed, the earliest are dropped before any of the others runs, and counted as skipped time. So the deadline that a tick
gets always agrees with the server time. A server at 32 Hz that was stopped for 3 s runs 4 ticks at once and goes on. A
server that is too slow for its rate is never further behind than that, and shows it in `skipped_s`.
"""

import math
import time
from collections.abc import Callable
from typing import Any

from server.config.limits import catch_up_ticks
from server.observability.errors import FaultReporter
from server.observability.histogram import Histogram
from server.runtime.alarm import Alarm

FAILURES_MAX = 10
"""Number of ticks in a row that may raise before the ticker stops."""


class Schedule:
    """The deadlines of all ticks. They are computed from whole numbers, so they do not drift.

    Args:
        rate: ticks per second.
        start: the first deadline, in seconds.
    """

    def __init__(self, rate: int, start: float) -> None:
        self.rate = rate
        self.start = start
        self.skipped = 0
        """Number of ticks that were dropped."""
        self.late_s = 0.0
        """Seconds by which the next deadline had passed at the latest `take`, before any ticks were dropped."""
        self._catch_up = catch_up_ticks(rate)
        self._slot = 0
        self._in_a_row = 0

    @property
    def deadline(self) -> float:
        """Deadline of the next tick, in seconds."""
        return self.start + self._slot / self.rate

    @property
    def skipped_s(self) -> float:
        """Seconds of all dropped ticks."""
        return self.skipped / self.rate

    def take(self, now: float) -> float | None:
        """Takes the tick to run now. Returns its deadline, or None if no tick is due."""
        deadline = self.deadline
        if deadline > now:
            self._in_a_row = 0
            return None
        self.late_s = now - deadline
        if self._in_a_row < self._catch_up and self.start + (self._slot + 1) / self.rate > now:  # no other one is due
            self._slot += 1
            self._in_a_row = 0
            return deadline
        self._drop(now, self._catch_up - self._in_a_row)
        deadline = self.deadline
        self._slot += 1
        self._in_a_row = self._in_a_row + 1 if self.deadline <= now else 0
        return deadline

    def _drop(self, now: float, keep: int) -> None:
        """Drops all passed deadlines except for the latest `keep` of them."""
        to_come = max(self._slot, int((now - self.start) * self.rate))  # may be too large or too small by one
        while self.start + (to_come - 1) / self.rate > now:
            to_come -= 1
        while self.start + to_come / self.rate <= now:
            to_come += 1
        dropped = max(to_come - self._slot - keep, 0)
        self._slot += dropped
        self.skipped += dropped


class Ticker:
    """Runs ticks by a `Schedule`, and measures how late they begin and how long they take.

    Args:
        rate: ticks per second.
        tick: the function to run, called with its deadline and the current time, in seconds.
        broken: called once when `FAILURES_MAX` ticks in a row have raised. No tick runs after that.
        alarm: makes a timer that calls the given function.
        faults: where ticks that raise are reported.
        clock: returns the current time in seconds.
        paused: whether no tick runs before `resume`.
        yields: whether a tick that takes longer than the time between two is followed by as much time for others, such
            as the tickers of other worlds. Otherwise the next tick runs as soon as the event loop has run once.
    """

    def __init__(
        self,
        rate: int,
        tick: Callable[[float, float], None],
        broken: Callable[[], None],
        alarm: Callable[[Callable[[], None]], Alarm],
        faults: FaultReporter | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        paused: bool = False,
        yields: bool = False,
    ) -> None:
        self.lateness = Histogram()
        self.work = Histogram()
        self.ticks = 0
        self.ticks_late = 0
        self.failures = 0
        self.overruns = 0
        """Number of ticks that took longer than the time between two."""
        self.latest = -math.inf
        """Time in seconds at which the latest tick began."""
        self._tick = tick
        self._broken = broken
        self._faults = faults or FaultReporter()
        self._clock = clock
        self._failures_in_a_row = 0
        self._make_alarm = alarm
        self._yields, self._not_before = yields, -math.inf
        self._alarm: Alarm | None = None
        self._schedule = Schedule(rate, clock())
        if not paused:
            self._start()

    def resume(self, phase: float) -> None:
        """Lets ticks run. Does nothing if they do.

        Args:
            phase: part of the tick's time, from 0 to 1, by which the deadlines are after the whole multiples of it, so
                that the ticks of several tickers can be spread.
        """
        if self._alarm is None:
            rate, skipped = self._schedule.rate, self._schedule.skipped
            first = (math.floor(self._clock() * rate - phase) + 1 + phase) / rate
            self._schedule = Schedule(rate, first)
            self._schedule.skipped = skipped
            self._start()

    def stop(self) -> None:
        """Stops the ticker. No tick runs after this, unless it is resumed."""
        if self._alarm is not None:
            self._alarm.close()
            self._alarm = None

    def _start(self) -> None:
        self._alarm = self._make_alarm(self._ring)
        self._alarm.set(self._schedule.deadline)

    @property
    def skipped_s(self) -> float:
        """Seconds of all dropped ticks."""
        return self._schedule.skipped_s

    def stats(self) -> dict[str, Any]:
        """Returns the figures of the ticker since the start. `histogram.between` computes those of a period."""
        return {
            "ticks": self.ticks,
            "ticks_late": self.ticks_late,
            "ticks_failed": self.failures,
            "skipped_s": round(self._schedule.skipped_s, 6),
            "tick_lateness_ms": self.lateness.summary(),
            "tick_lateness_counts": self.lateness.counts(),
            "tick_work_ms": self.work.summary(),
        }

    def _ring(self) -> None:
        if self._alarm is None:
            return
        now = self._clock()
        deadline = self._schedule.take(now)
        if deadline is not None:
            self._run(deadline, now)
        if self._alarm is not None:
            self._alarm.set(max(self._schedule.deadline, self._not_before))

    def _run(self, deadline: float, now: float) -> None:
        self.latest = now
        late_s = self._schedule.late_s
        self.lateness.record(late_s)
        if late_s * self._schedule.rate > 1:
            self.ticks_late += 1
        try:
            self._tick(deadline, now)
        except Exception:
            self._failed()
        else:
            self._failures_in_a_row = 0
        work_s = self._clock() - now
        self.work.record(work_s)
        self.ticks += 1
        if work_s * self._schedule.rate > 1:
            self.overruns += 1
            if self._yields:
                self._not_before = now + 2 * work_s

    def _failed(self) -> None:
        self.failures += 1
        self._failures_in_a_row += 1
        self._faults.report("a tick")
        if self._failures_in_a_row == FAILURES_MAX:
            self.stop()
            self._broken()
