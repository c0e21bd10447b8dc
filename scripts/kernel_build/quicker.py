"""Lets Numba compile in less time, in this process: with the same result, byte for byte."""

from typing import Any


def quicken() -> None:
    """Removes two things that Numba does thousands of times and that take a quarter of its time. Call it once."""
    _flags_compare_fast()
    _types_are_found_once()


def _flags_compare_fast() -> None:
    """Lets Numba compare its flags by what was set.

    It reads 40 properties of both otherwise, for each call of a function that it meets.
    """
    from numba.core.targetconfig import TargetConfig

    plain: Any = TargetConfig.__eq__

    def equal(one: Any, other: Any) -> Any:
        return one is other or (type(one) is type(other) and one._values == other._values) or plain(one, other)

    TargetConfig.__eq__ = equal  # type: ignore[method-assign]
    TargetConfig.__hash__ = lambda flags: hash(type(flags))  # type: ignore[method-assign]


def _types_are_found_once() -> None:
    """Lets Numba keep the types of the calls of its own functions.

    It searches for those of `int64 + int64` whenever it meets an addition otherwise.
    """
    from numba.core.types import BaseFunction

    functions: Any = BaseFunction
    find = functions.get_call_type
    found: dict[Any, Any] = {}

    def kept(function: Any, context: Any, positional: Any, named: Any) -> Any:
        key = function, tuple(positional), tuple(sorted(named.items()))
        if key not in found:
            found[key] = find(function, context, positional, named)
        return found[key]

    functions.get_call_type = kept
