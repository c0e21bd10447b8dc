"""Fixed ticks against absolute deadlines.

Overrun policy. Ticks are due at `start + n / rate`, whatever became of the ones before, so nothing drifts. A tick
whose time has passed runs at once, with one pass of the event loop between two of them, so that what has arrived
meanwhile is taken in. At most `limits.catch_up_ticks` run in a row that way. Of more missed deadlines the earliest are
dropped, before any of the row runs, and counted as skipped time: so the deadline that a tick is handed always says what
time it is on the server. A server at 32 Hz that was stopped for 3 s runs 4 ticks at once and goes on; one that is too
slow for its rate is never more than that behind, and says so in `skipped_s`.
"""

import asyncio
import ctypes
import math
import os
import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

from server.config.limits import catch_up_ticks
from server.observability.errors import Faults
from server.observability.histogram import Histogram

FAILURES_MAX = 10
"""So many ticks that raise in a row break the ticker."""


class Schedule:
    """Which tick is due when. Deadlines are computed from whole numbers, so they do not drift."""

    def __init__(self, rate: int, start: float) -> None:
        self.rate = rate
        self.start = start
        self.skipped = 0
        """Ticks that were dropped."""
        self.late_s = 0.0
        """How long the latest tick taken had been due, before any were dropped."""
        self._catch_up = catch_up_ticks(rate)
        self._slot = 0
        self._in_a_row = 0

    @property
    def deadline(self) -> float:
        """When the next tick is due."""
        return self.start + self._slot / self.rate

    @property
    def skipped_s(self) -> float:
        """Time that no tick stands for."""
        return self.skipped / self.rate

    def take(self, now: float) -> float | None:
        """The deadline of the tick to run now, or None if none is due."""
        deadline = self.deadline
        if deadline > now:
            self._in_a_row = 0
            return None
        self.late_s = now - deadline
        self._drop(now, self._catch_up - self._in_a_row)
        deadline = self.deadline
        self._slot += 1
        self._in_a_row = self._in_a_row + 1 if self.deadline <= now else 0
        return deadline

    def _drop(self, now: float, keep: int) -> None:
        """Drops the earliest of the deadlines that have passed, but for `keep` of them."""
        to_come = max(self._slot, int((now - self.start) * self.rate))  # may be one off, either way
        while self.start + (to_come - 1) / self.rate > now:
            to_come -= 1
        while self.start + to_come / self.rate <= now:
            to_come += 1
        dropped = max(to_come - self._slot - keep, 0)
        self._slot += dropped
        self.skipped += dropped


class Alarm(Protocol):
    """Calls back once, at or after a time of `time.monotonic()`."""

    def set(self, at: float) -> None:
        """Replaces the time set before; one that has passed is now."""

    def close(self) -> None:
        """It does not ring any more."""


class LoopAlarm:
    """An alarm of the event loop: there everywhere, about 0.6 ms late (p99 1.5) at a timer resolution of 1 ms."""

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        self._loop = loop
        self._ring = ring
        self._handle: asyncio.TimerHandle | None = None

    def set(self, at: float) -> None:
        self.close()
        self._handle = self._loop.call_later(max(0.0, at - time.monotonic()), self._ring)

    def close(self) -> None:
        if self._handle is not None:
            self._handle.cancel()


class TimerfdAlarm:
    """A Linux timerfd that the event loop reads: about 0.1 ms late (p99 0.3).

    By ctypes, since `os.timerfd_create` needs Python 3.13.

    Raises:
        OSError: the system has none.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        if sys.platform != "linux" or ctypes.sizeof(ctypes.c_long) != 8:
            raise OSError("timerfd: for 64-bit Linux only")
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._fd = self._libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        self._loop = loop
        self._ring = ring
        loop.add_reader(self._fd, self._read)

    def set(self, at: float) -> None:
        # struct itimerspec: interval (none: it rings once) and value, in seconds and nanoseconds; a value of 0 disarms.
        seconds, ns = divmod(max(1, int(at * 1e9)), 1_000_000_000)
        spec = (ctypes.c_long * 4)(0, 0, seconds, ns)
        timer_abstime = 1
        if self._libc.timerfd_settime(self._fd, timer_abstime, spec, None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime")

    def close(self) -> None:
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _read(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:  # set anew since it was reported ready
            return
        self._ring()


def best_alarm(loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> Alarm:
    """The most punctual alarm that this system and this loop have."""
    try:
        return TimerfdAlarm(loop, ring)
    except (OSError, AttributeError, NotImplementedError):
        return LoopAlarm(loop, ring)


class Ticker:
    """Runs `tick(deadline, now)` by a `Schedule`, and measures how late ticks start and how long they take.

    Args:
        broken: called once when `FAILURES_MAX` ticks in a row have raised; no tick runs after that.
        alarm: makes an alarm that calls the function handed to it.
        faults: told of ticks that raise.
    """

    def __init__(
        self,
        rate: int,
        tick: Callable[[float, float], None],
        broken: Callable[[], None],
        alarm: Callable[[Callable[[], None]], Alarm],
        faults: Faults | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.lateness = Histogram()
        self.work = Histogram()
        self.ticks = 0
        self.ticks_late = 0
        self.failures = 0
        self.latest = -math.inf
        """When the latest tick began."""
        self._tick = tick
        self._broken = broken
        self._faults = faults or Faults()
        self._clock = clock
        self._failures_in_a_row = 0
        self._stopped = False
        self._alarm = alarm(self._ring)
        self._schedule = Schedule(rate, clock())
        self._alarm.set(self._schedule.deadline)

    def stop(self) -> None:
        """No tick runs after this."""
        if not self._stopped:
            self._stopped = True
            self._alarm.close()

    def stats(self) -> dict[str, Any]:
        """What it has counted. Times are since the start; for those of a window, see `histogram.between`."""
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
        if self._stopped:
            return
        now = self._clock()
        deadline = self._schedule.take(now)
        if deadline is not None:
            self._run(deadline, now)
        if not self._stopped:
            self._alarm.set(self._schedule.deadline)

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
        self.work.record(self._clock() - now)
        self.ticks += 1

    def _failed(self) -> None:
        self.failures += 1
        self._failures_in_a_row += 1
        self._faults.report("a tick")
        if self._failures_in_a_row == FAILURES_MAX:
            self.stop()
            self._broken()
