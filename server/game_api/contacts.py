"""Contacts: which entities touch, reported once, when it begins.

Boxes touch if they share at least a point: an entity that is stopped by another shares a face with it. Only entities
that have changed are compared with all others. All are sorted along x, so the cost depends on the number of entities at
a similar x. The comparison is done with NumPy for all pairs at once.
"""

import numpy as np

from shared.layout import ID, TEMPLATE, Int64s, X
from shared.world import World

Pair = tuple[int, int]


class Contacts:
    """The pairs of entities of a world that touch.

    Args:
        world: the world.
        goes_on: whether the game is restored, so that the present contacts were reported before the restart.
    """

    def __init__(self, world: World, *, goes_on: bool = False) -> None:
        self._world = world
        boxes = np.array([template.row()[:6] for template in world.scene.templates], np.int64)
        self._low, self._high = boxes[:, :3], boxes[:, :3] + boxes[:, 3:]
        self._widest = int(boxes[:, 3].max())
        states = world.states()
        self._touching: set[Pair] = self._touched(states, states[:, ID]) if goes_on else set()
        self._stepped = np.zeros(0, np.int64)

    def stepped(self) -> None:
        """Takes note of the entities that a step has changed. The world forgets them at its next change."""
        self._stepped = self._world.changed[:, ID]

    def begun(self) -> list[Pair]:
        """Returns the pairs (a < b, ascending) that touch now and did not at the last call.

        Both the latest step and changes by the rules after it count.
        """
        changed = np.union1d(self._stepped, self._world.changed[:, ID])
        if not len(changed):
            return []
        now = self._touched(self._world.states(), changed)
        new = now - self._touching
        moved = set(changed.tolist())
        self._touching = now | {
            pair for pair in self._touching if not moved.intersection(pair) and all(e in self._world for e in pair)
        }
        return sorted(new)

    def of(self, entity: int) -> list[int]:
        """Returns the entities that touch an entity now, in ascending order."""
        pairs = self._touched(self._world.states(), np.array([entity], np.int64))
        return sorted(b if a == entity else a for a, b in pairs)

    def _touched(self, states: Int64s, changed: Int64s) -> set[Pair]:
        low = states[:, X : X + 3] + self._low[states[:, TEMPLATE]]
        high = states[:, X : X + 3] + self._high[states[:, TEMPLATE]]
        order = np.argsort(low[:, 0], kind="stable")
        states, low, high = states[order], low[order], high[order]
        mine = np.flatnonzero(np.isin(states[:, ID], changed))
        first = np.searchsorted(low[:, 0], low[mine, 0] - self._widest)
        count = np.searchsorted(low[:, 0], high[mine, 0], "right") - first
        i = np.repeat(mine, count)
        j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        touch = (i != j) & ((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)
        ids = np.sort(np.stack((states[i[touch], ID], states[j[touch], ID]), axis=1), axis=1)
        return {(a, b) for a, b in ids.tolist()}
