"""The numbers of the world: whole grid steps, so that every sum and comparison is exact.

A position is a whole number of steps of 2^-24 block, a velocity of steps of 2^-16 block/s. Both are
64-bit integers: there is no rounding, no epsilon, no NaN and no negative zero to agree about, and equal
means `==`. Values of people (floats, in blocks and blocks/s) are rounded once, where they enter.
"""

import math

import numpy as np
import numpy.typing as npt

from shared.checks import SceneError, finite, shown

BLOCK_SHIFT = 24
BLOCK = 1 << BLOCK_SHIFT
"""Grid steps in one block."""
SPEED = 1 << 16
"""Velocity steps in one block per second."""
RANGE_BLOCKS = 1 << 28
"""Positions lie within +- this many blocks."""
SPEED_MAX = 1024.0
"""No scene, template or velocity is faster, in blocks/s."""

SEGMENT_SHIFT = 5
SEGMENT = 1 << SEGMENT_SHIFT
"""Blocks along one side of a world segment."""
TO_SEGMENT = BLOCK_SHIFT + SEGMENT_SHIFT
"""A position shifted right by so much is the index of its segment,"""
IN_SEGMENT = (1 << TO_SEGMENT) - 1
"""and these bits of it count from the segment's low corner."""


def rounded(value: float) -> int:
    """The nearest whole number, halves away from zero, so that mirrored motion stays mirrored."""
    whole = math.floor(abs(value))
    whole += abs(value) - whole >= 0.5
    return whole if value >= 0 else -whole


def to_position(value: object, field: str) -> int:
    """Blocks to grid steps.

    Raises:
        SceneError: not a finite number, or outside +-2^28 blocks.
    """
    blocks = finite(value, field)
    if abs(blocks) > RANGE_BLOCKS:
        raise SceneError(f"{field} = {value!r}: outside of +-{RANGE_BLOCKS} blocks")
    return rounded(blocks * BLOCK)


def to_positions(values: npt.ArrayLike, field: str) -> npt.NDArray[np.int64]:
    """The same for many positions at once, [n, 3].

    Raises:
        SceneError: another shape, or a row in which a value is not finite or out of range.
    """
    try:
        given = np.asarray(values)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise SceneError(f"{field} = {shown(values)}: must be rows of three numbers") from error
    if given.dtype.kind not in "iuf":
        raise SceneError(f"{field} = {shown(values)}: must be rows of three numbers")
    blocks = given.astype(np.float64)
    if blocks.ndim != 2 or blocks.shape[1] != 3:
        raise SceneError(f"{field}: must be rows of three numbers, not of shape {blocks.shape}")
    bad = np.flatnonzero(~(np.abs(blocks) <= RANGE_BLOCKS).all(axis=1))
    if len(bad):
        raise SceneError(f"{field}[{bad[0]}] = {blocks[bad[0]].tolist()}: outside of +-{RANGE_BLOCKS} blocks")
    size = np.abs(blocks) * BLOCK
    whole = np.floor(size)
    whole += size - whole >= 0.5
    steps: npt.NDArray[np.int64] = np.where(blocks >= 0, whole, -whole).astype(np.int64)
    return steps


def to_velocity(value: object, field: str) -> int:
    """Blocks per second to velocity steps.

    Raises:
        SceneError: not a finite number, or faster than 1024 blocks/s.
    """
    speed = finite(value, field)
    if abs(speed) > SPEED_MAX:
        raise SceneError(f"{field} = {value!r}: faster than {SPEED_MAX:g} blocks/s")
    return rounded(speed * SPEED)
