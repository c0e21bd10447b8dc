r"""The client's estimate of the server time, and its own timeline, which runs ahead of the server.

Theory of operation. The *phase* of a clock is its tick minus `rate` times the local time: a constant, apart from drift.
`ServerClock` estimates the server's phase from pings. The third of the pings with the shortest round trips waited in no
queue; their median is the estimate.

Both clocks may step: a server that stood still drops the ticks that it missed, and a computer that sleeps stops its
monotonic clock. A pong bounds the phase without any assumption about the path, because the server read its time after
the ping was sent and before the pong arrived. A snapshot bounds it from below. A bound that contradicts the earlier
ones therefore proves a step. Then the samples from before the step are void, and pings follow each other quickly again.
What the lead has learned about stalls stays valid, but the current needs have to be learned again
(`LeadController.step`).

The client sends an input for tick t when its own *timeline* reaches t, and the server reports by how many ticks the
input was early: its margin. The timeline's phase at that moment minus the margin is the phase that would just have been
enough: the *need* of this input. The need depends on the path alone, not on where the timeline was. So the client's own
adjustments cancel out of the measurement, exactly and at once, and the loop cannot oscillate, however long the round
trip is.

`PricedLead` splits a need into the *base*, which is the path as it is now, and the *excess* of this one input:

    need    |\      |\     ____                 base     morphological opening: rises only if the need stays high for
            | \     | \   |    |    |\                   longer than a retransmission takes (a spike, a queue, a new
    base  __|  \____|  \__|    |____| \____              route)
             loss    loss  spike   loss         excess   loss (a retransmission, then a burst) and jitter

The timeline follows the base, up and down alike, at up to 10 % faster or slower than real time. The base lasts long
enough to be followed, so no lead has to be paid in advance for a rare second of it. A retransmission is over before
either side can know of it; it can only be covered in advance, and whether that pays depends on how often it happens and
how long it takes. So a late input has a price in ticks of lead. Of the excesses of the last minutes, those are covered
that are worth it: the *cover* is the lead with the least sum of itself and the price of the inputs that stay late.

Rejected: a fixed share of late inputs in place of the price (0.5 %, as it was). It cuts off a bounded jitter that costs
next to nothing to cover, and on a bad path it pays nine ticks for the last third of a percent, whose retransmissions
are lost as well. Cover rises at once and falls slowly.
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
"""Number of pings that follow each other quickly; the clock is ready when all of them are answered."""
PING_FIRST_S = 0.1
"""Time between two of the first pings, in seconds."""
PING_LATER_S = 1.0
"""Time between two later pings, in seconds."""
PINGS_KEPT = 15
"""Number of the newest pongs that the estimate uses."""
STEP_S = 0.1
"""Contradiction between two bounds that is tolerated, in seconds, because clocks drift and programs read them late."""


class ServerClock:
    """An estimate of the server time in ticks, as a function of the local time.

    `rate` is the tick rate in ticks per second (0: not known yet), `phase` the server's phase in ticks, `rtt_s` the
    shortest round trip of the kept pongs, and `spread_s` the difference between their longest and shortest one.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self._samples: deque[tuple[float, float]] = deque(maxlen=PINGS_KEPT)  # round trip, phase
        self._least, self._most = -math.inf, math.inf  # bounds of the phase, from the samples
        self._answers = 0
        self._sent = 0
        self._next = 0.0
        self.phase = 0.0
        self.rtt_s = 0.0
        self.spread_s = 0.0

    def due(self, now: float) -> bool:
        """Returns whether to send a ping now, and counts it as sent if so. False as long as `rate` is not known."""
        if self.rate == 0 or now < self._next:
            return False
        self._sent += 1
        self._next = now + (PING_FIRST_S if self._sent < PINGS else PING_LATER_S)
        return True

    @property
    def next_ping(self) -> float:
        """The local time at which the next ping is due, in seconds; `inf` as long as `rate` is not known."""
        return self._next if self.rate else math.inf

    @property
    def ready(self) -> bool:
        """Whether enough pings were answered for an estimate."""
        return self.rate > 0 and self._answers >= PINGS

    def answered(self, sent: float, tick: float, now: float) -> float:
        """Takes the answer to a ping.

        Do not pass answers to pings that were sent before a step: they describe the time before it.

        Args:
            sent: local time at which the ping was sent, in seconds.
            tick: the server time in the answer, in ticks.
            now: local time at which the answer arrived, in seconds.

        Returns:
            By how many ticks the server's time has stepped; 0 if it has not.
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
        """Takes the tick of a snapshot, which the server has reached. Returns by how many ticks its time has stepped.

        The result is 0 if the time has not stepped.
        """
        least = tick - self.rate * now
        return 0.0 if least <= self._most else self._step(least, math.inf)

    def _step(self, least: float, most: float) -> float:
        """Sets a new phase if `least` and `most` contradict the known bounds. Returns the step in ticks, or 0."""
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
        """Returns the server time at the local time `now`, in ticks."""
        return self.rate * now + self.phase


def jump_ticks(rate: float) -> float:
    """Returns the smallest difference of two phases that counts as a jump, in ticks: `JUMP_S`, at least one tick."""
    return max(JUMP_S * rate, 1.0)


class LeadController(Protocol):
    """A controller of the timeline's phase, which decides how far the client runs ahead of the server.

    All phases and margins are in ticks.
    """

    def start(self, clock: ServerClock, now: float) -> float:
        """Returns the phase to begin with, before any input was sent."""
        ...

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """Takes the arrival margin of one input.

        Args:
            tick: the tick of the input.
            margin: by how many ticks the input arrived before its deadline; negative if it was late.
            phase: the timeline's phase when the input was sent.
            now: local time in seconds.
        """

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Returns the new phase, `elapsed` ticks after the last call. Called once per update."""
        ...

    def step(self, clock: ServerClock) -> float:
        """Takes a step of the server's time. Returns the phase to go on with."""
        ...


