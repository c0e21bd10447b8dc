"""The input of a player for one tick: a direction and buttons, in small whole numbers."""

import math
from typing import NamedTuple

import numpy as np

from shared.checks import SceneError, boolean, finite, shown, whole
from shared.units import rounded

MOVE_MAX = 127
"""Length of a direction at full speed."""
BUTTONS_MAX = 255
"""Greatest value of the buttons: 8 bits."""
MOVE_PART_MAX = 1 << 31
"""Greatest part of a direction that is accepted; `clamp` and the kernel shorten the direction to length 127."""
FAR = 1e9
"""Greatest part of a direction that `make_input` accepts, where full speed is 1."""
JUMP = 1
"""Bit of `Input.buttons`: jump as soon as something supports the entity."""


class Input(NamedTuple):
    """The input of one tick: the direction `move_x` (east) and `move_y` (north) in -127..127, and buttons as bits."""

    move_x: int = 0
    move_y: int = 0
    buttons: int = 0


NEUTRAL = Input()
"""Input of a player that does nothing."""


def make_input(x: float = 0.0, y: float = 0.0, *, jump: object = False, buttons: int = 0) -> Input:
    """Returns the input for a direction of length 0 (stand) to 1 (full speed). A longer one is shortened to 1.

    Args:
        x: east part of the direction. A truth value counts as 0 or 1, so the state of a key can be passed.
        y: north part of the direction.
        jump: whether to jump.
        buttons: further buttons as bits, 0 to 255.

    Raises:
        SceneError: the direction is not finite, or beyond +-10^9; or another value is of a wrong type.
    """
    jumps = bool(jump) if isinstance(jump, int) else boolean(jump, "jump")
    bits = whole(buttons, "buttons", 0, BUTTONS_MAX) if buttons else 0
    move_x, move_y = rounded(_way(x, "x") * MOVE_MAX), rounded(_way(y, "y") * MOVE_MAX)
    return clamp(Input(move_x, move_y, bits | (JUMP if jumps else 0)))


def _way(part: object, at: str) -> float:
    """Returns one part of a direction, checked."""
    if type(part) in (float, int) and -FAR <= part <= FAR:  # type: ignore[operator]
        return part  # type: ignore[return-value]
    number = finite(int(part) if isinstance(part, bool | np.bool_) else part, at)
    if abs(number) > FAR:
        raise SceneError(f"{at} = {shown(part)}: must be finite, from -{FAR:g} to {FAR:g}")
    return number


def checked_input(input_: object, at: str) -> Input:
    """Returns an input with Python's own whole numbers. A direction longer than 127 is allowed; `clamp` shortens it.

    Args:
        input_: the value to check.
        at: name of the argument, for the error.

    Raises:
        SceneError: `input_` is not an input.
    """
    if not isinstance(input_, tuple) or len(input_) != len(Input._fields):
        raise SceneError(f"{at} = {shown(input_)}: must be an `Input`")
    x, y, buttons = input_
    return Input(
        whole(x, f"{at}.move_x", -MOVE_PART_MAX, MOVE_PART_MAX),
        whole(y, f"{at}.move_y", -MOVE_PART_MAX, MOVE_PART_MAX),
        int(buttons) if isinstance(buttons, bool) else whole(buttons, f"{at}.buttons", 0, BUTTONS_MAX),
    )


def row(input_: Input) -> bytes:
    """Returns an input packed for `Inputs.rows`: 3 bytes."""
    x, y, buttons = input_
    return bytes((x & 0xFF, y & 0xFF, buttons & 0xFF))


def clamp(input_: Input) -> Input:
    """Returns the input with its direction shortened to length 127, in whole numbers. Both sides use this rule."""
    x, y = input_.move_x, input_.move_y
    square = x * x + y * y
    if square <= MOVE_MAX * MOVE_MAX:
        return input_
    # |part| = floor(127 |part| / length): the longest vector of whole numbers in this direction.
    return input_._replace(move_x=_shortened(x, square), move_y=_shortened(y, square))


def _shortened(part: int, square: int) -> int:
    scaled = math.isqrt(MOVE_MAX * MOVE_MAX * part * part // square)
    return scaled if part >= 0 else -scaled
