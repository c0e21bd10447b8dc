"""Where the others are drawn: between two confirmed snapshots, a little in the past.

The delay rises at once by what was missing when a snapshot came late. Once all is well again it falls: slowly while it
is short, since paths that stall do so time and again, and the faster the further it is above `LONG_S`. Motion that is
shown late then looks up to twice as fast, but never jumps or goes back.

What the rules do takes effect at the tick of the snapshot that tells of it, and no sooner: until then an entity that
they placed is drawn where it was, one that they removed is still drawn, one that they changed looks as before, and one
that is new is not drawn. `server.rewind` answers shots by the same rule. Beyond the newest snapshot, entities go on by
their velocities, for less than a tick: the next one may bring anything.
"""

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from shared.layout import ID, VX, Int64s, X
from shared.units import BLOCK, SPEED

KEPT_S, KEPT_MIN = 3.0, 16
"""Confirmed states are kept for this long, in seconds, and at least so many."""
EXTRAPOLATE_S = 0.1
"""Bound on the time beyond the newest snapshot that is drawn; it is also less than one tick."""
FALL_S_PER_S = 0.01
CALM_S = 3.0
"""The delay begins to fall after this long without a late snapshot, in seconds."""
LONG_S = 0.2
"""What the delay has above this, in seconds, falls at `LONG_FALL` seconds per second, and `LONG_SHARE` of itself more,
after `LONG_CALM_S`; at most at `FALL_MAX`."""
LONG_FALL, LONG_SHARE, LONG_CALM_S, FALL_MAX = 0.05, 0.5, 1.0, 1.0

Positions = npt.NDArray[np.float64]
Entry = tuple[int, Int64s, frozenset[int]]
"""The tick of a snapshot, the states at its end, and the entities placed since the one before."""


class Interpolation:
    """A short history of confirmed states, and the moment in it that is shown."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._states: deque[Entry] = deque(maxlen=max(math.ceil(KEPT_S * rate), KEPT_MIN))
        self.delay_ticks = 2.0
        self._calm_since = self._at = -math.inf

    def push(self, tick: int, states: Int64s, placed: frozenset[int] = frozenset()) -> None:
        """Adds a snapshot to the history.

        Args:
            tick: the one that it ends.
            states: the confirmed states, [n, 12], ascending by id.
            placed: the entities that the rules placed since the snapshot before.
        """
        self._states.append((tick, states, placed))

    def advance(self, server_tick: float, now: float) -> None:
        """Adapts the delay to how old the newest snapshot is now."""
        if not self._states:
            return
        if self._at == -math.inf:
            self._calm_since = self._at = now
        short = (server_tick - self.delay_ticks) - self._states[-1][0]
        if short > 0:
            self.delay_ticks += short
            self._calm_since = now
        elif (fall := self._fall(now - self._calm_since)) > 0:
            self.delay_ticks = max(1.0, self.delay_ticks - max(min((now - self._at) * fall * self._rate, -short), 0.0))
        self._at = now

    def _fall(self, calm_s: float) -> float:
        """How fast the delay falls after so much calm, in seconds per second."""
        long_s = self.delay_ticks / self._rate - LONG_S
        if long_s > 0 and calm_s > LONG_CALM_S:
            return min(LONG_FALL + LONG_SHARE * long_s, FALL_MAX)
        return FALL_S_PER_S if calm_s > CALM_S else 0.0

    def shift(self, ticks: float) -> None:
        """The server's time has stepped by so many ticks. What is shown does not go back for it."""
        if ticks < 0:
            self.delay_ticks = max(self.delay_ticks + ticks, 1.0)

    def shown(self, server_tick: float) -> float:
        """The moment that is drawn, as a tick: no earlier than the history, less than a tick beyond it."""
        at = server_tick - self.delay_ticks
        if not self._states:
            return at
        oldest, newest = self._states[0][0], self._states[-1][0]
        latest = min(newest + EXTRAPOLATE_S * self._rate, math.nextafter(newest + 1, newest))
        return latest if at > latest else max(oldest, at)

    def sample(self, server_tick: float) -> tuple[Int64s, Positions]:
        """States and positions (blocks, [n, 3]) of all entities as they are to be drawn: as they were when `shown`."""
        if not self._states:
            return np.zeros((0, 12), np.int64), np.zeros((0, 3))
        at = self.shown(server_tick)
        before = after = self._states[-1]
        for entry in reversed(self._states):
            before = entry
            if entry[0] <= at:
                break
            after = entry
        tick, states, _ = before
        if at > tick and after is not before:
            return _between(before, after, at)
        return states, states[:, X : X + 3] / BLOCK + states[:, VX : VX + 3] / SPEED * ((at - tick) / self._rate)


def _between(before: Entry, after: Entry, at: float) -> tuple[Int64s, Positions]:
    """States and positions at a moment between two snapshots: those who are there before it, on their ways."""
    share = (at - before[0]) / (after[0] - before[0])
    states, new = before[1], after[1]
    places = states[:, X : X + 3] / BLOCK
    if not len(new):
        return states, places
    place = np.searchsorted(new[:, ID], states[:, ID])
    place[place == len(new)] = 0
    moves = new[place, ID] == states[:, ID]
    if after[2]:
        moves &= ~np.isin(states[:, ID], list(after[2]))
    was = places[moves]
    places[moves] = was + (new[place[moves], X : X + 3] / BLOCK - was) * share
    return states, places
