r"""The lead: how far ahead of the server a client makes its inputs, learned from their arrival margins.

Theory of operation. The client sends an input for tick t when its own *timeline* reaches t, and the server reports by
how many ticks the input was early: its margin. The timeline's phase (its tick minus the tick rate times the local time)
at that moment minus the margin is the phase that would just have been enough: the *need* of this input. The need
depends on the path alone, not on where the timeline was. So the client's own adjustments cancel out of the measurement,
exactly and at once, and the loop cannot oscillate, however long the round trip is.

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
from typing import Protocol

from client_sdk.timing.server_clock import ServerClock
from shared.priced import FIRST_S, MEMORY_S, PRICE_S, Excesses

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
        self._excesses = Excesses(0.0, 0.0, 0.0)
        self._in_ticks(1.0)
        self._stall = 1  # number of inputs in the longest stall
        self._calm = 1  # number of inputs whose least need is the base
        self._needs: list[float] = []  # the newest needs, as phases
        self._least: list[float] = []  # for each need: the least of it and those of the stall before it
        self._calmest = math.inf  # the least of the newest `_calm` needs
        self._fresh = 0  # number of further inputs for which `_calmest` stays one of the newest `_calm` needs
        self._base = 0.0
        self._level = 0.0
        self._review = 0
        self._cover: float | None = None

    def _in_ticks(self, rate: float) -> None:
        """Converts all times to ticks, or to numbers of inputs: one per tick."""
        self._rate = rate
        self._jump = jump_ticks(rate)
        excesses = self._excesses
        excesses.price, excesses.first, excesses.most = self._price_s * rate, FIRST_S * rate, MEMORY_S * rate
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
        inputs = len(self._excesses)
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
        excesses = self._excesses
        excesses.add(excess)
        self._review -= 1
        if self._review < 0:
            self._review = self._reviews if len(excesses) > self._first else 0
            self._level = excesses.best()
