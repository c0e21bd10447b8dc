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
from typing import Self

from shared.arrays import np
from shared.checks import Vec
from shared.layout import CELL, MOVE_X, Int64s
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

Move = tuple[float, float, float, float, float, float]
"""A position and a way from it, in blocks."""
Look = tuple[int, ...]
"""The part of a state on which facing and fields depend: vx, vy, and all columns from move_x on."""
LOOK_MOVE, LOOK_EXTRA = 2, 2 + CELL - MOVE_X
"""Places in a `Look`: move_x, and the first extra column."""


class Entry:
    """A snapshot in the history. While it is drawn (`listed`), it has lists, in which Python finds numbers faster.

    Args:
        tick: its tick.
        states: the states at the end of that tick, [n, 12], ascending by id.
        placed: the entities that the rules placed since the snapshot before.
    """

    ids: list[int]
    """The numbers of the entities."""
    templates: list[int]
    """The templates of the entities."""
    places: list[Vec]
    """The positions of the entities in blocks."""
    velocities: list[Vec]
    """The velocities of the entities in blocks/s."""
    looks: list[Look]

    def __init__(self, tick: int, states: Int64s, placed: frozenset[int] = frozenset()) -> None:
        self.tick, self.states, self.placed = tick, states, placed
        self.unlisted()

    def listed(self) -> Self:
        """Returns this entry with its lists."""
        if not self.ids and len(self.states):
            self.ids, self.templates, _, xs, ys, zs, us, vs, ws, *rest = self.states.T.tolist()
            self.places = [(x / BLOCK, y / BLOCK, z / BLOCK) for x, y, z in zip(xs, ys, zs, strict=True)]
            self.velocities = [(u / SPEED, v / SPEED, w / SPEED) for u, v, w in zip(us, vs, ws, strict=True)]
            self.looks = list(zip(us, vs, *rest, strict=True))
        return self

    def unlisted(self) -> None:
        """Forgets the lists."""
        self.ids, self.templates, self.places, self.velocities, self.looks = [], [], [], [], []


NO_ENTRY = Entry(0, np.zeros((0, CELL), np.int64))
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
        self._states.append(Entry(tick, states, placed))

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
        short = (server_tick - self.delay_ticks) - self._states[-1].tick
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
        oldest, newest = self._states[0].tick, self._states[-1].tick
        latest = min(newest + EXTRAPOLATE_S * self._rate, math.nextafter(newest + 1, newest))
        return latest if at > latest else max(oldest, at)

    def way(self, at: float) -> "Way":
        """Returns the way on which the entities are drawn at the tick `at`."""
        before = after = self._states[-1] if self._states else NO_ENTRY
        for entry in reversed(self._states):
            before = entry
            if entry.tick <= at:
                break
            after = entry
        old = self._way
        if old is not None and old.before is before and old.after is after:
            return old
        if old is not None and old.before not in (before, after):
            old.before.unlisted()
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
        self.before, self.after = before.listed(), after.listed()
        self._ticks = after.tick - before.tick or rate  # after these, the entities have gone the whole way
        self._moves: list[Move]
        if after is before:
            ways = zip(before.places, before.velocities, strict=True)
            self._moves = [(*start, *speed) for start, speed in ways]
        else:
            ways = zip(before.places, _ends(before, after), strict=True)
            self._moves = [(x, y, z, u - x, v - y, w - z) for (x, y, z), (u, v, w) in ways]

    def places(self, at: float) -> list[Vec]:
        """Returns where the entities are drawn at the tick `at`, in blocks, in the order of `before`."""
        share = (at - self.before.tick) / self._ticks
        return [(x + u * share, y + v * share, z + w * share) for x, y, z, u, v, w in self._moves]


def _ends(before: Entry, after: Entry) -> list[Vec]:
    """Returns where the entities of a snapshot are in a later one. Those that it does not move are where they were."""
    if before.ids == after.ids and not after.placed:
        return after.places
    ends = dict(zip(after.ids, after.places, strict=True))
    for entity in after.placed:
        ends.pop(entity, None)
    return [ends.get(entity, start) for entity, start in zip(before.ids, before.places, strict=True)]
