"""Checks of values that come from people: what is not as it should be raises `SceneError`.

Each error names the field (`at`: where it stands, like "templates[1].name") and the value.
"""

import math
from typing import Any

Vec = tuple[float, float, float]
Cell = tuple[int, int, int]


class SceneError(ValueError):
    """A value that no world can hold; the message names the field and the value."""


def finite(value: object, at: str) -> float:
    """A finite number, as a float; not a boolean."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SceneError(f"{at} = {value!r}: must be a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SceneError(f"{at} = {value!r}: must be finite")
    return number


def text(value: object, at: str) -> None:
    """A text of 1 to 64 characters."""
    if not isinstance(value, str) or not 1 <= len(value) <= 64:
        raise SceneError(f"{at} = {value!r}: must be a text of 1 to 64 characters")


def boolean(value: object, at: str) -> None:
    """True or false."""
    if not isinstance(value, bool):
        raise SceneError(f"{at} = {value!r}: must be true or false")


def whole(value: object, at: str, low: int, high: int) -> int:
    """A whole number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise SceneError(f"{at} = {value!r}: must be a whole number from {low} to {high}")
    return value


def items(value: object, at: str) -> list[Any]:
    """A list or a tuple, as a list."""
    if not isinstance(value, list | tuple):
        raise SceneError(f"{at} = {value!r}: must be a list")
    return list(value)


def vector(value: object, at: str) -> Vec:
    """Three finite numbers; an error in one names its axis."""
    parts = items(value, at)
    if len(parts) != 3:
        raise SceneError(f"{at} = {value!r}: must have three numbers")
    x, y, z = (finite(part, f"{at}.{axis}") for axis, part in zip("xyz", parts, strict=True))
    return x, y, z


def cell(value: object, at: str, low: int, high: int) -> Cell:
    """Three whole numbers from `low` to `high`; an error in one names its axis."""
    parts = items(value, at)
    if len(parts) != 3:
        raise SceneError(f"{at} = {value!r}: must have three whole numbers")
    x, y, z = (whole(part, f"{at}.{axis}", low, high) for axis, part in zip("xyz", parts, strict=True))
    return x, y, z
