"""Contacts of entities with blocks: a side of an entity's box begins to touch solid blocks.

A box touches a block with a side if the two share a part of that side, as when the block stops the entity. Only
entities that have changed are examined, and the blocks at a side only if the side is on a boundary between blocks.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np

from shared.checks import Cell
from shared.layout import ID, TEMPLATE, Int64s, X
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
        boxes = np.array([template.row()[:6] for template in world.scene.templates], np.int64)
        self._low, self._high = boxes[:, :3], boxes[:, :3] + boxes[:, 3:]
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
        low = states[:, X : X + 3] + self._low[states[:, TEMPLATE]]
        high = states[:, X : X + 3] + self._high[states[:, TEMPLATE]]
        on_boundary = (np.stack((low, high), axis=2).reshape(-1, 6) & (BLOCK - 1)) == 0
        begun: list[tuple[int, Cell]] = []
        for entity, flags, below, above in zip(
            states[:, ID].tolist(), on_boundary.tolist(), low.tolist(), high.tolist(), strict=True
        ):
            before, sides = self._sides.pop(entity, set()), set[int]()
            for side in range(6) if any(flags) else ():
                block = self._block_at(side, below, above) if flags[side] else None
                if block is not None:
                    sides.add(side)
                    if side not in before:
                        begun.append((entity, block))
            if sides:
                self._sides[entity] = sides
        return begun

    def _block_at(self, side: int, low: list[int], high: list[int]) -> Cell | None:
        """Returns the solid block nearest to the middle of a side of a box; None: the side touches no block."""
        axis = side // 2
        layer = high[axis] >> BLOCK_SHIFT if side % 2 else (low[axis] >> BLOCK_SHIFT) - 1
        spans = [range(a >> BLOCK_SHIFT, (b - 1 >> BLOCK_SHIFT) + 1) for a, b in zip(low, high, strict=True)]
        spans[axis] = range(layer, layer + 1)
        middle = [(a + b) // 2 for a, b in zip(low, high, strict=True)]

        def distance(block: Cell) -> int:
            return sum(
                max(abs(2 * part * BLOCK + BLOCK - 2 * at) - BLOCK, 0)
                for k, (part, at) in enumerate(zip(block, middle, strict=True))
                if k != axis
            )

        return min(self._solid(spans), key=lambda block: (distance(block), block), default=None)

    def _solid(self, spans: list[range]) -> Iterator[Cell]:
        blocks = self._world.blocks
        for x, y, z in product(*spans):
            kind = blocks.get(x, y, z)
            if kind is not None and blocks.stops[kind]:
                yield x, y, z
