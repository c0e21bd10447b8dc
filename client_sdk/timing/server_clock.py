"""The client's estimate of the server time.

Theory of operation. The *phase* of a clock is its tick minus `rate` times the local time: a constant, apart from drift.
`ServerClock` estimates the server's phase from pings. The third of the pings with the shortest round trips waited in no
queue; their median is the estimate.

Both clocks may step: a server that stood still drops the ticks that it missed, and a computer that sleeps stops its
monotonic clock. A pong bounds the phase without any assumption about the path, because the server read its time after
the ping was sent and before the pong arrived. A snapshot bounds it from below. A bound that contradicts the earlier
ones therefore proves a step. Then the samples from before the step are void, and pings follow each other quickly again.
What the lead has learned about stalls stays valid, but the current needs have to be learned again
(`client_sdk.timing.lead.LeadController.step`).
"""

import math
from collections import deque

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
