"""Contacts: which entities touch, reported when it begins and when it ends.

Boxes touch if they share at least a point: an entity that is stopped by another shares a face with it. Only entities
that have changed are compared with all others. All are sorted along x, so the cost depends on the number of entities at
a similar x. The comparison is done with NumPy for all pairs at once.

A contact has the templates of both entities as they were when it was last reported. If one of them has another template
since, the contact counts as a new one: a player who was thawed can be frozen again by an entity that still touches it.
A change that the rules make while they are called for this very contact does not count.
"""

import numpy as np

from server.game_api.boxes import Boxes
from shared.layout import ID, TEMPLATE, Int64s
from shared.world import World

Pair = tuple[int, int]
Kinds = tuple[int, int]
"""Templates of a pair of entities."""


class Contacts:
    """The pairs of entities of a world that touch.

    Args:
        world: the world.
        goes_on: whether the game is restored, so that the present contacts were reported before the restart.
    """

    def __init__(self, world: World, *, goes_on: bool = False) -> None:
        self._world = world
        self._boxes = Boxes(world.scene)
        states = world.states()
        self._touching: dict[Pair, Kinds] = self._touched(states, states[:, ID]) if goes_on else {}

    def update(self, changed: Int64s) -> tuple[list[Pair], list[Pair]]:
        """Compares the present contacts with those of the last call.

        Args:
            changed: the entities that a step, or the rules after it, have changed since the last call.

        Returns:
            The pairs (a < b, ascending) that no longer touch, also because one of them is gone, and those that touch
            now and did not at the last call, or whose templates have changed.
        """
        known = self._touching
        gone = {pair for pair in known if pair[0] not in self._world or pair[1] not in self._world}
        now = self._touched(self._world.states(), changed) if len(changed) else {}
        moved = set(changed.tolist())
        ended = [pair for pair in known if pair not in now and (pair in gone or not moved.isdisjoint(pair))]
        begun = [pair for pair, kinds in now.items() if known.get(pair) != kinds]
        for pair in ended:
            del known[pair]
        known.update(now)
        return sorted(ended), sorted(begun)

    def reported(self, pair: Pair) -> None:
        """Takes note of the templates that a pair has after the rules were called for it."""
        if pair in self._touching and pair[0] in self._world and pair[1] in self._world:
            a, b = (self._world.state(entity)[TEMPLATE] for entity in pair)
            self._touching[pair] = (a, b)

    def forget(self, pair: Pair) -> None:
        """Forgets a pair that was not reported, because one of the entities was removed first."""
        self._touching.pop(pair, None)

    def of(self, entity: int) -> list[int]:
        """Returns the entities that touch an entity now, in ascending order."""
        pairs = self._touched(self._world.states(), np.array([entity], np.int64))
        return sorted(b if a == entity else a for a, b in pairs)

    def _touched(self, states: Int64s, changed: Int64s) -> dict[Pair, Kinds]:
        low, high = self._boxes.corners(states)
        order = np.argsort(low[:, 0], kind="stable")
        states, low, high = states[order], low[order], high[order]
        mine = np.flatnonzero(np.isin(states[:, ID], changed))
        first = np.searchsorted(low[:, 0], low[mine, 0] - self._boxes.widest)
        count = np.searchsorted(low[:, 0], high[mine, 0], "right") - first
        i = np.repeat(mine, count)
        j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        touch = (i != j) & ((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)
        pairs = states[i[touch]][:, (ID, TEMPLATE)].tolist(), states[j[touch]][:, (ID, TEMPLATE)].tolist()
        return {
            (a, b) if a < b else (b, a): (kind, other) if a < b else (other, kind)
            for (a, kind), (b, other) in zip(*pairs, strict=True)
        }
