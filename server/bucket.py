"""A limit of events per second that allows bursts."""


class Bucket:
    """A limit of events per second that allows bursts.

    Args:
        rate: events per second.
        burst: events at once.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, 0.0

    def take(self, now: float, count: float = 1.0) -> bool:
        """Takes a number of events. Returns False if there are too many."""
        self._left, self._at = min(self._left + max(now - self._at, 0.0) * self._rate, self._burst), now
        if self._left < count:
            return False
        self._left -= count
        return True
