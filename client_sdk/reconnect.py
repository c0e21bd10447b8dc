"""The times at which a client tries to reconnect: soon at first, then less and less often, until its patience ends."""

import math

FIRST_S = 0.25
"""Wait before the first attempt, in seconds, unless the server asked for a wait."""
ELSEWHERE_S = 0.05
"""Longest wait before an attempt at another server of the same world that was not tried yet, in seconds."""
LONGEST_S = 4.0
"""Longest wait between two attempts, in seconds."""
DOUBLINGS = 4
"""Number of times that the wait doubles until it is the longest."""
GOLDEN = 0.6180339887
"""The golden ratio's fraction, which spreads the waits evenly."""


class Reconnect:
    """The reconnect attempts of one client.

    Args:
        patience_s: the client gives up this long after the loss, in seconds, not counting waits that the server asked
            for; 0: it does not try at all.
        spread: any whole number. Clients with different numbers wait up to a quarter longer, so that they do not all
            reconnect at once.
    """

    def __init__(self, patience_s: float, spread: int = 0) -> None:
        self.patience_s = patience_s
        self.spread = spread
        self.retry_at = math.inf
        """Local time of the next attempt, in seconds; `inf`: no attempt is planned."""
        self._lost_at = math.inf
        self._until = math.inf
        self._failed = 0

    def lost(self, now: float, wait_s: float = 0.0, *, elsewhere: bool = False) -> bool:
        """Takes the loss of the connection, or a failed attempt, and plans the next attempt.

        Args:
            now: local time in seconds.
            wait_s: time for which the server asked not to connect, in seconds.
            elsewhere: whether the next attempt leads to a server that was not tried yet, so that it need not wait.

        Returns:
            Whether there will be another attempt.
        """
        self._lost_at = min(self._lost_at, now)
        delay = min(FIRST_S * 2 ** min(self._failed, DOUBLINGS), LONGEST_S) if self._failed or not wait_s else 0.0
        if elsewhere:
            wait_s = 0.0
        else:
            self._failed += 1
        share = (self.spread * GOLDEN + self._failed * GOLDEN**2) % 1.0
        due = now + (ELSEWHERE_S * share if elsewhere else (wait_s + delay) * (1 + share / 4))
        # Waits that the server asked for do not use up the patience.
        self._until = min(self._until, now + self.patience_s) + wait_s * (1 + share / 4)
        if self.patience_s <= 0 or due > self._until:
            self.retry_at = math.inf
            return False
        self.retry_at = due
        return True

    def plan(self, at: float) -> None:
        """Plans an attempt for a local time in seconds."""
        self.retry_at = at

    def trying(self) -> None:
        """Notes that an attempt has begun."""
        self.retry_at = math.inf

    def away_s(self, now: float) -> float:
        """Returns the time since the connection was lost, in seconds; 0 if it is not lost."""
        return now - self._lost_at if self._lost_at < math.inf else 0.0

    def back(self) -> None:
        """Notes that the client has reconnected, and forgets the failed attempts."""
        self.retry_at = self._lost_at = self._until = math.inf
        self._failed = 0
