"""Contacts of entities with blocks: a side of an entity's box begins to touch solid blocks.

A box touches a block with a side if the two share a part of that side, as when the block stops the entity. Only
entities that have changed are examined, and the blocks at a side only if the side is on a boundary between blocks.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np

from server.game_api.boxes import Boxes
from shared.checks import Cell
from shared.layout import ID, Int64s
from shared.units import BLOCK, BLOCK_SHIFT
from shared.world import World


class BlockContacts:
    """The sides with which the entities of a world touch blocks.

    Args:
        world: the world.
        goes_on: whether the game is restored, so that the present contacts were reported before the restart.
    """

    def __init__(self, world: World, *, goes_on: bool = False) -> None:
        self._world = world
        self._boxes = Boxes(world.scene)
        self._sides: dict[int, set[int]] = {}
        """Sides that touch blocks, by entity: 0 to 5 for west, east, south, north, below, above."""
        if goes_on:
            self.update(world.states()[:, ID])

    def update(self, changed: Int64s) -> list[tuple[int, Cell]]:
        """Returns the entities of which a side touches blocks now and did not at the last call, with the block.

        Args:
            changed: the entities that a step, or the rules after it, have changed since the last call.

        Returns:
            Pairs of an entity and the solid block that is nearest to the middle of the side, ascending by the entity,
            then by the side.
        """
        if len(self._sides) > 2 * len(self._world):
            self._sides = {entity: sides for entity, sides in self._sides.items() if entity in self._world}
        states = self._world.states()
        states = states[np.isin(states[:, ID], changed)]
        low, high = self._boxes.corners(states)
        on_boundary = (np.stack((low, high), axis=2).reshape(-1, 6) & (BLOCK - 1)) == 0
        begun: list[tuple[int, Cell]] = []
        for entity, flags, below, above in zip(
            states[:, ID].tolist(), on_boundary.tolist(), low.tolist(), high.tolist(), strict=True
        ):
            before, sides = self._sides.pop(entity, set()), set[int]()
            for side in range(6) if True in flags else ():
                if not flags[side]:
                    continue
                touched = self._solid(side, below, above)
                if side in before:
                    if next(touched, None) is not None:
                        sides.add(side)
                elif blocks := list(touched):
                    sides.add(side)
                    begun.append((entity, _nearest(blocks, side // 2, below, above)))
            if sides:
                self._sides[entity] = sides
        return begun

    def _solid(self, side: int, low: list[int], high: list[int]) -> Iterator[Cell]:
        """Yields the solid blocks that a side of a box touches."""
        spans = [range(a >> BLOCK_SHIFT, (b - 1 >> BLOCK_SHIFT) + 1) for a, b in zip(low, high, strict=True)]
        axis = side // 2
        layer = high[axis] >> BLOCK_SHIFT if side % 2 else (low[axis] >> BLOCK_SHIFT) - 1
        spans[axis] = range(layer, layer + 1)
        get, stops = self._world.blocks.get, self._world.blocks.stops
        for x, y, z in product(*spans):
            kind = get(x, y, z)
            if kind is not None and stops[kind]:
                yield x, y, z


def _nearest(blocks: list[Cell], axis: int, low: list[int], high: list[int]) -> Cell:
    """Returns the block that is nearest to the middle of a side of a box; of several, the first by its place.

    Args:
        blocks: the blocks that the side touches.
        axis: the axis across the side.
        low, high: corners of the box, in grid steps.
    """

    def distance(block: Cell) -> int:
        twice = (abs((2 * block[k] + 1) * BLOCK - low[k] - high[k]) - BLOCK for k in range(3) if k != axis)
        return sum(max(part, 0) for part in twice)

    return min(blocks, key=lambda block: (distance(block), block))