FASTER, HURRY = 0.10, 0.50
"""Greatest deviation of the timeline from real time, as a share of it: `FASTER` in both directions, and `HURRY` forward
while every input is late."""
JUMP_S = 0.3125
"""Distance in seconds between the timeline and the phase that the path needs, beyond which the timeline jumps."""
START_S = 0.0625
"""Reserve of the first lead on top of the measured path, in seconds."""
SLOWER_S = 2.0
"""Time constant with which cover that is no longer needed is given up, in seconds."""
LATELY_S, LATELY_MIN = 0.09375, 3
"""The least need of the inputs of the last `LATELY_S` seconds, at least `LATELY_MIN` inputs, is the need of the path
now. A stall does not raise it, because the last inputs of a stall arrive in its burst, and early."""
PRICE_S = 6.25
"""Price of all inputs being late, in seconds of lead: half a percent of late inputs costs 31 ms, a tick at 32 Hz."""
SAFETY_S = 0.03 / 32
"""Reserve on top of base and cover, in seconds."""
SURPRISE_S = 0.15 / 32
"""Greatest additional reserve in seconds: while the path needs more than base and cover, or few inputs are known."""
STALL_S = 0.25
"""Time in seconds which, with two round trips added, is the longest stall that a loss makes, and the shortest change
of the path."""
CALM_S = 5.0
"""Time whose least need is the base, in seconds, unless the path has changed within it (`SHIFT_S`)."""
SHIFT_S = 0.5 / 32
"""Smallest change of the path, in seconds: if the least need within the length of a stall is higher than the base by
more than this, it is the new base."""
MEMORY_S = 120.0
"""Time for which excesses are kept, in seconds."""
FIRST_S = 20.0
"""Shortest time that shares of late inputs refer to, in seconds. With fewer inputs than that, the reserve is larger."""
FINE_RATE = 32.0
"""Tick rate, in ticks per second, below which `SAFETY_S`, `SURPRISE_S` and `SHIFT_S` no longer shrink in ticks: they
stay the share of a tick that they are at this rate."""
FIRST_INPUTS_S, FIRST_INPUTS_MIN = 0.5, 8
"""Inputs to learn from before the first lead is changed: those of `FIRST_INPUTS_S` seconds, at least
`FIRST_INPUTS_MIN`."""
SPREAD_S_MAX = 0.5
"""Greatest jitter that the first lead believes, in seconds: a pong that took longer waited for a busy program (loading,
compiling), not for the path."""
NEEDS_S, NEEDS_MIN = 32.0, 1024
"""Limit of the needs that are kept: those of `NEEDS_S` seconds, at least `NEEDS_MIN`. Beyond it the older half is
deleted, and the rest must hold two stalls."""
REVIEW_S = 0.25
"""Time between two computations of the cover, in seconds."""
SLOW_S = 0.1
"""A program that makes an input this late, in seconds, three times in a row counts as slow; once or twice may be a
short delay."""


