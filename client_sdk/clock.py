r"""When is it on the server, and how far ahead of it to live.

Theory of operation. Let a clock's phase be its tick minus `rate` times the local time: constant, but for drift.
`ServerClock` estimates the server's phase from pings; of those, the third with the least round trip are the ones
that stood in no queue, and their median is the estimate.

An input for tick t is sent when the client's own *timeline* reaches t, and the server tells by how many ticks it
was early: its margin. The timeline's phase at that moment minus the margin is the phase that would just have done:
the input's *need*. It does not depend on where the timeline was, only on the path; so the client's own corrections
cancel out of the measurement, exactly and at once, and the loop cannot oscillate however long the round trip is.

`PricedLead` splits a need into the *base*, which is the path as it is now, and the *excess* of this one input:

    need    |\      |\     ____                 base     morphological opening: raised only by what holds for longer
            | \     | \   |    |    |\                  than a retransmission takes, i.e. a spike, a queue, a new route
    base  __|  \____|  \__|    |____| \____     excess   loss (a retransmission, then a burst) and jitter
             loss    loss  spike   loss

The base is followed, up and down alike, at up to 10 % faster or slower than real time. No lead chosen in advance
should pay for a rare second of it, and it lasts long enough to be followed. A retransmission is over before anybody
knows of it: it can only be covered in advance, and whether that is worth it is a matter of how often and of how much.
So a late input has a price in ticks of lead, and of the excesses of the last minutes those are covered that are worth
it: the cover is the lead with the least sum of itself and the price of what comes late. A stated share of late inputs
in its place (0.5 %, as it was) cuts a bounded jitter off that costs next to nothing to cover, and pays nine ticks on a
bad path for the last third of a percent, whose retransmissions are lost as well. Cover rises at once and falls slowly.
"""

import math
from array import array
from bisect import bisect_left, insort
from collections import deque
from typing import Protocol

import numpy as np
import numpy.typing as npt

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


FASTER, HURRY, JUMP = 0.10, 0.50, 10.0
"""The timeline runs at most `FASTER` off real time, and by up to `HURRY` ahead while every input comes late; where
the path is more than `JUMP` ticks from where the timeline is, it jumps."""
SLOWER_S = 2.0
"""Cover that is not needed any more is given up with this time constant."""
LATELY = 3
"""So many inputs in a row that came late are no stall: the last ones of a stall come in its burst, and early."""
PRICE = 200.0
"""What it is worth that no input comes late, in ticks of lead: half a percent of them is worth one."""
SAFETY = 0.03
"""Ticks on top of what was needed,"""
SURPRISE = 0.15
"""and, at most, on top of what a rising path needs that was not foreseen."""
STALL_S = 0.25
"""With two round trips on top: the longest stall that a loss makes, and the shortest change of the path."""
CALM_S = 5.0
SHIFT = 0.5
"""The base is the least need of so many seconds, unless that of a stall's length is so many ticks higher."""
MEMORY_S = 120.0
FIRST_S = 20.0
"""Until there have been inputs for so long, shares are of this; the fewer there were, the more is kept for safety."""
FIRST_INPUTS = 16
SPREAD_S_MAX = 0.5
"""A pong that took longer than that waited for a program that was busy (loading, compiling), not for the path."""
NEEDS_MAX = 1024
"""So many needs are kept, and at least half of them; what is left must hold two stalls."""
REVIEW = 8
"""The cover is thought over after so many inputs."""


