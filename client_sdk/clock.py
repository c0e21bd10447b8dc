"""When is it on the server, and how far ahead of it to live.

Theory of operation. Let a clock's phase be its tick minus `rate` times the local time: constant, but for drift.
`ServerClock` estimates the server's phase from pings; of those, the third with the least round trip are the ones
that stood in no queue, and their median is the estimate.

An input for tick t is sent when the client's own *timeline* reaches t, and the server tells by how many ticks it
was early: its margin. Margin minus the timeline's phase at that moment does not depend on where the timeline was,
only on the path; so the client's own corrections cancel out of the measurement, exactly and at once, and the loop
cannot oscillate however long the round trip is. `QuantileLead` keeps these and asks for the least phase at which
(all but outliers of) them would have been on time; the timeline goes there: up at once, at most 10 % faster than
real time, down slowly, and with a jump only where the way is longer than 10 ticks.
"""

import heapq
import math
from collections import deque
from typing import Protocol

PINGS = 5
PING_FIRST_S = 0.1
PING_LATER_S = 1.0
PINGS_KEPT = 15


class ServerClock:
    """The server's time in ticks, by local time."""

    def __init__(self) -> None:
        self.rate = 0.0
        self._samples: deque[tuple[float, float]] = deque(maxlen=PINGS_KEPT)  # round trip, phase
        self._sent = 0
        self._next = 0.0
        self.phase = 0.0
        self.rtt_s = 0.0
        self.spread_s = 0.0

    def due(self, now: float) -> bool:
        """Whether to send a ping now (not before `rate` is known); if so, it counts as sent."""
        if self.rate == 0 or now < self._next:
            return False
        self._sent += 1
        self._next = now + (PING_FIRST_S if self._sent < PINGS else PING_LATER_S)
        return True

    @property
    def next_ping(self) -> float:
        """Local time at which the next ping is due."""
        return self._next if self.rate else math.inf

    @property
    def ready(self) -> bool:
        """Whether enough pings have come back."""
        return self.rate > 0 and len(self._samples) >= PINGS

    def answered(self, sent: float, tick: float, now: float) -> None:
        """A ping sent at `sent` came back with the server's time."""
        if not sent <= now:
            return
        self._samples.append((now - sent, tick - self.rate * (sent + now) / 2))
        by_rtt = sorted(self._samples)
        best = sorted(phase for _, phase in by_rtt[: (len(by_rtt) + 2) // 3])
        self.phase = best[len(best) // 2]
        self.rtt_s = by_rtt[0][0]
        self.spread_s = by_rtt[-1][0] - by_rtt[0][0]

    def tick(self, now: float) -> float:
        """The server's time in ticks."""
        return self.rate * now + self.phase


class LeadController(Protocol):
    """Steers the phase of the timeline: how far ahead of the server to live."""

    def start(self, clock: ServerClock, now: float) -> float:
        """The phase to begin with, before any input has been sent."""
        ...

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """The input for `tick`, sent while the timeline had `phase`, came `margin` ticks before its deadline."""

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """The new phase, `elapsed` ticks after the last call. Called once per update."""
        ...


FASTER, SLOWER, JUMP = 0.10, 0.01, 10.0
"""The timeline runs at most so much faster or slower than real time; it jumps where the way is this many ticks."""


class QuantileLead:
    """The least lead at which the inputs of the last seconds would have been on time, outliers left out.

    Args:
        window: how many of the newest inputs count.
        outliers: how many of the worst of these may be ignored, if they stand out by more than `gap` ticks.
        safety: ticks added on top.
    """

    def __init__(self, window: int = 320, outliers: int = 3, gap: float = 2.0, safety: float = 0.5) -> None:
        self._paths: deque[float] = deque(maxlen=window)
        self._target: float | None = None
        self._outliers = outliers
        self._gap = gap
        self._safety = safety

    def start(self, clock: ServerClock, now: float) -> float:
        """Half the round trip, all the jitter there was, and two ticks."""
        return clock.phase + (clock.rtt_s / 2 + clock.spread_s) * clock.rate + 2.0

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """See `LeadController`."""
        self._paths.append(margin - phase)
        self._target = None

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """See `LeadController`."""
        if self._target is None and len(self._paths) >= 16:
            self._target = self._safety - self._level()
        if self._target is None:
            return phase
        way = self._target - phase
        if abs(way) > JUMP:
            return self._target
        return phase + max(-SLOWER * elapsed, min(way, FASTER * elapsed))

    def _level(self) -> float:
        worst = heapq.nsmallest(self._outliers + 1, self._paths)
        level = worst[-1]
        for path in reversed(worst):
            if level - path > self._gap:
                break
            level = path
        return level


class Timeline:
    """The client's own tick: continuous, a little ahead of the server."""

    def __init__(self, rate: float, phase: float, now: float) -> None:
        self.rate = rate
        self.phase = phase
        self._steered = now

    def tick(self, now: float) -> float:
        """Ticks, whole and fraction."""
        return self.rate * now + self.phase

    def when(self, tick: float) -> float:
        """The local time at which a tick is reached, as things stand."""
        return (tick - self.phase) / self.rate

    def steer(self, lead: LeadController, clock: ServerClock, now: float) -> bool:
        """Goes where the controller wants; whether that was a jump."""
        before = self.phase
        elapsed = max(now - self._steered, 0.0) * self.rate
        self._steered = now
        self.phase = lead.steer(before, elapsed, clock, now)
        return abs(self.phase - before) > JUMP
