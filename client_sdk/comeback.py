"""When to try again after a lost connection: soon at first, ever more rarely, and not for ever."""

import math

FIRST_S = 0.25
LONGEST_S = 4.0
DOUBLINGS = 4
"""Of the wait, until it is the longest."""
GOLDEN = 0.6180339887


class Comeback:
    """One client's attempts to come back.

    Args:
        patience_s: so long after the loss it gives up, waits that the server asked for aside; 0: it does not even try.
        spread: any whole number; waits of clients with different ones differ by up to a quarter, so that they do not
            all come back at once.
    """

    def __init__(self, patience_s: float, spread: int = 0) -> None:
        self.patience_s = patience_s
        self.spread = spread
        self.retry_at = math.inf
        """Local time of the next attempt."""
        self._lost_at = math.inf
        self._until = math.inf
        self._failed = 0

    def lost(self, now: float, wait_s: float = 0.0) -> bool:
        """The connection is gone, or could not be made, and should not be tried for `wait_s`; whether it will be."""
        self._lost_at = min(self._lost_at, now)
        delay = min(FIRST_S * 2 ** min(self._failed, DOUBLINGS), LONGEST_S) if self._failed or not wait_s else 0.0
        self._failed += 1
        share = (self.spread * GOLDEN + self._failed * GOLDEN**2) % 1.0
        due = now + (wait_s + delay) * (1 + share / 4)
        # The time in which the server is not to be tried is not taken from the patience.
        self._until = min(self._until, now + self.patience_s) + wait_s * (1 + share / 4)
        if self.patience_s <= 0 or due > self._until:
            self.retry_at = math.inf
            return False
        self.retry_at = due
        return True

    def trying(self) -> None:
        """An attempt is under way."""
        self.retry_at = math.inf

    def away_s(self, now: float) -> float:
        """Since when, in seconds."""
        return now - self._lost_at if self._lost_at < math.inf else 0.0

    def back(self) -> None:
        """It has worked."""
        self.retry_at = self._lost_at = self._until = math.inf
        self._failed = 0
