"""Options: the type, range and help text of each setting, and the check of its value.

Every error names the setting, the value and the origin of the value.
"""

import argparse
import difflib
import math
from collections.abc import Iterable, Sequence
from dataclasses import field, fields
from typing import Any, NamedTuple, NoReturn

from shared.checks import utf8

PLAIN = "without spaces around it, in UTF-8"
"""Requirement for a text that is a name, an address or a path; part of an error message."""


class SettingsError(ValueError):
    """A setting that cannot be used. The message names the setting, the value and its origin."""


class Option(NamedTuple):
    """An option: the type, range and help text of one setting."""

    type: type[Any]
    """Type of the value: str, int, float, bool, or tuple for a list of texts."""
    help: str
    """Text for `--help`."""
    metavar: str | None = None
    """Name of the value in `--help`, such as PORT."""
    low: float = 0
    """Smallest allowed number."""
    high: float = 0
    """Largest allowed number."""
    choices: tuple[str, ...] = ()
    """Allowed texts. Empty: any text."""


class Parser(argparse.ArgumentParser):
    """A command-line parser that raises `SettingsError` instead of printing the usage and ending the program."""

    def flags(self, arguments: Sequence[str]) -> dict[str, Any]:
        """Parses a command line. Returns the values of the flags by name.

        Raises:
            SettingsError: a flag does not exist, or its value cannot be used.
            SystemExit: after `--help`.
        """
        found, rest = self.parse_known_args(arguments)
        if rest:
            meant = nearest(rest[0].partition("=")[0], self._option_string_actions, "--")
            self.error(f"unrecognized arguments: {' '.join(rest)}{meant}")
        return vars(found)

    def error(self, message: str) -> NoReturn:
        """Raises `SettingsError`; argparse calls this for every mistake in the command line."""
        raise SettingsError(f"{message}; --help lists all flags")


def nearest(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Returns a hint such as " (did you mean port?)" to append to an error; empty if no known name is similar.

    Args:
        name: the unknown name.
        known: all known names.
        prefix: common beginning of the names, which is ignored in the comparison.
    """
    found = difflib.get_close_matches(name.removeprefix(prefix), [each.removeprefix(prefix) for each in known], 1)
    return f" (did you mean {prefix}{found[0]}?)" if found else ""


def setting(default: Any, kind: Option) -> Any:
    """Returns a dataclass field that an operator can set."""
    return field(default=default, metadata={"kind": kind})


def kinds_of(owner: Any) -> dict[str, Option]:
    """Returns the options of those fields of a dataclass that are settings, by name."""
    return {f.name: f.metadata["kind"] for f in fields(owner) if "kind" in f.metadata}


def checked(name: str, kind: Option, value: object, origin: str) -> Any:
    """Checks the value of one setting and returns it with the option's type.

    Args:
        name: name of the setting, for the error.
        kind: its option.
        value: the value: text from a flag or a variable, a typed value from a file.
        origin: where the value comes from. A value is not converted if this begins with "file ".

    Raises:
        SettingsError: the value has another type, is out of range, or is not one of the choices.
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
    """Returns a value in the notation of a TOML file."""
    if isinstance(value, str):
        escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or ord(c) == 127 or c in '"\\' else c for c in value)
        return f'"{escaped}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(to_toml, value))}]"
    return str(value).lower()


def _plain(value: object) -> bool:
    """Returns whether a value is a text that can be a name, an address or a path."""
    return isinstance(value, str) and value.strip() == value != "" and "\0" not in value and utf8(value)


def _typed(kind: type[Any], text: str) -> str | int | float | bool | list[str]:
    """Converts a text to a type. Returns the text itself if it cannot be converted."""
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
