"""Declared commands of a game: their fields with types and bounds, which are checked before a hook gets them.

    class Shop(Rules):
        commands = {
            "buy": {"item": one_of("sword", "bow"), "count": whole_number(1, 99, default=1)},
            "say": {"text": words(200)},
            "leave_team": {},
        }

A client sends a table: `client.command("buy", {"item": "bow"})`. The hook `on_command` gets a table with exactly the
declared fields. A number out of bounds is set to the nearest bound. A command with a value of another type, an unknown
or a missing field, or another name is refused, with a reason that names it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from shared.checks import SceneError, finite, shown, text, whole
from shared.fields import NAME_MAX, PAYLOAD_MAX

REQUIRED: Any = object()
"""Default of a field that a client must send."""


class RefusedError(ValueError):
    """A command that does not match its declaration; the message is the reason for the client."""


@dataclass(frozen=True)
class Value:
    """A declared field: its description, its check, and its default.

    `check` returns the value that the hook gets, or raises `ValueError` with what the value must be.
    """

    description: str
    check: Callable[[Any], Any]
    default: Any = REQUIRED


Commands = Mapping[str, Mapping[str, Value]]
"""Declared commands: the fields of each, by name."""


def whole_number(low: int, high: int, *, default: Any = REQUIRED) -> Value:
    """Returns a field that is a whole number; beyond its bounds it is set to the nearest one."""
    whole(low, "low", -(1 << 63), high)

    def check(value: Any) -> int:
        if type(value) is not int:
            raise ValueError("must be a whole number")
        return min(max(value, low), high)

    return Value(f"whole number, {low} to {high}", check, default)


def number(low: float, high: float, *, default: Any = REQUIRED) -> Value:
    """Returns a field that is a finite number; beyond its bounds it is set to the nearest one."""
    least, most = finite(low, "low"), finite(high, "high")
    if least > most:
        raise SceneError(f"low = {low!r}, high = {high!r}: low must not be above high")

    def check(value: Any) -> float:
        if type(value) not in (int, float) or not math.isfinite(value):
            raise ValueError("must be a finite number")
        return min(max(float(value), least), most)

    return Value(f"number, {least:g} to {most:g}", check, default)


def words(longest: int, shortest: int = 0, *, default: Any = REQUIRED) -> Value:
    """Returns a field that is a text of `shortest` to `longest` characters; a longer one is cut off."""
    whole(longest, "longest", 1, PAYLOAD_MAX)
    whole(shortest, "shortest", 0, longest)

    def check(value: Any) -> str:
        if type(value) is not str or len(value) < shortest:
            raise ValueError(f"must be a text of at least {shortest} characters" if shortest else "must be a text")
        return value[:longest]

    return Value(f"text, {shortest} to {longest} characters", check, default)


def one_of(*choices: str, default: Any = REQUIRED) -> Value:
    """Returns a field that is one of some texts."""
    names = [text(choice, "one_of") for choice in choices]
    if not names:
        raise SceneError("one_of: needs at least one text")

    def check(value: Any) -> str:
        if type(value) is not str or value not in names:
            raise ValueError(f"must be one of {', '.join(names)}")
        return value

    return Value(f"one of {', '.join(names)}", check, default)


def flag(*, default: Any = REQUIRED) -> Value:
    """Returns a field that is true or false."""

    def check(value: Any) -> bool:
        if type(value) is not bool:
            raise ValueError("must be true or false")
        return value

    return Value("true or false", check, default)


def checked(commands: Commands, name: str, payload: Any) -> dict[str, Any]:
    """Returns the fields of a command as the hook gets them.

    Raises:
        RefusedError: the command does not match its declaration.
    """
    fields = commands.get(name)
    if fields is None:
        raise RefusedError(f"{shown(name)}: no such command (there are {', '.join(commands)})")
    given = {} if payload is None else payload
    if type(given) is not dict:
        raise RefusedError(f"{name}: must be a table of {', '.join(fields) or 'no fields'}")
    for key in given:
        if key not in fields:
            raise RefusedError(f"{name}.{shown(key)}: no such field (there are {', '.join(fields) or 'none'})")
    found: dict[str, Any] = {}
    for key, value in fields.items():
        if key not in given:
            if value.default is REQUIRED:
                raise RefusedError(f"{name}.{key}: missing")
            found[key] = value.default
            continue
        try:
            found[key] = value.check(given[key])
        except ValueError as error:
            raise RefusedError(f"{name}.{key} = {shown(given[key])}: {error}") from None
    return found


def check_declaration(commands: object, at: str) -> None:
    """Checks the declaration of commands.

    Args:
        commands: the declaration.
        at: its name, for the error.

    Raises:
        SceneError: it is not a table of tables of fields, or a default does not match its field.
    """
    if not isinstance(commands, Mapping):
        raise SceneError(f"{at} = {shown(commands)}: must be a table of commands")
    for name, fields in commands.items():
        where = f"{at}[{shown(name)}]"
        text(name, f"{at}: the name of a command", NAME_MAX)
        if not isinstance(fields, Mapping):
            raise SceneError(f"{where} = {shown(fields)}: must be a table of fields")
        for key, value in fields.items():
            text(key, f"{where}: the name of a field", NAME_MAX)
            if not isinstance(value, Value):
                raise SceneError(f"{where}.{key} = {shown(value)}: must be whole_number(...), words(...), ...")
            if value.default is not REQUIRED:
                try:
                    value.check(value.default)
                except ValueError as error:
                    raise SceneError(f"{where}.{key}: default = {shown(value.default)}: {error}") from None


def option(value: Value, given: object) -> Any:
    """Returns the value of an option of a game after a check.

    Args:
        value: the declaration.
        given: a value, or a text from the command line, which is converted.

    Raises:
        ValueError: it does not match the declaration. The message says what it must be.
    """
    for candidate in _readings(given) if isinstance(given, str) else (given,):
        try:
            found = value.check(candidate)
        except ValueError:
            continue
        if found == candidate:  # a command's number out of bounds is set to the bound, but an option is an error
            return found
    raise ValueError(f"must be: {value.description}")


def _readings(given: str) -> Iterator[Any]:
    """Yields a text, and what else it can mean."""
    for read in (int, float):
        with suppress(ValueError):
            yield read(given)
    if given in BOOLEANS:
        yield BOOLEANS[given]
    yield given


def check_options(options: object, owner: type) -> None:
    """Checks the declaration of options.

    Raises:
        SceneError: it is not a table of fields with defaults, or a name cannot be an attribute of the rules.
    """
    at = f"{owner.__qualname__}.options"
    if not isinstance(options, Mapping):
        raise SceneError(f"{at} = {shown(options)}: must be a table of fields")
    check_declaration({"options": options}, at)
    for name, value in options.items():
        if not name.isidentifier() or name.startswith("_") or hasattr(owner, name):
            raise SceneError(f"{at}[{name!r}]: must be a name that is no other attribute of the class")
        if value.default is REQUIRED:
            raise SceneError(f"{at}[{name!r}]: needs a default")


BOOLEANS = {"true": True, "yes": True, "false": False, "no": False}
"""Texts of the command line that can mean a truth value."""
