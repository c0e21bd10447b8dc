"""Interpolation: other entities are drawn between two confirmed snapshots, a little in the past.

Theory of operation. The delay rises at once when a snapshot is late, by the time that was missing. After some time
without a late snapshot it falls: slowly while it is short, because a path that stalls does so again and again, and the
faster the further it is above `LONG_S`. While it falls, motion looks up to twice as fast, but never jumps or goes back.

Changes by the rules take effect at the tick of the snapshot that contains them, and no sooner. Until then, an entity
that the rules placed is drawn at its old position, a removed one is still drawn, a changed one looks as before, and a
new one is not drawn. `server.rewind` answers shots by the same rule. Beyond the newest snapshot, entities move on by
their velocities for less than a tick, because the next snapshot may change anything.
"""

import math
from collections import deque

from shared.arrays import PLAIN, Float64s, np
from shared.layout import ID, VX, Int64s, X
from shared.units import BLOCK, SPEED

KEPT_S, KEPT_MIN = 3.0, 16
"""Length of the history of confirmed states: `KEPT_S` seconds, at least `KEPT_MIN` entries."""
EXTRAPOLATE_S = 0.1
"""Longest time beyond the newest snapshot that is drawn, in seconds; it is also kept below one tick."""
FALL_S_PER_S = 0.01
"""Speed at which a delay of at most `LONG_S` falls, in seconds per second."""
CALM_S = 3.0
"""Time without a late snapshot after which a delay of at most `LONG_S` begins to fall, in seconds."""
LONG_S = 0.2
"""Delay above which it falls faster, in seconds."""
LONG_FALL, LONG_SHARE, LONG_CALM_S, FALL_MAX = 0.05, 0.5, 1.0, 1.0
"""Fall of a delay above `LONG_S`: it begins after `LONG_CALM_S` seconds without a late snapshot. Its speed in seconds
per second is `LONG_FALL` plus `LONG_SHARE` times the seconds above `LONG_S`, at most `FALL_MAX`."""

Positions = Float64s
"""Positions in blocks, [n, 3]."""
Entry = tuple[int, Int64s, frozenset[int]]
"""An entry of the history: the tick of a snapshot, the states at its end, and the entities that the rules placed since
the snapshot before."""


class Interpolation:
    """A short history of confirmed states, and the delay with which it is drawn (`delay_ticks`, in ticks)."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._states: deque[Entry] = deque(maxlen=max(math.ceil(KEPT_S * rate), KEPT_MIN))
        self.delay_ticks = 2.0
        self._calm_since = self._at = -math.inf
        self._way: _Way | None = None

    def push(self, tick: int, states: Int64s, placed: frozenset[int] = frozenset()) -> None:
        """Adds a snapshot to the history.

        Args:
            tick: the tick of the snapshot.
            states: the confirmed states at the end of that tick, [n, 12], ascending by id.
            placed: the entities that the rules placed since the snapshot before.
        """
        self._states.append((tick, states, placed))

    def advance(self, server_tick: float, now: float) -> None:
        """Adapts the delay to the age of the newest snapshot.

        Args:
            server_tick: the server time in ticks.
            now: local time in seconds.
        """
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
        """Returns the speed at which the delay falls, in seconds per second, `calm_s` after the last late snapshot."""
        long_s = self.delay_ticks / self._rate - LONG_S
        if long_s > 0 and calm_s > LONG_CALM_S:
            return min(LONG_FALL + LONG_SHARE * long_s, FALL_MAX)
        return FALL_S_PER_S if calm_s > CALM_S else 0.0

    def shift(self, ticks: float) -> None:
        """Takes a step of the server's time, by `ticks`, so that the drawn moment does not go back with it."""
        if ticks < 0:
            self.delay_ticks = max(self.delay_ticks + ticks, 1.0)

    def shown(self, server_tick: float) -> float:
        """Returns the view tick: the moment that is drawn, within the history or less than a tick after it."""
        at = server_tick - self.delay_ticks
        if not self._states:
            return at
        oldest, newest = self._states[0][0], self._states[-1][0]
        latest = min(newest + EXTRAPOLATE_S * self._rate, math.nextafter(newest + 1, newest))
        return latest if at > latest else max(oldest, at)

    def sample(self, server_tick: float) -> tuple[Int64s, Positions]:
        """Returns states ([n, 12]) and positions (blocks, [n, 3]) of all entities at the tick `shown(server_tick)`."""
        states, places = self.drawn(server_tick)
        return states, np.array(places, np.float64).reshape(-1, 3)

    def drawn(self, server_tick: float) -> tuple[Int64s, list[list[float]]]:
        """Returns states and positions like `sample`, the latter as lists."""
        if not self._states:
            return np.zeros((0, 12), np.int64), []
        at = self.shown(server_tick)
        before = after = self._states[-1]
        for entry in reversed(self._states):
            before = entry
            if entry[0] <= at:
                break
            after = entry
        tick, states, _ = before
        if at > tick and after is not before:
            if self._way is None or self._way.before is not before or self._way.after is not after:
                self._way = _Way(before, after)
            return states, self._way.at((at - tick) / (after[0] - tick))
        places = states[:, X : X + 3] / BLOCK + states[:, VX : VX + 3] / SPEED * ((at - tick) / self._rate)
        return states, places.tolist()


class _Way:
    """The ways of the entities between two snapshots. Two or more frames are drawn of each.

    An entity that the rules placed or removed meanwhile stays at its earlier position. The positions have the floats of
    `shared.between`.
    """

    def __init__(self, before: Entry, after: Entry) -> None:
        self.before, self.after = before, after
        (_, states, _), (_, new, placed) = before, after
        if PLAIN:
            self._lists = _ways(states.tolist(), new.tolist(), placed)
            return
        self._start, ids = states[:, X : X + 3] / BLOCK, states[:, ID]
        if len(new) == len(ids) and (new[:, ID] == ids).all():  # mostly
            self._span = new[:, X : X + 3] / BLOCK - self._start
        else:
            self._span = np.zeros_like(self._start)
            if len(new):
                row = np.searchsorted(new[:, ID], ids)
                row[row == len(new)] = 0
                moves = new[row, ID] == ids
                self._span[moves] = new[row[moves], X : X + 3] / BLOCK - self._start[moves]
        if placed:
            self._span[np.isin(ids, list(placed))] = 0.0

    def at(self, share: float) -> list[list[float]]:
        """Returns the positions at a moment, from 0 (the first snapshot) to 1 (the second)."""
        if PLAIN:
            return [[x + u * share, y + v * share, z + w * share] for x, y, z, u, v, w in self._lists]
        places: list[list[float]] = (self._start + self._span * share).tolist()
        return places


def _ways(
    states: list[list[int]], new: list[list[int]], placed: frozenset[int]
) -> list[tuple[float, float, float, float, float, float]]:
    """Returns the position and the way of each entity in `states` to its state in `new`, in plain Python."""
    newer = {state[ID]: state for state in new if state[ID] not in placed}
    ways = []
    for state in states:
        then = newer.get(state[ID], state)
        x, y, z = state[X] / BLOCK, state[X + 1] / BLOCK, state[X + 2] / BLOCK
        ways.append((x, y, z, then[X] / BLOCK - x, then[X + 1] / BLOCK - y, then[X + 2] / BLOCK - z))
    return ways
