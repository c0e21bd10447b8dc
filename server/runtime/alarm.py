"""Alarms: timers that call a function at a time, by which ticks run."""

import asyncio
import ctypes
import os
import sys
import time
from bisect import insort
from collections.abc import Callable
from typing import Protocol


class Alarm(Protocol):
    """A timer that calls a function once, at or after a time of `time.monotonic()`."""

    def set(self, at: float) -> None:
        """Sets the time in seconds and replaces the one set before. A time in the past means now."""

    def close(self) -> None:
        """Stops the timer."""


class LoopAlarm:
    """A timer of the event loop. Exists everywhere; about 0.6 ms late (p99 1.5 ms) at a timer resolution of 1 ms."""

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
    """A Linux timerfd that the event loop reads. About 0.1 ms late (p99 0.3 ms).

    It is created with ctypes because `os.timerfd_create` needs Python 3.13.

    Raises:
        OSError: the system has no timerfd.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        if sys.platform != "linux" or ctypes.sizeof(ctypes.c_long) != 8:
            raise OSError("timerfd: for 64-bit Linux only")
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._fd = self._libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        # struct itimerspec: interval (0: fires once) and value, each in seconds and nanoseconds; a value of 0 disarms.
        self._spec = (ctypes.c_long * 4)()
        self._loop = loop
        self._ring = ring
        loop.add_reader(self._fd, self._read)

    def set(self, at: float) -> None:
        self._spec[2], self._spec[3] = divmod(max(1, int(at * 1e9)), 1_000_000_000)
        timer_abstime = 1
        if self._libc.timerfd_settime(self._fd, timer_abstime, self._spec, None) < 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime")

    def close(self) -> None:
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _read(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:  # the timer was set again after it was reported ready
            return
        self._ring()


def best_alarm(loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> Alarm:
    """Returns the most punctual timer that this system and this event loop offer."""
    try:
        return TimerfdAlarm(loop, ring)
    except (OSError, AttributeError, NotImplementedError):
        return LoopAlarm(loop, ring)


ROUND_S = 0.005
"""Seconds after which no further alarm of a shared timer rings before the event loop has run once."""


class SharedTimer:
    """Many alarms on one timer: the timer rings when the first of them is due, and then all that are due by now ring.

    Each alarm rings once at most before the event loop goes on, so ticks of one world that is behind do not hold up the
    other worlds. After `ROUND_S` the event loop goes on as well, so that messages do not wait for the ticks of all
    worlds. Then the remaining alarms ring at once, the earliest first.

    Args:
        make: makes the timer, which calls the given function.
        clock: returns the current time in seconds.
    """

    def __init__(
        self, make: Callable[[Callable[[], None]], Alarm], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._make, self._clock = make, clock
        self._timer: Alarm | None = None
        self._alarms = 0
        """Number of alarms that are open."""
        self._queue: list[tuple[float, int, _SharedAlarm]] = []
        """Alarms by time. A number makes each entry different. An entry counts if it is the latest one of its alarm."""
        self._number = 0
        self._ringing = False

    def alarm(self, ring: Callable[[], None]) -> Alarm:
        """Returns a new alarm, which calls a function."""
        if self._timer is None:
            self._timer = self._make(self._ring)
        self._alarms += 1
        return _SharedAlarm(self, ring)

    def put(self, at: float, alarm: "_SharedAlarm") -> int:
        """Adds an entry for an alarm. Returns its number."""
        self._number += 1
        entry = at, self._number, alarm
        if not self._queue or at >= self._queue[-1][0]:  # the usual case: a tick's time after all others
            self._queue.append(entry)
        else:
            insort(self._queue, entry)
        if not self._ringing and self._queue[0] is entry:
            self._set()
        return self._number

    def end(self) -> None:
        """Notes that an alarm is closed. The timer is closed with the last one."""
        self._alarms -= 1
        if not self._alarms and self._timer is not None:
            self._timer.close()
            self._timer = None
            self._queue.clear()

    def _ring(self) -> None:
        now, n = self._clock(), 0
        while n < len(self._queue) and self._queue[n][0] <= now:
            n += 1
        due, self._queue[:n] = self._queue[:n], []
        self._ringing = True
        try:
            while due:
                _, number, alarm = due.pop(0)
                if alarm.number == number:
                    alarm.ring()
                    if self._clock() - now >= ROUND_S:
                        break
        finally:
            self._ringing = False
            for entry in due:
                insort(self._queue, entry)
            self._set()

    def _set(self) -> None:
        """Sets the timer to the time of the first alarm."""
        if self._queue and self._timer is not None:
            self._timer.set(self._queue[0][0])


class _SharedAlarm:
    """An alarm of a shared timer."""

    def __init__(self, timer: SharedTimer, ring: Callable[[], None]) -> None:
        self._timer = timer
        self.ring = ring
        self.number = 0
        """Number of its entry in the timer's queue; 0: not set; negative: it is closed."""

    def set(self, at: float) -> None:
        self.number = self._timer.put(at, self)

    def close(self) -> None:
        if self.number >= 0:
            self.number = -1
            self._timer.end()
