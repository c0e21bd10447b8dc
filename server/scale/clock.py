"""The clock of an edge, which follows the arrival of records.

Theory of operation. Processes share no clock. The earliest records of the last one or two seconds say at which of the
edge's own times a tick of the sequencer ends. The edge takes the inputs of a tick a *lead* before that, so that its
batch is with the sequencer in time. The lead grows after each late batch, and falls slowly.
"""

import math

LEAD_S = 0.008
"""Minimum lead in seconds."""
LEAD_MORE, LEAD_LESS_S, LEAD_S_MAX = 1.5, 0.000002, 0.1
"""Factor of the lead after a late batch; seconds by which it falls per tick; maximum lead in seconds."""
WINDOW_S = 1.0
"""Length of the two windows in which the earliest record counts, in seconds."""


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
        self.restart()

    def restart(self) -> None:
        """Forgets the arrivals so far, because another sequencer with other times has begun."""
        self._phase = self._before = -math.inf
        self._window_ends = -math.inf

    def arrived(self, tick: int, missing: int, now: float) -> None:
        """Notes the arrival of a record.

        Args:
            tick: tick of the record.
            missing: ticks from the edge's newest batch in the record to its tick; 0: the batch was in time.
            now: the current time in seconds.
        """
        if now >= self._window_ends:
            self._before, self._phase = self._phase, -math.inf
            self._window_ends = now + WINDOW_S
        self._phase = max(self._phase, tick - now * self._rate)
        self.late += missing > 0
        self.lead_s = min(max(self.lead_s - LEAD_LESS_S, LEAD_S) * (LEAD_MORE if missing else 1), LEAD_S_MAX)

    def due(self, tick: int) -> float:
        """Returns the time in seconds at which the inputs of a tick are to be taken."""
        return (tick - max(self._phase, self._before)) / self._rate - self.lead_s
