"""Checks of values that come from people: what is not as it should be raises `SceneError`.

Each error names the field (`at`: where it stands, like "templates[1].name") and the value. Numbers may be numpy's, and
come out as Python's own, which MessagePack can hold. A truth value is no number.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Set, Sized
from contextlib import suppress
from typing import Any

import numpy as np

WHOLE = (int, np.integer)
NUMBERS = (*WHOLE, float, np.floating)
"""Types of which a value is a number, if it is no truth value; `WHOLE`: a whole one."""

Vec = tuple[float, float, float]
Cell = tuple[int, int, int]


class SceneError(ValueError):
    """A value that no world can hold; the message names the field and the value."""


class MissingError(KeyError):
    """Something is named that is not there: an entity, or a segment; the message says which."""

    def __str__(self) -> str:
        return str(self.args[0])


def shown(value: object) -> str:
    """A value as an error shows it: short, and on one line, whatever it is."""
    try:
        text = repr(value)
    except Exception:  # a number of 5,000 digits, a list of lists of lists, an object of its own mind
        text = f"<{type(value).__name__}>"
    text = " ".join(text.split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def finite(value: object, at: str) -> float:
    """A finite number, as a float; not a truth value."""
    if isinstance(value, bool) or not isinstance(value, NUMBERS):
        raise SceneError(f"{at} = {shown(value)}: must be a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SceneError(f"{at} = {shown(value)}: must be finite")
    return number


def duration(value: object, at: str, *, endless: bool = False) -> float:
    """A number of 0 or more: a time in seconds, for example. With `endless`, math.inf is one, too."""
    if endless and value == math.inf:
        return math.inf
    if finite(value, at) < 0:
        raise SceneError(f"{at} = {shown(value)}: must not be negative")
    return finite(value, at)


def utf8(value: str) -> bool:
    """Whether UTF-8 can hold a text: a lone surrogate, half of a character, it cannot."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def text(value: object, at: str, longest: int = 64, shortest: int = 1) -> str:
    """Returns a text of `shortest` to `longest` characters that UTF-8 can hold."""
    if not isinstance(value, str) or not shortest <= len(value) <= longest:
        raise SceneError(f"{at} = {shown(value)}: must be a text of {shortest} to {longest} characters")
    if not utf8(value):
        raise SceneError(f"{at} = {shown(value)}: must be a text that UTF-8 can hold")
    return value


def boolean(value: object, at: str) -> bool:
    """True or false, as Python's own."""
    if not isinstance(value, bool | np.bool_):
        raise SceneError(f"{at} = {shown(value)}: must be true or false")
    return bool(value)


def whole(value: object, at: str, low: int, high: int) -> int:
    """A whole number from `low` to `high`; not a truth value."""
    if type(value) is int and low <= value <= high:
        return value
    if isinstance(value, bool) or not isinstance(value, WHOLE) or not low <= value <= high:
        raise SceneError(f"{at} = {shown(value)}: must be a whole number from {low} to {high}")
    return int(value)


def choice(value: object, at: str, choices: Collection[str]) -> str:
    """One of some texts."""
    if not isinstance(value, str) or value not in choices:
        raise SceneError(f"{at} = {shown(value)}: must be one of {', '.join(choices)}")
    return value


def items(value: object, at: str) -> list[Any]:
    """A list or a tuple, as a list."""
    if not isinstance(value, list | tuple):
        raise SceneError(f"{at} = {shown(value)}: must be a list")
    return list(value)


def vector(value: object, at: str) -> Vec:
    """Three finite numbers; an error in one names its axis."""
    x, y, z = (finite(part, f"{at}.{axis}") for axis, part in zip("xyz", _three(value, at, "numbers"), strict=True))
    return x, y, z


def cell(value: object, at: str, low: int, high: int) -> Cell:
    """Three whole numbers from `low` to `high`; an error in one names its axis."""
    parts = _three(value, at, "whole numbers")
    x, y, z = (whole(part, f"{at}.{axis}", low, high) for axis, part in zip("xyz", parts, strict=True))
    return x, y, z


def _three(value: object, at: str, what: str) -> list[Any]:
    """The parts of a list, a tuple, an array or a vector of three."""
    parts: list[Any] = []
    if isinstance(value, Sized) and isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping | Set):
        with suppress(TypeError):  # an array without a dimension
            parts = list(value) if len(value) == 3 else []
    if not parts:
        raise SceneError(f"{at} = {shown(value)}: must have three {what}")
    return parts
