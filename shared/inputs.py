"""What a player wishes for one tick, in small integers: the unit of prediction and of authority."""

import math
from typing import NamedTuple

import numpy as np

from shared.checks import SceneError, boolean, finite, shown, whole
from shared.units import rounded

MOVE_MAX = 127
"""Length of a full-speed move intent."""
BUTTONS_MAX = 255
WISH_MAX = 1 << 31
"""The greatest part of a move intent that is taken; `clamp` and the kernel shorten it to 127."""
FAR = 1e9
"""The longest direction that `make_input` takes."""
JUMP = 1
"""Bit of `Input.buttons`: jump as soon as something supports the entity."""


class Input(NamedTuple):
    """One atomic input: `move_x` (east) and `move_y` (north) in -127..127, and buttons as bits."""

    move_x: int = 0
    move_y: int = 0
    buttons: int = 0


NEUTRAL = Input()


def make_input(x: float = 0.0, y: float = 0.0, *, jump: object = False, buttons: int = 0) -> Input:
    """An input from a direction in -1..1 per axis; anything longer than 1 is shortened to 1.

    Args:
        x, y: the direction, east and north; truth values count as 0 and 1, as keys that are held.
        jump: whether to jump.
        buttons: further bits, 0 to 255.

    Raises:
        SceneError: a direction that is not finite or beyond +-10^9, or another value of the wrong kind.
    """
    jumps = bool(jump) if isinstance(jump, int) else boolean(jump, "jump")
    bits = whole(buttons, "buttons", 0, BUTTONS_MAX) if buttons else 0
    move_x, move_y = rounded(_way(x, "x") * MOVE_MAX), rounded(_way(y, "y") * MOVE_MAX)
    return clamp(Input(move_x, move_y, bits | (JUMP if jumps else 0)))


def _way(part: object, at: str) -> float:
    """One part of a direction."""
    if type(part) in (float, int) and -FAR <= part <= FAR:  # type: ignore[operator]
        return part  # type: ignore[return-value]
    number = finite(int(part) if isinstance(part, bool | np.bool_) else part, at)
    if abs(number) > FAR:
        raise SceneError(f"{at} = {shown(part)}: must be finite, and at most {FAR:g} either way")
    return number


def checked_input(wish: object, at: str) -> Input:
    """An input whose parts are Python's own whole numbers; a move intent beyond 127 is shortened later.

    Raises:
        SceneError: it is none.
    """
    if not isinstance(wish, tuple) or len(wish) != len(Input._fields):
        raise SceneError(f"{at} = {shown(wish)}: must be an `Input`")
    x, y, buttons = wish
    return Input(
        whole(x, f"{at}.move_x", -WISH_MAX, WISH_MAX),
        whole(y, f"{at}.move_y", -WISH_MAX, WISH_MAX),
        int(buttons) if isinstance(buttons, bool) else whole(buttons, f"{at}.buttons", 0, BUTTONS_MAX),
    )


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
