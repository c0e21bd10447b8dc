r"""When is it on the server, and how far ahead of it to live.

Theory of operation. Let a clock's phase be its tick minus `rate` times the local time: constant, but for drift.
`ServerClock` estimates the server's phase from pings; of those, the third with the least round trip are the ones
that stood in no queue, and their median is the estimate.

Either clock may step: a server that stood still drops the ticks that it missed, and a computer that slept halts its
monotonic clock. A pong bounds the phase without any assumption about the path: the server read its time after the
ping was sent and before the pong arrived. A snapshot bounds it from below. So a bound that contradicts the ones before
proves a step; the samples from before it are void, and pings follow each other quickly again. What the lead has
learned of stalls stays right, while the needs of the moment have to be learned anew (`LeadController.step`).

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

from shared.bounds import UPDATE_S

PINGS = 5
PING_FIRST_S = 0.1
PING_LATER_S = 1.0
PINGS_KEPT = 15
STEP_S = 0.1
"""Two bounds may contradict each other by this much, in seconds, for the clocks drift and programs read them late."""


class ServerClock:
    """The server's time in ticks, by local time."""

    def __init__(self) -> None:
        self.rate = 0.0
        self._samples: deque[tuple[float, float]] = deque(maxlen=PINGS_KEPT)  # round trip, phase
        self._least, self._most = -math.inf, math.inf  # the phase is between these, by the samples
        self._answers = 0
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
        return self.rate > 0 and self._answers >= PINGS

    def answered(self, sent: float, tick: float, now: float) -> float:
        """Takes the answer to a ping sent at `sent`: the server's time in ticks. Returns by how many ticks that steps.

        The answers to pings sent before a step say nothing after it: drop them.
        """
        if not sent <= now:
            return 0.0
        least, most = tick - self.rate * now, tick - self.rate * sent
        if step := self._step(least, most):
            return step
        self._answers += 1
        self._samples.append((now - sent, tick - self.rate * (sent + now) / 2))
        bounds = [(phase - rtt_s * self.rate / 2, phase + rtt_s * self.rate / 2) for rtt_s, phase in self._samples]
        self._least, self._most = max(least for least, _ in bounds), min(most for _, most in bounds)
        by_rtt = sorted(self._samples)
        best = sorted(phase for _, phase in by_rtt[: (len(by_rtt) + 2) // 3])
        self.phase = best[len(best) // 2]
        self.rtt_s = by_rtt[0][0]
        self.spread_s = by_rtt[-1][0] - by_rtt[0][0]
        return 0.0

    def seen(self, tick: int, now: float) -> float:
        """Takes the tick of a snapshot, which the server has reached. Returns by how many ticks its time steps."""
        least = tick - self.rate * now
        return 0.0 if least <= self._most else self._step(least, math.inf)

    def _step(self, least: float, most: float) -> float:
        """Sets the phase anew if it cannot be between these and within the bounds known before."""
        slack = STEP_S * self.rate if self._samples else 0.0
        if not (least > self._most + slack or most < self._least - slack):
            return 0.0
        before = self.phase
        self.phase = self._most = min(least + self.rtt_s / 2 * self.rate, most)
        self._least = -math.inf
        self._samples.clear()
        self._sent, self._next = 0, -math.inf
        return self.phase - before

    def tick(self, now: float) -> float:
        """The server's time in ticks."""
        return self.rate * now + self.phase


def jump_ticks(rate: float) -> float:
    """Returns the least difference of two phases that counts as a jump: `JUMP_S`, at least one tick."""
    return max(JUMP_S * rate, 1.0)


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

    def step(self, clock: ServerClock) -> float:
        """The server's time has stepped: returns the phase to go on with."""
        ...


FASTER, HURRY = 0.10, 0.50
"""The timeline runs at most `FASTER` off real time, and by up to `HURRY` ahead while every input comes late."""
JUMP_S = 0.3125
"""Where the path is further than this from where the timeline is, in seconds, it jumps."""
START_S = 0.0625
"""What the first lead has on top of the path as it was measured, in seconds."""
SLOWER_S = 2.0
"""Cover that is not needed any more is given up with this time constant."""
LATELY_S, LATELY_MIN = 0.09375, 3
"""Inputs that came late for this long (at least so many) are no stall: the last ones of a stall come in its burst, and
early."""
PRICE_S = 6.25
"""What it is worth that no input comes late, in seconds of lead: half a percent of them is worth 31 ms, a tick at
32 Hz."""
SAFETY_S = 0.03 / 32
"""Seconds on top of what was needed,"""
SURPRISE_S = 0.15 / 32
"""and, at most, on top of what a rising path needs that was not foreseen."""
STALL_S = 0.25
"""With two round trips on top: the longest stall that a loss makes, and the shortest change of the path."""
CALM_S = 5.0
SHIFT_S = 0.5 / 32
"""The base is the least need of `CALM_S`, unless that of a stall's length is more than `SHIFT_S` higher."""
MEMORY_S = 120.0
FIRST_S = 20.0
"""Until there have been inputs for so long, shares are of this; the fewer there were, the more is kept for safety."""
FINE_RATE = 32.0
"""At fewer ticks per second, the three above stay the share of a tick that they are at this rate."""
FIRST_INPUTS_S, FIRST_INPUTS_MIN = 0.5, 8
"""The lead stays as it began until inputs of this length (at least so many) have been learned from."""
SPREAD_S_MAX = 0.5
"""A pong that took longer than that waited for a program that was busy (loading, compiling), not for the path."""
NEEDS_S, NEEDS_MIN = 32.0, 1024
"""Needs are kept for this long (at least so many), and at least half of them; what is left must hold two stalls."""
REVIEW_S = 0.25
"""How often the cover is thought over."""
SLOW_S = 0.1
"""A program that makes an input this late, in seconds, three times in a row is slow: that was no hitch."""


class PricedLead:
    """The lead that would have been the best of the last two minutes, late inputs having a price.

    Args:
        price_s: of all inputs being late, in seconds of lead.
        safety_s: seconds on top of the cover.
        stall_s: see `STALL_S`.
    """

    def __init__(self, price_s: float = PRICE_S, safety_s: float = SAFETY_S, stall_s: float = STALL_S) -> None:
        self._price_s = price_s
        self._safety_s = safety_s
        self._stall_s = stall_s
        self._rtt_s = 0.0
        self._in_ticks(1.0)
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

    def _in_ticks(self, rate: float) -> None:
        """Expresses all times in ticks, or in inputs, of which there is one per tick."""
        self._rate = rate
        self._price, self._jump = self._price_s * rate, jump_ticks(rate)
        fine = max(rate, FINE_RATE)
        self._safety, self._surprise, self._shift_up = self._safety_s * fine, SURPRISE_S * fine, SHIFT_S * fine
        self._lately = max(math.ceil(LATELY_S * rate), LATELY_MIN)
        self._first = max(math.ceil(FIRST_INPUTS_S * rate), FIRST_INPUTS_MIN)
        self._needs_max = max(math.ceil(NEEDS_S * rate), NEEDS_MIN)
        self._reviews = math.ceil(REVIEW_S * rate)

    def start(self, clock: ServerClock, now: float) -> float:
        """Half the round trip, all the jitter there was (up to a bound), and a little more."""
        if clock.rate != self._rate:
            self._in_ticks(clock.rate)
        self._measure(clock.rtt_s)
        jitter = min(clock.spread_s, SPREAD_S_MAX)
        return clock.phase + (clock.rtt_s / 2 + jitter + START_S) * clock.rate

    def step(self, clock: ServerClock) -> float:
        """Forgets the needs, some of which may be from after the step, and keeps the excesses. See `LeadController`."""
        self._needs.clear()
        self._least.clear()
        self._calmest, self._fresh = math.inf, 0
        self._base = clock.phase + (clock.rtt_s / 2 + START_S) * clock.rate
        return self._base + (self._cover or 0.0) + self._safety

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
        self._base = least if least > calm + self._shift_up else calm
        if len(needs) >= 2 * stall:  # all stalls that could contain the input of `stall` ago are known
            base = max(leasts[-stall:])
            self._remember(needs[-stall] - (base if base > calm + self._shift_up else calm))
        if len(needs) > self._needs_max:
            del needs[: self._needs_max // 2], leasts[: self._needs_max // 2]

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """See `LeadController`."""
        if clock.rtt_s != self._rtt_s:
            self._measure(clock.rtt_s)
        inputs = len(self._excess)
        if inputs < self._first or not self._needs:
            return phase
        base, level = self._base, self._level
        known = inputs / (FIRST_S * self._rate)
        safety = self._safety + min(self._safety / known, self._surprise)
        cover = phase - base - safety if self._cover is None else self._cover
        kept = max(1 - elapsed / (SLOWER_S * self._rate), 0.0)
        self._cover = cover = level + max(cover - level, 0.0) * kept
        now_needed = min(self._needs[-self._lately :])
        surprise = now_needed - base - cover
        target = base + cover + safety
        if surprise > 0:
            target = target + surprise + min(surprise, self._surprise)
        way = target - phase
        if base + safety - phase > self._jump or way < -self._jump:
            return target
        fastest = HURRY if now_needed > phase else FASTER
        return phase + max(-FASTER * elapsed, min(way, fastest * elapsed))

    def _measure(self, rtt_s: float) -> None:
        self._rtt_s = rtt_s
        self._stall = min(math.ceil((self._stall_s + 2 * rtt_s) * self._rate), self._needs_max // 4)
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
            self._review = self._reviews if len(excesses) > self._first else 0
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
    """The client's own tick: continuous, a little ahead of the server.

    It is ahead by what the path needs, which a `LeadController` says, and by `own` ticks for a program that is slow:
    the inputs of one update leave together, the first of them long after its time.
    """

    def __init__(self, rate: float, phase: float, now: float) -> None:
        self.rate = rate
        self.phase = phase
        self.own = 0.0
        self._steered = now
        self._late = (0.0, 0.0, 0.0)

    def tick(self, now: float) -> float:
        """Ticks, whole and fraction."""
        return self.rate * now + self.phase

    def when(self, tick: float) -> float:
        """The local time at which a tick is reached, as things stand."""
        return (tick - self.phase) / self.rate

    def made(self, late: float, now: float) -> None:
        """Takes notice that the first input of an update was made `late` ticks after its time.

        If that is much, the next may be late by as much as updates are apart.
        """
        slow = late > SLOW_S * self.rate
        self._late = (*self._late[1:], max(late, (now - self._steered) * self.rate) if slow else 0.0)

    def steer(self, lead: LeadController, clock: ServerClock, now: float) -> bool:
        """Goes where the controller wants. Returns whether that was a jump."""
        before = self.phase
        elapsed = max(now - self._steered, 0.0) * self.rate
        self._steered = now
        path = lead.steer(before - self.own, elapsed, clock, now)
        if self.own or min(self._late) > SLOW_S * self.rate:
            self._follow_program(elapsed)
        self.phase = path + self.own
        return abs(self.phase - before) > jump_ticks(self.rate)

    def _follow_program(self, elapsed: float) -> None:
        """Follows how late the program makes inputs: up at once, down slowly."""
        least = min(self._late)
        slow = min(max(self._late), 2 * least, UPDATE_S * self.rate) if least > SLOW_S * self.rate else 0.0
        self.own = max(slow, self.own - FASTER * elapsed)
