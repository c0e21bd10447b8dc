"""The clock of an edge, which follows the arrival of records.

Theory of operation. Processes share no clock. The earliest records of the last one or two seconds say at which of the
edge's own times a tick of the sequencer ends. The edge takes the inputs of a tick a *lead* before that, so that its
batch is with the sequencer in time. A record says by how much the batches in it were early: their margins. The time at
which a batch was sent plus its margin is the latest time that would have been enough, so its *need* is the time from
then to the end of its tick, whatever the lead was. The lead is learned from the needs of the last two minutes, as a
client's is from those of its inputs: a late batch has a price (`shared.priced`).
"""

import math

from shared.priced import FIRST_S, MEMORY_S, PRICE_S, Excesses

LEAD_S = 0.008
"""Lead as long as no margins are known, in seconds."""
LEAD_S_MIN, LEAD_S_MAX = 0.002, 0.1
"""Minimum and maximum lead in seconds."""
SAFETY_S = 0.001
"""Reserve on top of the needs, in seconds."""
LEARN_S = 0.5
"""Time whose batches have to be known before the lead is learned, in seconds."""
REVIEW_S = 0.25
"""Time between two computations of the lead, in seconds."""
FALL_S_PER_S = 0.002
"""Speed at which the lead falls, in seconds per second."""
WINDOW_S = 1.0
"""Length of the two windows in which the earliest record counts, in seconds."""
STEP_S, STEP_TICKS = 0.1, 8
"""The sequencer's time has stepped if the latest `STEP_TICKS` records are all later than before by `STEP_S` seconds."""
SENT_MAX = 64
"""Maximum number of batches whose times are kept."""


class EdgeClock:
    """The deadlines of an edge.

    Args:
        rate: ticks per second.
    """

    def __init__(self, rate: int) -> None:
        self._rate = rate
        self.lead_s = LEAD_S
        self.late = 0
        """Records that lacked the batch of their tick."""
        self._needs = Excesses(PRICE_S, FIRST_S * rate, MEMORY_S * rate)
        self._sent: dict[int, float] = {}
        self._review = self._level = 0.0
        self.restart()

    def restart(self) -> None:
        """Forgets the arrivals so far, because another sequencer with other times has begun."""
        self._phase = self._before = self._latest = -math.inf
        self._behind = 0
        self._window_ends = -math.inf
        self._sent.clear()

    def sent(self, tick: int, now: float) -> None:
        """Notes the time in seconds at which the batch of a tick was sent."""
        if len(self._sent) >= SENT_MAX:
            self._sent.clear()
        self._sent[tick] = now

    def arrived(self, tick: int, missing: int, now: float) -> None:
        """Notes the arrival of a record.

        Args:
            tick: tick of the record.
            missing: ticks from the edge's newest batch in the record to its tick; 0: the batch was in time.
            now: the current time in seconds.
        """
        phase = tick - now * self._rate
        if now >= self._window_ends:
            self._before, self._phase = self._phase, -math.inf
            self._window_ends = now + WINDOW_S
        if phase < max(self._phase, self._before) - STEP_S * self._rate:
            self._latest = max(self._latest, phase) if self._behind else phase
            self._behind += 1
            if self._behind >= STEP_TICKS:
                self._before, self._phase, self._behind = -math.inf, self._latest, 0
        else:
            self._behind = 0
        self._phase = max(self._phase, phase)
        self.late += missing > 0

    def learn(self, number: int, margin_s: float) -> None:
        """Learns from the margin of a batch that is in a record. Call it after `arrived`.

        Args:
            number: the tick of the batch.
            margin_s: time by which it was early for that tick at the sequencer, in seconds; negative: it was late.
        """
        for old in [old for old in self._sent if old <= number]:
            came = self._sent.pop(old) + margin_s - (number - old) / self._rate  # those before came at the same time
            need = self._ends(old) - came
            if need < LEAD_S_MAX:  # otherwise it is one that no lead covers: a batch that was sent again
                self._needs.add(need)
        if len(self._needs) < LEARN_S * self._rate:
            return
        self._review -= 1 / self._rate
        if self._review <= 0:
            self._review, self._level = REVIEW_S, self._needs.best() + SAFETY_S
        falls = FALL_S_PER_S / self._rate
        self.lead_s = min(max(self._level, self.lead_s - falls, LEAD_S_MIN), LEAD_S_MAX)

    def due(self, tick: int) -> float:
        """Returns the time in seconds at which the inputs of a tick are to be taken."""
        return self._ends(tick) - self.lead_s

    def _ends(self, tick: int) -> float:
        """Returns the time in seconds at which the record of a tick comes if it is as early as the earliest ones."""
        return (tick - max(self._phase, self._before)) / self._rate