class PricedLead:
    """The controller that sets the lead which would have been best in the last two minutes, given a price of lateness.

    Args:
        price_s: price of all inputs being late, in seconds of lead.
        safety_s: reserve on top of the cover, in seconds.
        stall_s: length of a stall without the two round trips, in seconds (`STALL_S`).
    """

    def __init__(self, price_s: float = PRICE_S, safety_s: float = SAFETY_S, stall_s: float = STALL_S) -> None:
        self._price_s = price_s
        self._safety_s = safety_s
        self._stall_s = stall_s
        self._rtt_s = 0.0
        self._in_ticks(1.0)
        self._stall = 1  # number of inputs in the longest stall
        self._calm = 1  # number of inputs whose least need is the base
        self._needs: list[float] = []  # the newest needs, as phases
        self._least: list[float] = []  # for each need: the least of it and those of the stall before it
        self._calmest = math.inf  # the least of the newest `_calm` needs
        self._fresh = 0  # number of further inputs for which `_calmest` stays one of the newest `_calm` needs
        self._excess: deque[float] = deque()  # excesses, oldest first
        self._ordered = array("d")  # excesses, ascending
        self._prices: npt.NDArray[np.float64] = np.zeros(0)  # price of n late inputs, at index n
        self._base = 0.0
        self._level = 0.0
        self._review = 0
        self._cover: float | None = None

    def _in_ticks(self, rate: float) -> None:
        """Converts all times to ticks, or to numbers of inputs: one per tick."""
        self._rate = rate
        self._price, self._jump = self._price_s * rate, jump_ticks(rate)
        fine = max(rate, FINE_RATE)
        self._safety, self._surprise, self._shift_up = self._safety_s * fine, SURPRISE_S * fine, SHIFT_S * fine
        self._lately = max(math.ceil(LATELY_S * rate), LATELY_MIN)
        self._first = max(math.ceil(FIRST_INPUTS_S * rate), FIRST_INPUTS_MIN)
        self._needs_max = max(math.ceil(NEEDS_S * rate), NEEDS_MIN)
        self._reviews = math.ceil(REVIEW_S * rate)

    def start(self, clock: ServerClock, now: float) -> float:
        """Returns the first phase: half the round trip, the measured jitter (at most `SPREAD_S_MAX`), and `START_S`."""
        if clock.rate != self._rate:
            self._in_ticks(clock.rate)
        self._measure(clock.rtt_s)
        jitter = min(clock.spread_s, SPREAD_S_MAX)
        return clock.phase + (clock.rtt_s / 2 + jitter + START_S) * clock.rate

    def step(self, clock: ServerClock) -> float:
        """Takes a step of the server's time. Returns the phase to go on with.

        Forgets the needs, because some may already be from after the step, and keeps the excesses.
        """
        self._needs.clear()
        self._least.clear()
        self._calmest, self._fresh = math.inf, 0
        self._base = clock.phase + (clock.rtt_s / 2 + START_S) * clock.rate
        return self._base + (self._cover or 0.0) + self._safety

    def observe(self, tick: int, margin: float, phase: float, now: float) -> None:
        """Takes the arrival margin of one input: learns the base, and the excess of an input one stall earlier."""
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
        if len(needs) >= 2 * stall:  # every stall that could contain the input `stall` inputs ago is complete
            base = max(leasts[-stall:])
            self._remember(needs[-stall] - (base if base > calm + self._shift_up else calm))
        if len(needs) > self._needs_max:
            del needs[: self._needs_max // 2], leasts[: self._needs_max // 2]

    def steer(self, phase: float, elapsed: float, clock: ServerClock, now: float) -> float:
        """Returns the new phase: towards base, cover and reserve, at a bounded speed, or there at once if it jumps."""
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
        """Searches the least of the newest `_calm` needs again; happens once in dozens of inputs."""
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
        """Returns the best cover: the excess with the least sum of itself and the price of the excesses above it."""
        ordered, known = self._ordered, len(self._ordered)
        if len(self._prices) != known:
            self._prices = self._price * (np.arange(known) / max(known, FIRST_S * self._rate))
        # More late inputs than `most` cost more than any cover can save, so only these candidates are compared: 10 of
        # 3,840, for example (1.6 us; all of them would take 11 us).
        most = int(self._prices.searchsorted(ordered[-1] - ordered[0], "right")) + 1
        falling = np.frombuffer(ordered)[: -most - 1 : -1]
        return float(falling[(falling + self._prices[:most]).argmin()])


class Timeline:
    """The client's own time in ticks: continuous, and ahead of the server.

    It is ahead by the lead that a `LeadController` sets for the path, plus `own` ticks for a slow program: such a
    program sends the inputs of one update together, the first of them long after its time.
    """

    def __init__(self, rate: float, phase: float, now: float) -> None:
        self.rate = rate
        self.phase = phase
        self.own = 0.0
        self._steered = now
        self._late = (0.0, 0.0, 0.0)

    def tick(self, now: float) -> float:
        """Returns the timeline's tick at the local time `now`, with a fraction."""
        return self.rate * now + self.phase

    def when(self, tick: float) -> float:
        """Returns the local time at which `tick` is reached if the phase stays as it is, in seconds."""
        return (tick - self.phase) / self.rate

    def made(self, late: float, now: float) -> None:
        """Notes that the first input of an update was made `late` ticks after its time.

        If that is more than `SLOW_S`, the next input may be as late as the time between two updates.
        """
        slow = late > SLOW_S * self.rate
        self._late = (*self._late[1:], max(late, (now - self._steered) * self.rate) if slow else 0.0)

    def steer(self, lead: LeadController, clock: ServerClock, now: float) -> bool:
        """Moves the phase to where the controller wants it. Returns whether that was a jump."""
        before = self.phase
        elapsed = max(now - self._steered, 0.0) * self.rate
        self._steered = now
        path = lead.steer(before - self.own, elapsed, clock, now)
        if self.own or min(self._late) > SLOW_S * self.rate:
            self._follow_program(elapsed)
        self.phase = path + self.own
        return abs(self.phase - before) > jump_ticks(self.rate)

    def _follow_program(self, elapsed: float) -> None:
        """Adapts `own` to how late the program makes inputs: it rises at once and falls slowly."""
        least = min(self._late)
        slow = min(max(self._late), 2 * least, UPDATE_S * self.rate) if least > SLOW_S * self.rate else 0.0
        self.own = max(slow, self.own - FASTER * elapsed)
