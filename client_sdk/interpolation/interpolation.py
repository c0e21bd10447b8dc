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
from collections.abc import Sequence

from shared.arrays import PLAIN, Float64s, np
from shared.checks import Vec
from shared.layout import CELL, ID, VX, Int64s, X
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
Change = tuple[list[int] | None, list[int]]
"""The states of an entity in two snapshots; None: it was not in the first one."""
NO_ENTRY: Entry = (0, np.zeros((0, CELL), np.int64), frozenset())
"""An entry without entities."""


class Interpolation:
    """A short history of confirmed states, and the delay with which it is drawn (`delay_ticks`, in ticks)."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._states: deque[Entry] = deque(maxlen=max(math.ceil(KEPT_S * rate), KEPT_MIN))
        self.delay_ticks = 2.0
        self._calm_since = self._at = -math.inf
        self._way: Way | None = None

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
        at = self.shown(server_tick)
        way = self.way(at)
        share, places = way.share(at), {state[ID]: place_of(state) for state in way.states.tolist()}
        for entity, x, y, z, u, v, w in way.moving:
            places[entity] = (x + u * share, y + v * share, z + w * share)
        return way.states, np.array(list(places.values()), np.float64).reshape(-1, 3)

    def way(self, at: float) -> "Way":
        """Returns the way on which the entities are drawn at the tick `at`."""
        before = after = self._states[-1] if self._states else NO_ENTRY
        for entry in reversed(self._states):
            before = entry
            if entry[0] <= at:
                break
            after = entry
        if self._way is None or self._way.before is not before or self._way.after is not after:
            self._way = Way(before, after, self._rate)
        return self._way


class Way:
    """The ways of the entities from one snapshot to the next, or after the newest one. Frames share it.

    An entity that the rules placed or removed meanwhile stays at its earlier position. The positions have the floats of
    `shared.between`.

    Args:
        before, after: the two snapshots; the same one twice: entities move on by their velocities.
        rate: ticks per second.
    """

    def __init__(self, before: Entry, after: Entry, rate: float) -> None:
        self.before, self.after = before, after
        self.tick, self.states, _ = before
        self.ticks = after[0] - before[0] or rate
        """The time in ticks after which the entities have gone the whole way."""
        self.changed: list[Change] = []
        """The entities whose states differ between the two snapshots."""
        self.moving: list[tuple[int, float, float, float, float, float, float]] = []
        """Numbers, positions and ways of those that move, in blocks."""
        if after is before:
            for state in self.states.tolist():
                u, v, w = state[VX : VX + 3]
                if u or v or w:
                    self.moving.append((state[ID], *place_of(state), u / SPEED, v / SPEED, w / SPEED))
            return
        self.changed = changes(before[1], after[1])
        for old, new in self.changed:
            if old is not None and new[ID] not in after[2]:
                (x, y, z), (u, v, w) = place_of(old), place_of(new)
                self.moving.append((new[ID], x, y, z, u - x, v - y, w - z))

    def share(self, at: float) -> float:
        """Returns the share of the way that the entities have gone at the tick `at`."""
        return (at - self.tick) / self.ticks


def changes(before: Int64s, after: Int64s) -> list[Change]:
    """Returns the entities in `after` whose states differ from those in `before`, or were not there.

    Both are ascending by id.
    """
    if PLAIN or not len(before):
        earlier = {state[ID]: state for state in before.tolist()}
        return [(earlier.get(state[ID]), state) for state in after.tolist() if earlier.get(state[ID]) != state]
    rows = np.minimum(before[:, ID].searchsorted(after[:, ID]), len(before) - 1)
    former = before.take(rows, 0)
    differ = (former != after).any(axis=1).nonzero()[0]
    pairs = zip(former.take(differ, 0).tolist(), after.take(differ, 0).tolist(), strict=True)
    return [(old if old[ID] == new[ID] else None, new) for old, new in pairs]


def place_of(state: Sequence[int]) -> Vec:
    """Returns the position in a state, in blocks."""
    return state[X] / BLOCK, state[X + 1] / BLOCK, state[X + 2] / BLOCK
