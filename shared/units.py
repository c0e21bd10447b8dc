"""The units of the world: whole grid steps, so that every sum and comparison is exact.

A position is a whole number of steps of 2^-24 block, a velocity of steps of 2^-16 block/s. Both are 64-bit integers. So
client and server need not agree about rounding, an epsilon, NaN or negative zero, and equality is `==`. Floats of a
program (blocks and blocks/s) are rounded once, when they enter.
"""

import math

from shared.checks import SceneError, finite

BLOCK_SHIFT = 24
"""Shift from a position in grid steps to blocks."""
BLOCK = 1 << BLOCK_SHIFT
"""Number of grid steps in one block."""
SPEED = 1 << 16
"""Number of velocity steps in one block per second."""
RANGE_BLOCKS = 1 << 28
"""Greatest distance of a position from 0 along each axis, in blocks."""
SPEED_MAX = 1024.0
"""Greatest speed in a scene, a template or a velocity, in blocks/s."""

SEGMENT_SHIFT = 5
"""Shift from a block to the index of its segment."""
SEGMENT = 1 << SEGMENT_SHIFT
"""Length of a segment's side, in blocks."""
TO_SEGMENT = BLOCK_SHIFT + SEGMENT_SHIFT
"""Shift from a position in grid steps to the index of its segment."""
IN_SEGMENT = (1 << TO_SEGMENT) - 1
"""Mask of a position's bits that count from the low corner of its segment, in grid steps."""


def rounded(value: float) -> int:
    """Returns the nearest whole number; halves are rounded away from zero, so that mirrored motion stays mirrored."""
    whole = math.floor(abs(value))
    whole += abs(value) - whole >= 0.5
    return whole if value >= 0 else -whole


def to_position(value: object, field: str) -> int:
    """Converts blocks to grid steps.

    Args:
        value: a number of blocks.
        field: name of the field, for the error.

    Raises:
        SceneError: `value` is not a finite number, or outside +-2^28 blocks.
    """
    if type(value) is float and -RANGE_BLOCKS <= value <= RANGE_BLOCKS:
        return rounded(value * BLOCK)
    blocks = finite(value, field)
    if abs(blocks) > RANGE_BLOCKS:
        raise SceneError(f"{field} = {value!r}: outside of +-{RANGE_BLOCKS} blocks")
    return rounded(blocks * BLOCK)


def to_velocity(value: object, field: str) -> int:
    """Converts blocks per second to velocity steps.

    Args:
        value: a speed in blocks/s.
        field: name of the field, for the error.

    Raises:
        SceneError: `value` is not a finite number, or faster than 1024 blocks/s.
    """
    if type(value) is float and -SPEED_MAX <= value <= SPEED_MAX:
        return rounded(value * SPEED)
    speed = finite(value, field)
    if abs(speed) > SPEED_MAX:
        raise SceneError(f"{field} = {value!r}: faster than {SPEED_MAX:g} blocks/s")
    return rounded(speed * SPEED)
