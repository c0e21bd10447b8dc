"""Checks of the functions of a game: they must be plain functions, because a tick does not wait."""

import inspect
from typing import Any

from shared.checks import shown


class RulesError(ValueError):
    """Rules that cannot be used. The message says why."""


def checked_function(act: object, at: str) -> None:
    """Checks that something is a plain function, which can be called within a tick.

    Args:
        act: the function to check.
        at: its name, for the error.

    Raises:
        RulesError: `act` cannot be called, or calling it would do nothing because it is async or a generator.
    """
    if not callable(act):
        raise RulesError(f"{at} = {shown(act)}: must be a function")
    if any(test(part) for test in ASYNC for part in (act, type(act).__call__)):
        raise RulesError(f"{at}: must not be async: it is called within a tick, which cannot wait")
    if inspect.isgeneratorfunction(act):
        raise RulesError(f"{at}: must not contain `yield`: a call of it would do nothing")


def checked_result(result: Any, name: str) -> Any:
    """Returns the result of a hook after a check.

    Args:
        result: the result.
        name: name of the hook, for the error.

    Raises:
        RulesError: the result is a coroutine or a generator, for example because a decorator hid that the hook is
            async. Nothing would run it.
    """
    if result is None or result is True or result is False:
        return result
    if inspect.isawaitable(result) or inspect.isgenerator(result) or inspect.isasyncgen(result):
        if inspect.iscoroutine(result):
            result.close()  # otherwise Python would warn that it was never awaited
        raise RulesError(f"{name} returned {type(result).__name__}, which nothing runs: it must be a plain function")
    return result


ASYNC = (inspect.iscoroutinefunction, inspect.isasyncgenfunction)
"""Tests that recognise an async function."""
