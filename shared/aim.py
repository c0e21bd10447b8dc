"""Aim: a direction in space of three whole numbers, never an angle.

Sines and cosines differ between machines, so an angle would give each side another direction. A direction of whole
numbers is shortened or lengthened by whole numbers alone, so both sides get the same bits.
"""

import math

from shared.checks import SceneError, Vec, shown, vector, whole
from shared.units import rounded

Aim = tuple[int, int, int]
"""A direction: x (east), y (north) and z (up), each in -32767..32767."""

AIM_MAX = 32767
"""Length of an aim. The whole numbers that come closest are at most 2 shorter."""
NO_AIM: Aim = (0, 0, 0)
"""Aim of a player that aims nowhere."""
AIM_PART_MAX = 1 << 31
"""Greatest part of a direction of whole numbers that is accepted."""
SCALE = 1 << 30
"""Longest part of a direction of floats, when it becomes whole numbers."""

_LONGEST, _SHORTEST = AIM_MAX**2, (AIM_MAX - 2) ** 2


def is_normal(aim: object) -> bool:
    """Returns whether a value is an aim that `normalised` leaves as it is."""
    if type(aim) is not tuple or len(aim) != len(NO_AIM):
        return False
    x, y, z = aim
    if not type(x) is type(y) is type(z) is int:
        return False
    return _SHORTEST <= x * x + y * y + z * z <= _LONGEST or aim == NO_AIM


def normalised(aim: Aim) -> Aim:
    """Returns the aim with this direction and the length 32767, in whole numbers. Both sides use this rule.

    A direction of length 0 stays as it is, and so does one that has the length already.
    """
    if is_normal(aim):
        return aim
    x, y, z = aim
    square = x * x + y * y + z * z
    # |part| = floor(32767 |part| / length), so the result is never too long, and less than sqrt(3) too short
    return _scaled(x, square), _scaled(y, square), _scaled(z, square)


def _scaled(part: int, square: int) -> int:
    scaled = math.isqrt(_LONGEST * part * part // square)
    return scaled if part >= 0 else -scaled


def make_aim(direction: object, at: str = "aim") -> Aim:
    """Returns the aim for a direction (x, y, z) of any length; (0, 0, 0) aims nowhere.

    Args:
        direction: three numbers. Floats are accepted, and rounded once.
        at: name of the argument, for the error.

    Raises:
        SceneError: it has not three numbers, or one is not finite.
    """
    parts = vector(direction, at)
    longest = max(map(abs, parts))
    if longest > AIM_PART_MAX or any(part % 1 for part in parts):
        parts = tuple(rounded(part / longest * SCALE) for part in parts)  # type: ignore[assignment]
    x, y, z = parts
    return normalised((int(x), int(y), int(z))) if longest else NO_AIM


def checked_aim(aim: object, at: str) -> Aim:
    """Returns a direction of three whole numbers, with Python's own. Its length may be any.

    Raises:
        SceneError: it is not such a direction.
    """
    if not isinstance(aim, tuple) or len(aim) != len(NO_AIM):
        raise SceneError(f"{at} = {shown(aim)}: must be three whole numbers")
    x, y, z = (whole(part, f"{at}.{axis}", -AIM_PART_MAX, AIM_PART_MAX) for axis, part in zip("xyz", aim, strict=True))
    return (x, y, z) if x or y or z else NO_AIM


def direction(aim: Aim) -> Vec | None:
    """Returns an aim as three floats, a vector of length 1; None if it aims nowhere."""
    x, y, z = aim
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length) if length else None
