"""Comparison of predicted with confirmed states: which entities count, and by how much they differ.

All arguments are states of worlds, [n, 12], ascending by id; in a scene with extra columns (`shared.extras`) wider.
"""

import math
from bisect import bisect_left, bisect_right

from shared.aim import NO_AIM
from shared.arrays import np
from shared.checks import Vec
from shared.layout import CELL, ID, TEMPLATE, Int64s, X, Y, Z
from shared.units import BLOCK
from shared.world import World

MEET_BLOCKS = 12.0
"""Greatest distance in blocks at which another entity counts. Beyond it, none is met before the next replay."""
TOUCH_BLOCKS = 2.0
"""Room for two entities that touch, in blocks."""
APPROACH = 10.0
"""Least speed at which two entities are expected to come towards each other, in blocks/s."""
NEXT_S = 0.25
"""Longest expected time until the next replay, in seconds. A snapshot may be late."""

State = tuple[int, ...]


class Comparison:
    """Compares states for the client of one entity.

    Args:
        world: the confirmed world.
        entity: number of the own entity.
    """

    def __init__(self, world: World, entity: int) -> None:
        scene = world.scene
        self.entity = entity
        self.last_own = entity + scene.extras.blocks[scene.template(scene.player)]
        """Greatest number of an entity that the own one may have spawned; they follow its own number."""
        self._world = world
        self._shown_ahead = np.array([template.shown == "predicted" for template in scene.templates], np.int64)
        self._others_ahead = bool(self._shown_ahead.any())
        self._approach = max(APPROACH, 2.0 * max(template.walk_speed for template in scene.templates))

    def own(self, states: Int64s) -> Int64s:
        """Returns the states of the own entity and of what it has spawned. A view."""
        ids = states[:, ID].tolist()
        own: Int64s = states[bisect_left(ids, self.entity) : bisect_right(ids, self.last_own)]
        return own

    def near_equal(self, predicted: Int64s, confirmed: Int64s, ahead_s: float) -> bool:
        """Returns whether all entities are as predicted that could meet the own one, or are drawn as predicted.

        Args:
            predicted, confirmed: the states at one tick.
            ahead_s: time from that tick to the newest predicted one, in seconds; `inf`: others count up to
                `MEET_BLOCKS`.
        """
        if predicted.tobytes() == confirmed.tobytes():
            return True
        if self._world.extras.count:
            return bool(np.array_equal(self._counting(predicted), self._counting(confirmed)))
        reach = int(self._meet_blocks(ahead_s) * BLOCK)
        kernel = self._world.kernel
        a, b, always = map(kernel.lent, (predicted, confirmed, self._shown_ahead))
        return bool(kernel.alike(a, len(predicted), b, len(confirmed), self.entity, reach, always))

    def difference(self, predicted: Int64s, confirmed: Int64s) -> tuple[tuple[str, ...], float] | None:
        """Returns the fields and the distance (blocks) by which the own entity differs; None if it does not."""
        before, now = state_in(predicted, self.entity), state_in(confirmed, self.entity)
        if before is None or now is None or before == now:
            return None
        x, y, z = ((a - b) / BLOCK for a, b in zip(now[X : X + 3], before[X : X + 3], strict=True))
        differing = zip(self._world.extras.names, now, before, strict=True)
        return tuple(name for name, a, b in differing if a != b), math.sqrt(x * x + y * y + z * z)

    def others_differ(self, predicted: Int64s, confirmed: Int64s) -> bool:
        """Returns whether any other entity differs."""
        was, are = (states[states[:, ID] != self.entity] for states in (predicted, confirmed))
        return not np.array_equal(was, are)

    def offsets(self, before: Int64s, after: Int64s) -> dict[int, Vec]:
        """Returns old minus new position of each entity that may be drawn as predicted and has moved, in blocks."""
        if not self._others_ahead:
            before, after = self.own(before), self.own(after)
        was, offsets = {state[ID]: state for state in before.tolist()}, {}
        for state in after.tolist():
            x, y, z = ((was.get(state[ID], state)[axis] - state[axis]) / BLOCK for axis in (X, Y, Z))
            if x or y or z:
                offsets[state[ID]] = (x, y, z)
        return offsets

    def _meet_blocks(self, ahead_s: float) -> float:
        """Returns the distance in blocks beyond which an entity cannot be met before the next replay.

        The own motion alone depends on it. If others are drawn as predicted, they count at the greatest distance.
        """
        if self._others_ahead:
            return MEET_BLOCKS
        return min(TOUCH_BLOCKS + self._approach * (ahead_s + NEXT_S), MEET_BLOCKS)

    def _counting(self, states: Int64s) -> Int64s:
        """Returns the states that count in a comparison, as `bulk.alike` chooses them, with their extra columns.

        The aim of others does not count: it changes in every tick, and what it leads to is compared.
        """
        own = states[states[:, ID] == self.entity]
        if not len(own):
            return states
        ways = abs(states[:, X : X + 3] - own[0, X : X + 3])
        near = (ways < MEET_BLOCKS * BLOCK).all(axis=1)
        ids = states[:, ID]
        mine = (ids >= self.entity) & (ids <= self.last_own)
        counts = near | mine | (self._shown_ahead[states[:, TEMPLATE]] != 0)
        counting: Int64s = states[counts]
        if self._world.extras.aims:
            counting[~mine[counts], CELL : CELL + len(NO_AIM)] = 0
        return counting


def row_in(states: Int64s, entity: int, guess: int = 0) -> int | None:
    """Returns the row of an entity; None if it is not there. Looks at the row `guess` first."""
    if guess < len(states) and states.item(guess, ID) == entity:
        return guess
    ids = states[:, ID].tolist()
    row = bisect_left(ids, entity)
    return row if row < len(ids) and ids[row] == entity else None


def state_in(states: Int64s, entity: int) -> State | None:
    """Returns the state of an entity; None if it is not there."""
    row = row_in(states, entity)
    return None if row is None else tuple(states[row].tolist())
