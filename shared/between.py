"""Positions between two ticks: one rule for what a client draws and for what lag compensation answers shots with."""

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from shared.layout import Int64s
from shared.units import BLOCK

Floats = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def between(
    ids: npt.NDArray[np.int64],
    old: Int64s,
    new: Int64s,
    moves: npt.NDArray[np.bool_],
    placed: Collection[int],
    share: float,
) -> Floats:
    """Interpolates positions between two ticks, in the same floats on both sides.

    An entity that the rules have placed meanwhile stays at its earlier position, and is at the new one from the second
    tick on.

    Args:
        ids: numbers of the entities, [n].
        old: positions at the first tick in units, [n, 3].
        new: positions at the second tick in units, [n, 3]; rows without `moves` are ignored.
        moves: whether an entity exists at both ticks, [n]. This array is changed.
        placed: entities that the rules have placed after the first tick, up to the second.
        share: the moment between the ticks, 0 to 1.

    Returns:
        Positions in blocks, [n, 3].
    """
    places: Floats = old / BLOCK
    if share > 0:
        if placed:
            moves &= ~np.isin(ids, list(placed))
        was = places[moves]
        places[moves] = was + (new[moves] / BLOCK - was) * share
    return places
