"""The numbers of the world: whole grid steps, so that every sum and comparison is exact.

A position is a whole number of steps of 2^-24 block, a velocity of steps of 2^-16 block/s. Both are
64-bit integers: there is no rounding, no epsilon, no NaN and no negative zero to agree about, and equal
means `==`. Values of people (floats, in blocks and blocks/s) are rounded once, where they enter.
"""

import math

from shared.checks import SceneError, finite

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


def to_velocity(value: object, field: str) -> int:
    """Blocks per second to velocity steps.

    Raises:
        SceneError: not a finite number, or faster than 1024 blocks/s.
    """
    speed = finite(value, field)
    if abs(speed) > SPEED_MAX:
        raise SceneError(f"{field} = {value!r}: faster than {SPEED_MAX:g} blocks/s")
    return rounded(speed * SPEED)
