"""A reserve of time with a price: how much of it is worth paying, given how often less would have been enough.

Theory of operation. Something that comes too late has a price, in time that everything else would wait instead. Of the
excesses of the last minutes, those are covered that are worth it: the best cover is the reserve with the least sum of
itself and the price of what stays late. A client covers its inputs like this, and an edge its batches.
"""

from array import array
from bisect import bisect_left, insort
from collections import deque

PRICE_S = 6.25
"""Price of all inputs being late, in seconds of lead: half a percent of late inputs costs 31 ms, a tick at 32 Hz."""
MEMORY_S = 120.0
"""Time for which excesses are kept, in seconds."""
FIRST_S = 20.0
"""Shortest time that shares of late inputs refer to, in seconds. With fewer inputs than that, the reserve is larger."""


class Excesses:
    """The excesses of the last minutes: by how much more than the least each one needed, in any unit.

    Args:
        price: price of all being late, in that unit.
        first: least number that shares refer to.
        most: number that are kept.
    """

    def __init__(self, price: float, first: float, most: float) -> None:
        self.price, self.first, self.most = price, first, most
        self._known: deque[float] = deque()  # oldest first
        self._ordered = array("d")  # ascending

    def __len__(self) -> int:
        return len(self._known)

    def add(self, excess: float) -> None:
        """Keeps an excess, and drops the oldest one if there are too many."""
        self._known.append(excess)
        insort(self._ordered, excess)
        if len(self._known) > self.most:
            del self._ordered[bisect_left(self._ordered, self._known.popleft())]

    def best(self) -> float:
        """Returns the best cover: the excess with the least sum of itself and the price of those above it."""
        ordered, known = self._ordered, len(self._ordered)
        shown = max(known, self.first)
        # Late inputs that cost more than any cover can save end the search: 10 of 3,840, for example.
        save = ordered[-1] - ordered[0]
        best, least = ordered[-1], ordered[-1]
        for late in range(1, known):
            cost = self.price * (late / shown)
            cover = ordered[-1 - late]
            if cover + cost < least:
                best, least = cover, cover + cost
            if cost > save:
                break
        return best
