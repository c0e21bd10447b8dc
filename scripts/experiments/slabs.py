"""A representation of obstacles that the product does not use: blocks merged greedily into xy slabs, a list per layer.

The seed of this project proposed it. It is kept so that the product's choice can be measured against it.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from shared import kernel, numba_kernel
from shared.blocks import Blocks
from shared.layout import Arrays
from shared.units import BLOCK, SEGMENT
from shared.world import World

Boxes = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@njit(cache=True)
def _merge(layer: Any, slabs: Any) -> int:
    """Fills `slabs` ([n, 4]: x0, y0, x1, y1) with rectangles that cover the solid blocks of a layer [y, x].

    It is greedy: each rectangle grows east as far as possible, then north as long as the whole row is solid. Returns
    the number of rectangles.
    """
    left = layer.copy()
    n = 0
    size = len(layer)
    for y in range(size):
        for x in range(size):
            if not left[y, x]:
                continue
            x1 = x + 1
            while x1 < size and left[y, x1]:
                x1 += 1
            y1 = y + 1
            while y1 < size and left[y1, x:x1].all():
                y1 += 1
            left[y:y1, x:x1] = False
            slabs[n] = (x, y, x1, y1)
            n += 1
    return n


@njit(cache=True)
def _hits(slabs: Any, starts: Any, origin: Any, sizes: Any, boxes: Any, block: int, out: Any) -> None:
    for number in range(len(boxes)):
        b = boxes[number]
        hit = False
        x0, y0, z0 = b[0] - origin[0] * 32 * block, b[1] - origin[1] * 32 * block, b[2] - origin[2] * 32 * block
        x1, y1, z1 = b[3] - origin[0] * 32 * block, b[4] - origin[1] * 32 * block, b[5] - origin[2] * 32 * block
        for z in range(z0 // block, (z1 - 1) // block + 1):
            for sy in range(y0 // block // 32, (y1 - 1) // block // 32 + 1):
                for sx in range(x0 // block // 32, (x1 - 1) // block // 32 + 1):
                    layer = (sy * sizes[0] + sx) * sizes[2] * 32 + z
                    for s in range(starts[layer], starts[layer + 1]):
                        if (
                            slabs[s, 0] * block < x1
                            and slabs[s, 2] * block > x0
                            and slabs[s, 1] * block < y1
                            and slabs[s, 3] * block > y0
                        ):
                            hit = True
                            break
        out[number] = hit


@njit(cache=True)
def _dense(blocks_in: Any, arrays: Any, boxes: Any, out: Any) -> None:
    for number in range(len(boxes)):
        b = boxes[number]
        out[number] = blocks_in(arrays, b[0], b[1], b[2], b[3], b[4], b[5])


class Slabs:
    """The slabs of a box of segments: [n, 4] in blocks, layer after layer."""

    def __init__(self, slabs: Boxes, starts: Boxes, origin: Boxes, sizes: Boxes) -> None:
        self._slabs, self._starts, self._origin, self._sizes = slabs, starts, origin, sizes

    @classmethod
    def of(cls, blocks: Blocks) -> "Slabs":
        indices = np.array(list(blocks), np.int64)
        origin = indices.min(axis=0)
        sizes = indices.max(axis=0) - origin + 1
        solid = np.ones((sizes[2] * SEGMENT, sizes[1] * SEGMENT, sizes[0] * SEGMENT), np.bool_)
        for index in blocks:
            x, y, z = (np.array(index) - origin) * SEGMENT
            solid[z : z + SEGMENT, y : y + SEGMENT, x : x + SEGMENT] = blocks.segment(index) != 0
        return cls(*cls.merged(solid), origin, sizes)

    @staticmethod
    def merged(solid: Flags) -> tuple[Boxes, Boxes]:
        """Merges a map [z, y, x]. Returns the slabs [n, 4] in cells, and the start of each layer of each column."""
        height, depth, width = solid.shape
        scratch = np.zeros((SEGMENT * SEGMENT, 4), np.int64)
        parts, starts = [], [0]
        for y in range(0, depth, SEGMENT):
            for x in range(0, width, SEGMENT):
                for z in range(height):
                    n = _merge(np.ascontiguousarray(solid[z, y : y + SEGMENT, x : x + SEGMENT]), scratch)
                    parts.append(scratch[:n] + np.array([x, y, x, y]))
                    starts.append(starts[-1] + n)
        return np.concatenate(parts), np.array(starts, np.int64)

    def __len__(self) -> int:
        return len(self._slabs)

    def hits(self, boxes: Boxes) -> Flags:
        """Returns for each box whether a block overlaps it, [n]."""
        out = np.zeros(len(boxes), np.bool_)
        _hits(self._slabs, self._starts, self._origin, self._sizes, boxes, BLOCK, out)
        return out

    def merge_layer(self, layer: Flags) -> int:
        """Merges a layer again, which is the least work of an edit. Moving the rest of the list would come on top."""
        return int(_merge(layer, np.zeros((SEGMENT * SEGMENT, 4), np.int64)))


def boxes_on(world: World, count: int) -> Boxes:
    """Returns boxes of players at random positions near the ground, [n, 6] in grid steps."""
    rng = np.random.default_rng(3)
    sides = np.array([0.6, 0.6, 1.8])
    high = np.array([world.scene.size[0] * SEGMENT, world.scene.size[1] * SEGMENT, 24.0]) - sides
    low = rng.uniform([0.0, 0.0, 8.0], high, (count, 3))
    boxes: Boxes = np.floor(np.hstack((low, low + sides)) * BLOCK).astype(np.int64)
    return boxes


def dense_hits(world: World, boxes: Boxes) -> Flags:
    """Returns for each box whether a block overlaps it, [n], by the product's own look-up."""
    out = np.zeros(len(boxes), np.bool_)
    arrays = Arrays(*map(np.asarray, world.arrays))
    _dense(numba_kernel.jitted(kernel).blocks_in, arrays, boxes, out)
    return out