class PricedLead:
    """The lead that would have been the best of the last two minutes, late inputs having a price.

    Args:
        price: of all inputs being late, in ticks of lead.
        safety: ticks on top of the cover.
        stall_s: see `STALL_S`.
    """

    def __init__(self, price: float = PRICE, safety: float = SAFETY, stall_s: float = STALL_S) -> None:
        self._price = price
        self._safety = safety
        self._stall_s = stall_s
        self._rate = 0.0
        self._rtt_s = 0.0
        self._stall = 1  # inputs in the longest stall
        self._calm = 1  # inputs in which the least need is the base
        self._needs: list[float] = []  # the newest ones, as phases
        self._least: list[float] = []  # of each of these and the stall before it
        self._calmest = math.inf  # the least of the newest `_calm` needs,
        self._fresh = 0  # which is still one of these after so many further inputs
        self._excess: deque[float] = deque()
        self._ordered = array("d")
        self._prices: npt.NDArray[np.float64] = np.zeros(0)  # of so many inputs being late
        self._base = 0.0
        self._level = 0.0
        self._review = 0
        self._cover: float | None = None

    def start(self, clock: ServerClock, now: float) -> float:
        """Half the round trip, all the jitter there was (up to a bound), and two ticks."""
        self._rate = clock.rate
        self._measure(clock)
        jitter = min(clock.spread_s, SPREAD_S_MAX)
        return clock.phase + (clock.rtt_s / 2 + jitter) * clock.rate + 2.0

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """See `LeadController`."""
        needs, leasts, stall = self._needs, self._least, self._stall
        need = phase - margin
        needs.append(need)
        least = min(needs[-stall:])
        leasts.append(least)
        if need <= self._calmest:
            self._calmest, self._fresh = need, self._calm - 1
        elif self._fresh > 0:
            self._fresh -= 1
        else:
            self._look_back()
        calm = self._calmest
        self._base = least if least > calm + SHIFT else calm
        if len(needs) >= 2 * stall:  # all stalls that could contain the input of `stall` ago are known
            base = max(leasts[-stall:])
            self._remember(needs[-stall] - (base if base > calm + SHIFT else calm))
        if len(needs) > NEEDS_MAX:
            del needs[: NEEDS_MAX // 2], leasts[: NEEDS_MAX // 2]
            self._calmest, self._fresh = -math.inf, 0  # at 128 ticks a second, it may have gone with them

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """See `LeadController`."""
        if clock.rtt_s != self._rtt_s:
            self._measure(clock)
        inputs = len(self._excess)
        if inputs < FIRST_INPUTS:
            return phase
        base, level = self._base, self._level
        known = inputs / (FIRST_S * self._rate)
        safety = self._safety + min(SAFETY / known, SURPRISE)
        cover = phase - base - safety if self._cover is None else self._cover
        kept = max(1 - elapsed / (SLOWER_S * self._rate), 0.0)
        self._cover = cover = level + max(cover - level, 0.0) * kept
        now_needed = min(self._needs[-LATELY:])
        surprise = now_needed - base - cover
        target = base + cover + safety
        if surprise > 0:
            target = target + surprise + min(surprise, SURPRISE)
        way = target - phase
        if base + safety - phase > JUMP or way < -JUMP:
            return target
        fastest = HURRY if now_needed > phase else FASTER
        return phase + max(-FASTER * elapsed, min(way, fastest * elapsed))

    def _measure(self, clock: ServerClock) -> None:
        self._rtt_s = clock.rtt_s
        self._stall = min(math.ceil((self._stall_s + 2 * clock.rtt_s) * clock.rate), NEEDS_MAX // 4)
        calm = max(int(CALM_S * self._rate), self._stall)
        if calm != self._calm:
            self._calm, self._calmest, self._fresh = calm, -math.inf, 0

    def _look_back(self) -> None:
        """Finds the least of the newest needs anew: once in dozens of inputs."""
        newest = self._needs[: -self._calm - 1 : -1]
        self._calmest = min(newest)
        self._fresh = self._calm - 1 - newest.index(self._calmest)

    def _remember(self, excess: float) -> None:
        excesses = self._excess
        excesses.append(excess)
        insort(self._ordered, excess)
        if len(excesses) > MEMORY_S * self._rate:
            del self._ordered[bisect_left(self._ordered, excesses.popleft())]
        self._review -= 1
        if self._review < 0:
            self._review = REVIEW if len(excesses) > FIRST_INPUTS else 0
            self._level = self._best()

    def _best(self) -> float:
        """The excess that is best covered: with it, those above are late."""
        ordered, known = self._ordered, len(self._ordered)
        if len(self._prices) != known:
            self._prices = self._price * (np.arange(known) / max(known, FIRST_S * self._rate))
        # With more late than this, they cost more than all that there is to save: of 3,840, say, 10 are looked at
        # (1.6 us, all of them 11).
        most = int(self._prices.searchsorted(ordered[-1] - ordered[0], "right")) + 1
        falling = np.frombuffer(ordered)[: -most - 1 : -1]
        return float(falling[(falling + self._prices[:most]).argmin()])


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
