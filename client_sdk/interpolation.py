"""Where the others are drawn: between two confirmed snapshots, a little in the past.

The delay rises at once by what was missing when a snapshot came late, and falls slowly once all is well again;
beyond the newest snapshot motion goes on for at most 100 ms, then it holds.
"""

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from shared.layout import ID, Int64s, X
from shared.units import BLOCK

KEPT = 96
EXTRAPOLATE_S = 0.1
FALL_S_PER_S = 0.01
CALM_S = 3.0
TELEPORT_BLOCKS = 2.0
"""What goes further than this in one tick is not drawn on its way."""

Positions = npt.NDArray[np.float64]


class Interpolation:
    """A short history of confirmed states, and the moment in it that is shown."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._states: deque[tuple[int, Int64s]] = deque(maxlen=KEPT)
        self.delay_ticks = 2.0
        self._calm_since = self._at = -math.inf

    def push(self, tick: int, states: Int64s) -> None:
        """The confirmed states ([n, 12], ascending by id) at the end of a tick."""
        self._states.append((tick, states))

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
        elif now - self._calm_since > CALM_S:
            fall = min((now - self._at) * FALL_S_PER_S * self._rate, -short)
            self.delay_ticks = max(1.0, self.delay_ticks - max(fall, 0.0))
        self._at = now

    def shown(self, server_tick: float) -> float:
        """The moment that is drawn, as a tick: no earlier than the history, at most 100 ms beyond it."""
        at = server_tick - self.delay_ticks
        if not self._states:
            return at
        oldest, latest = self._states[0][0], self._states[-1][0] + EXTRAPOLATE_S * self._rate
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
        if after[0] == before[0] and len(self._states) > 1 and at > before[0]:
            before, after = self._states[-2], self._states[-1]  # beyond the newest: go on as it went
        return _between(before, after, at)


def _between(before: tuple[int, Int64s], after: tuple[int, Int64s], at: float) -> tuple[Int64s, Positions]:
    states = after[1]
    new = states[:, X : X + 3] / BLOCK
    if after[0] == before[0]:
        return states, new
    share = (at - before[0]) / (after[0] - before[0])
    old = before[1]
    place = np.searchsorted(old[:, ID], states[:, ID])
    place[place == len(old)] = 0
    known = old[place, ID] == states[:, ID] if len(old) else np.zeros(len(states), bool)
    moved = new.copy()
    was = old[place[known], X : X + 3] / BLOCK
    way = new[known] - was
    near = np.abs(way).max(axis=1) <= TELEPORT_BLOCKS * (after[0] - before[0])
    moved[known] = np.where(near[:, None], was + way * share, new[known])
    return states, moved
