"""What a setting may be, and how its value is checked; every mistake names the setting, the value and its origin."""

import argparse
import difflib
import math
from collections.abc import Iterable, Sequence
from dataclasses import field, fields
from typing import Any, NamedTuple, NoReturn

from shared.checks import utf8

PLAIN = "without spaces around it, in UTF-8"
"""What a text must be that is a name, an address or a path."""


class SettingsError(ValueError):
    """A setting that cannot be used; the message names the setting, the value and where it came from."""


class Kind(NamedTuple):
    """What a setting may be: the type it has in TOML, bounds or choices, and its help."""

    type: type[Any]
    """str, int, float, bool, or tuple for a list of texts."""
    help: str
    metavar: str | None = None
    low: float = 0
    high: float = 0
    choices: tuple[str, ...] = ()


class Parser(argparse.ArgumentParser):
    """One line for a mistake, not the usage and then a line."""

    def flags(self, arguments: Sequence[str]) -> dict[str, Any]:
        """What the flags say, by name.

        Raises:
            SettingsError: they cannot be used.
            SystemExit: after `--help`.
        """
        found, rest = self.parse_known_args(arguments)
        if rest:
            meant = nearest(rest[0].partition("=")[0], self._option_string_actions, "--")
            self.error(f"unrecognized arguments: {' '.join(rest)}{meant}")
        return vars(found)

    def error(self, message: str) -> NoReturn:
        """Instead of the end of the program."""
        raise SettingsError(f"{message}; --help lists all flags")


def nearest(name: str, known: Iterable[str], prefix: str = "") -> str:
    """A word on which of these may have been meant, to go behind a mistake; empty if none is similar.

    Args:
        prefix: what all begin with, and what does not make them similar.
    """
    found = difflib.get_close_matches(name.removeprefix(prefix), [each.removeprefix(prefix) for each in known], 1)
    return f" (did you mean {prefix}{found[0]}?)" if found else ""


def setting(default: Any, kind: Kind) -> Any:
    """A dataclass field that an operator can set."""
    return field(default=default, metadata={"kind": kind})


def kinds_of(owner: Any) -> dict[str, Kind]:
    """The settings among the fields of a dataclass, by name."""
    return {f.name: f.metadata["kind"] for f in fields(owner) if "kind" in f.metadata}


def checked(name: str, kind: Kind, value: object, origin: str) -> Any:
    """The value of one setting. From a file it has a type already; anything else is text.

    Raises:
        SettingsError: it cannot be used.
    """
    if isinstance(value, str) and not origin.startswith("file "):
        value = _typed(kind.type, value)
    if kind.type is float and type(value) is int:
        value = float(value)
    if kind.type is int or kind.type is float:
        good = isinstance(value, int | float) and type(value) is kind.type and kind.low <= value <= kind.high
        wanted = f"a {'whole ' if kind.type is int else ''}number from {kind.low:.12g} to {kind.high:.12g}"
    elif kind.type is bool:
        good, wanted = isinstance(value, bool), "true or false"
    elif kind.type is tuple:
        good = isinstance(value, list) and all(_plain(part) for part in value)
        value, wanted = tuple(value) if isinstance(value, list) else value, f"a list of texts {PLAIN}"
    elif kind.choices:
        good, wanted = value in kind.choices, f"one of {', '.join(kind.choices)}"
    else:
        good, wanted = _plain(value), f"a text {PLAIN}"
    if not good:
        raise SettingsError(f"{name} = {value!r} (from {origin}): must be {wanted}")
    return value


def to_toml(value: str | int | float | bool | tuple[str, ...]) -> str:
    """A value as it stands in a TOML file."""
    if isinstance(value, str):
        escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or ord(c) == 127 or c in '"\\' else c for c in value)
        return f'"{escaped}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(to_toml, value))}]"
    return str(value).lower()


def _plain(value: object) -> bool:
    """Whether a value is a text that can be a name, an address or a path."""
    return isinstance(value, str) and value.strip() == value != "" and "\0" not in value and utf8(value)


def _typed(kind: type[Any], text: str) -> str | int | float | bool | list[str]:
    """Text as a value of a type, or the text itself where it cannot be that."""
    if kind is int and text.removeprefix("-").isdecimal() and text.isascii():
        return int(text) if len(text) < 20 else text
    if kind is float and text.isascii():
        try:
            number = float(text)
        except ValueError:
            return text
        return number if math.isfinite(number) else text
    if kind is bool:
        return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}.get(text.lower(), text)
    if kind is tuple:
        return [part.strip() for part in text.split(",")] if text else []
    return text
