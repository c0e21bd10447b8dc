"""The entities of several segments at once, for their keyframes."""

from collections.abc import Sequence

import numpy as np

from shared.checks import Cell
from shared.layout import CELLS, ID, NEXT, Int64s
from shared.world import World


def in_segments(world: World, segments: Sequence[Cell]) -> tuple[Int64s, list[int]]:
    """Returns a copy of the entities of each segment as `World.in_segment` does, one segment after the other.

    Args:
        world: the world.
        segments: the segments.

    Returns:
        The entities, [n, 16], and the number of entities of each segment.

    Raises:
        MissingError: a segment is not loaded.
    """
    matrix, blocks = world.matrix, world.blocks
    heads = blocks.heads.reshape(-1, CELLS)[[blocks.row(segment) for segment in segments]]
    of, cells = np.nonzero(heads >= 0)
    found: list[int] = []
    counts, following = [0] * len(segments), matrix[:, NEXT].item
    for at, head in zip(of.tolist(), heads[of, cells].tolist(), strict=True):
        while head >= 0:
            found.append(head)
            counts[at] += 1
            head = following(head)
    rows = matrix[np.array(found, np.int64)]
    return rows[np.lexsort((rows[:, ID], np.repeat(np.arange(len(counts)), counts)))], counts
