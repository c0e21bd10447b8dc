"""Positions between two ticks: one rule for what a client draws and for what lag compensation answers shots with."""

from collections.abc import Collection

from shared.arrays import Float64s, Truths, np
from shared.layout import Int64s
from shared.units import BLOCK


def between(
    ids: Int64s,
    old: Int64s,
    new: Int64s,
    moves: Truths,
    placed: Collection[int],
    share: float,
) -> Float64s:
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
    places: Float64s = old / BLOCK
    if share > 0:
        if placed:
            moves &= ~np.isin(ids, list(placed))
        was = places[moves]
        places[moves] = was + (new[moves] / BLOCK - was) * share
    return places
