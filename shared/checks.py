"""Checks of values that come from a program or a file; a wrong value raises `SceneError`.

The argument `at` names the field, like "templates[1].name"; each error names the field and the value. Numbers of numpy
are accepted and returned as Python's own, which MessagePack can hold. A truth value does not count as a number.
"""

import math
import sys
from collections.abc import Collection, Iterable, Mapping, Set, Sized
from contextlib import suppress
from typing import Any

Vec = tuple[float, float, float]
"""Three numbers: x, y, z."""
Cell = tuple[int, int, int]
"""Three whole numbers: the index of a segment, or the place of a block."""


class SceneError(ValueError):
    """A value that a world cannot hold; the message names the field and the value."""


class MissingError(KeyError):
    """An entity or a segment does not exist; the message says which."""

    def __str__(self) -> str:
        return str(self.args[0])


def shown(value: object) -> str:
    """Returns a value as a short text of one line, for an error; works for any object."""
    try:
        text = repr(value)
    except Exception:  # a number of 5,000 digits, a deeply nested list, or an object whose `__repr__` fails
        text = f"<{type(value).__name__}>"
    text = " ".join(text.split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def is_whole(value: object) -> bool:
    """Returns whether a value is a whole number: Python's or numpy's, and not a truth value."""
    if isinstance(value, int):
        return not isinstance(value, bool)
    return _is_numpys(value, "integer")


def is_truth(value: object) -> bool:
    """Returns whether a value is a truth value: Python's or numpy's."""
    return isinstance(value, bool) or _is_numpys(value, "bool_")


def own_number(value: Any) -> Any:
    """Returns a number of numpy as Python's own, and any other value as it is."""
    return value.item() if _is_numpys(value, "generic") else value


def _is_numpys(value: object, name: str) -> bool:
    """Returns whether a value is of a type of numpy. As long as nobody has imported numpy, no value is."""
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(value, getattr(numpy, name))


def finite(value: object, at: str) -> float:
    """Returns a finite number as a float.

    Raises:
        SceneError: `value` is not a number, or not finite.
    """
    if not (isinstance(value, float) or is_whole(value) or _is_numpys(value, "floating")):
        raise SceneError(f"{at} = {shown(value)}: must be a number")
    try:
        number = float(value)  # type: ignore[arg-type]
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SceneError(f"{at} = {shown(value)}: must be finite")
    return number


def duration(value: object, at: str, *, endless: bool = False) -> float:
    """Returns a number of 0 or more, for example a time in seconds.

    Args:
        value: the value to check.
        at: name of the field, for the error.
        endless: whether math.inf is allowed.

    Raises:
        SceneError: `value` is not such a number.
    """
    if endless and value == math.inf:
        return math.inf
    if finite(value, at) < 0:
        raise SceneError(f"{at} = {shown(value)}: must not be negative")
    return finite(value, at)


def utf8(value: str) -> bool:
    """Returns whether UTF-8 can hold a text; it cannot hold a lone surrogate, which is half of a character."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def text(value: object, at: str, longest: int = 64, shortest: int = 1) -> str:
    """Returns a text of `shortest` to `longest` characters that UTF-8 can hold.

    Raises:
        SceneError: `value` is not such a text.
    """
    if not isinstance(value, str) or not shortest <= len(value) <= longest:
        raise SceneError(f"{at} = {shown(value)}: must be a text of {shortest} to {longest} characters")
    if not utf8(value):
        raise SceneError(f"{at} = {shown(value)}: must be a text that UTF-8 can hold")
    return value


def boolean(value: object, at: str) -> bool:
    """Returns a truth value as Python's own.

    Raises:
        SceneError: `value` is not a truth value.
    """
    if not is_truth(value):
        raise SceneError(f"{at} = {shown(value)}: must be true or false")
    return bool(value)


def whole(value: object, at: str, low: int, high: int) -> int:
    """Returns a whole number from `low` to `high`.

    Raises:
        SceneError: `value` is not such a number.
    """
    if type(value) is int and low <= value <= high:
        return value
    if not is_whole(value) or not low <= value <= high:  # type: ignore[operator]
        raise SceneError(f"{at} = {shown(value)}: must be a whole number from {low} to {high}")
    return int(value)  # type: ignore[call-overload, no-any-return]


def choice(value: object, at: str, choices: Collection[str]) -> str:
    """Returns a text that is one of `choices`.

    Raises:
        SceneError: `value` is not one of them.
    """
    if not isinstance(value, str) or value not in choices:
        raise SceneError(f"{at} = {shown(value)}: must be one of {', '.join(choices)}")
    return value


def items(value: object, at: str) -> list[Any]:
    """Returns a list or a tuple as a list.

    Raises:
        SceneError: `value` is neither.
    """
    if not isinstance(value, list | tuple):
        raise SceneError(f"{at} = {shown(value)}: must be a list")
    return list(value)


def vector(value: object, at: str) -> Vec:
    """Returns three finite numbers.

    Raises:
        SceneError: `value` has not three numbers, or one is not finite; the message names the axis.
    """
    if type(value) is tuple and len(value) == 3:
        x, y, z = value
        if type(x) is type(y) is type(z) is float and math.isfinite(x + y + z):
            return x, y, z  # a short cut; the sum of finite numbers may be infinite, and then this goes on
    x, y, z = (finite(part, f"{at}.{axis}") for axis, part in zip("xyz", _three(value, at, "numbers"), strict=True))
    return x, y, z


def cell(value: object, at: str, low: int, high: int) -> Cell:
    """Returns three whole numbers from `low` to `high`.

    Raises:
        SceneError: `value` has not three such numbers; the message names the axis.
    """
    parts = _three(value, at, "whole numbers")
    x, y, z = (whole(part, f"{at}.{axis}", low, high) for axis, part in zip("xyz", parts, strict=True))
    return x, y, z


def _three(value: object, at: str, what: str) -> list[Any]:
    """Returns the three parts of a list, a tuple, an array or another vector.

    Raises:
        SceneError: `value` has not three parts, which `what` names.
    """
    parts: list[Any] = []
    if isinstance(value, Sized) and isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping | Set):
        with suppress(TypeError):  # an array without a dimension
            parts = list(value) if len(value) == 3 else []
    if not parts:
        raise SceneError(f"{at} = {shown(value)}: must have three {what}")
    return parts
