"""The input of a player for one tick: a direction, buttons and an aim, in small whole numbers."""

import math
import struct
from typing import NamedTuple

from shared.aim import NO_AIM, Aim, checked_aim, make_aim, normalised
from shared.checks import SceneError, boolean, finite, is_truth, shown, whole
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


ROW = struct.Struct("<bbB")
"""Format of an input in a message, in a scene without aim: move_x, move_y, buttons."""
AIM_ROW = struct.Struct("<bbB3h")
"""Format of an input in a message, in a scene with aim: move_x, move_y, buttons, and the aim's x, y and z."""
AIM = struct.Struct("<3h")
"""Format of the aim at the end of such a row."""


class Input(NamedTuple):
    """The input of one tick: the direction `move_x` (east) and `move_y` (north) in -127..127, and buttons as bits.

    `aim` is a direction in space (`shared.aim`), for scenes that ask for one.
    """

    move_x: int = 0
    move_y: int = 0
    buttons: int = 0
    aim: Aim = NO_AIM


NEUTRAL = Input()
"""Input of a player that does nothing."""


def make_input(x: float = 0.0, y: float = 0.0, *, jump: object = False, buttons: int = 0, aim: object = None) -> Input:
    """Returns the input for a direction of length 0 (stand) to 1 (full speed). A longer one is shortened to 1.

    Args:
        x: east part of the direction. A truth value counts as 0 or 1, so the state of a key can be passed.
        y: north part of the direction.
        jump: whether to jump.
        buttons: further buttons as bits, 0 to 255; `Scene.buttons_bits` returns them for names.
        aim: direction (x, y, z) in space, of any length; None: no aim.

    Raises:
        SceneError: the direction is not finite, or beyond +-10^9; or another value is of a wrong type.
    """
    jumps = bool(jump) if isinstance(jump, int) else boolean(jump, "jump")
    bits = whole(buttons, "buttons", 0, BUTTONS_MAX) if buttons else 0
    move_x, move_y = rounded(_way(x, "x") * MOVE_MAX), rounded(_way(y, "y") * MOVE_MAX)
    made = NO_AIM if aim is None else make_aim(aim)
    return clamp(Input(move_x, move_y, bits | (JUMP if jumps else 0), made))


def _way(part: object, at: str) -> float:
    """Returns one part of a direction, checked."""
    if type(part) in (float, int) and -FAR <= part <= FAR:  # type: ignore[operator]
        return part  # type: ignore[return-value]
    number = finite(int(part) if is_truth(part) else part, at)  # type: ignore[call-overload]
    if abs(number) > FAR:
        raise SceneError(f"{at} = {shown(part)}: must be finite, from -{FAR:g} to {FAR:g}")
    return number


def checked_input(input_: object, at: str) -> Input:
    """Returns an input with Python's own whole numbers. Direction and aim may have any length; `clamp` corrects it.

    Args:
        input_: the value to check. A tuple without an aim is accepted, too.
        at: name of the argument, for the error.

    Raises:
        SceneError: `input_` is not an input.
    """
    if not isinstance(input_, tuple) or len(Input._fields) - len(input_) not in (0, 1):
        raise SceneError(f"{at} = {shown(input_)}: must be an `Input`")
    x, y, buttons, aim = (*input_, NO_AIM)[: len(Input._fields)]
    return Input(
        whole(x, f"{at}.move_x", -MOVE_PART_MAX, MOVE_PART_MAX),
        whole(y, f"{at}.move_y", -MOVE_PART_MAX, MOVE_PART_MAX),
        int(buttons) if isinstance(buttons, bool) else whole(buttons, f"{at}.buttons", 0, BUTTONS_MAX),
        NO_AIM if aim is NO_AIM else checked_aim(aim, f"{at}.aim"),
    )


def row(input_: Input, *, aim: bool = False) -> bytes:
    """Returns an input packed for `Inputs.rows`: 3 bytes, or 9 in a scene with aim."""
    x, y, buttons, aimed = input_
    plain = bytes((x & 0xFF, y & 0xFF, buttons & 0xFF))
    return plain + AIM.pack(*aimed) if aim else plain


def unpacked(row: bytes) -> Input:
    """Returns the input in a packed row of 3 or 9 bytes. Its direction and its aim may have any length."""
    if len(row) == ROW.size:
        return Input(*ROW.unpack(row))
    x, y, buttons, *aim = AIM_ROW.unpack(row)
    return Input(x, y, buttons, (aim[0], aim[1], aim[2]) if any(aim) else NO_AIM)


def clamp(input_: Input) -> Input:
    """Returns the input with its direction shortened to length 127, and its aim with length 32767 or 0.

    Both sides use this rule. It uses whole numbers only.
    """
    if input_.aim != NO_AIM:
        input_ = input_._replace(aim=normalised(input_.aim))
    x, y = input_.move_x, input_.move_y
    square = x * x + y * y
    if square <= MOVE_MAX * MOVE_MAX:
        return input_
    # |part| = floor(127 |part| / length): the longest vector of whole numbers in this direction.
    return input_._replace(move_x=_shortened(x, square), move_y=_shortened(y, square))


def _shortened(part: int, square: int) -> int:
    scaled = math.isqrt(MOVE_MAX * MOVE_MAX * part * part // square)
    return scaled if part >= 0 else -scaled
