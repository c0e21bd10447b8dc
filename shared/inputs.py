"""What a player wishes for one tick, in small integers: the unit of prediction and of authority."""

import math
from typing import NamedTuple

from shared.units import rounded

MOVE_MAX = 127
"""Length of a full-speed move intent."""
JUMP = 1
"""Bit of `Input.buttons`: jump as soon as something supports the entity."""


class Input(NamedTuple):
    """One atomic input: `move_x` (east) and `move_y` (north) in -127..127, and buttons as bits."""

    move_x: int = 0
    move_y: int = 0
    buttons: int = 0


NEUTRAL = Input()


def make_input(x: float = 0.0, y: float = 0.0, *, jump: bool = False, buttons: int = 0) -> Input:
    """An input from a direction in -1..1 per axis; anything longer than 1 is shortened to 1.

    Raises:
        ValueError: a direction that is not finite.
    """
    if not (abs(x) <= 1e9 and abs(y) <= 1e9):
        raise ValueError(f"move ({x!r}, {y!r}): must be finite")
    return clamp(Input(rounded(x * MOVE_MAX), rounded(y * MOVE_MAX), buttons | (JUMP if jump else 0)))


def row(wish: Input) -> bytes:
    """An input as it goes over the wire, in `Inputs.rows`."""
    x, y, buttons = wish
    return bytes((x & 0xFF, y & 0xFF, buttons & 0xFF))


def clamp(wish: Input) -> Input:
    """`wish` with its move intent shortened to length 127 in whole numbers (the one rule for both sides)."""
    x, y = wish.move_x, wish.move_y
    square = x * x + y * y
    if square <= MOVE_MAX * MOVE_MAX:
        return wish
    # The longest vector in this direction whose parts are whole: |part| = floor(127 |part| / length).
    return wish._replace(move_x=_shortened(x, square), move_y=_shortened(y, square))


def _shortened(part: int, square: int) -> int:
    scaled = math.isqrt(MOVE_MAX * MOVE_MAX * part * part // square)
    return scaled if part >= 0 else -scaled
