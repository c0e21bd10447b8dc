"""What an operator can set: defaults < TOML file < environment < flags; every mistake is named with its origin."""

import argparse
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from shared.checks import SceneError
from shared.scene import SCENES, TICK_RATE_MAX, load_scene

ENV_PREFIX = "SOVEREIGN_"
LOG_LEVELS = ("debug", "info", "warning", "error")

EPILOG = f"""\
Each setting can also come from the environment ({ENV_PREFIX}PORT=9000) or from a TOML file (port = 9000).
A flag wins over the environment, that over the file, and that over the default.
The server prints one line, "listening on ws://HOST:PORT", when it is ready, and answers GET /healthz and
GET /stats on the same port. SIGTERM or SIGINT: clients are told, exit code 0. A bad setting: exit code 2.
"""


class SettingsError(ValueError):
    """A setting that cannot be used; the message names the setting, the value and where it came from."""


class Kind(NamedTuple):
    """What a setting may be: the type it has in TOML, bounds or choices, and its help."""

    type: type[Any]
    help: str
    metavar: str | None = None
    low: int = 0
    high: int = 0
    choices: tuple[str, ...] = ()


def _setting(default: Any, kind: Kind) -> Any:
    return field(default=default, metadata={"kind": kind})


@dataclass(frozen=True)
class Settings:
    """All settings, valid. `origins` says where each one came from."""

    host: str = _setting("127.0.0.1", Kind(str, "address to listen on; 0.0.0.0 or :: for every interface", "ADDRESS"))
    port: int = _setting(8765, Kind(int, "TCP port; 0 lets the system pick one", "PORT", 0, 65535))
    scene: str = _setting("hills", Kind(str, "a built-in scene (--list-scenes) or the path of a scene file", "SCENE"))
    tick_rate: int | None = _setting(
        None, Kind(int, "ticks per second, instead of the scene's own", "HZ", 1, TICK_RATE_MAX)
    )
    stats: bool = _setting(True, Kind(bool, "answer GET /stats with counters and timings as JSON"))
    log_level: str = _setting("info", Kind(str, "what goes to stderr", choices=LOG_LEVELS))
    record: str | None = _setting(None, Kind(str, "record every change of the world into a new file", "FILE"))
    origins: Mapping[str, str] = field(default_factory=dict, compare=False)

    def to_toml(self) -> str:
        """The settings as a file that `--config` reads, with their origins as comments."""
        lines = []
        for name in KINDS:
            value = getattr(self, name)
            line = f"# {name} is not set" if value is None else f"{name} = {_toml(value)}"
            lines.append(f"{line}  # {self.origins.get(name, 'default')}")
        return "\n".join(lines) + "\n"


KINDS: dict[str, Kind] = {f.name: f.metadata["kind"] for f in fields(Settings) if "kind" in f.metadata}


def _toml(value: str | int | bool) -> str:
    if isinstance(value, str):
        escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or ord(c) == 127 or c in '"\\' else c for c in value)
        return f'"{escaped}"'
    return str(value).lower()


def _check(name: str, value: object, origin: str) -> Any:
    """The value of one setting. From a file it has a type already; anything else is text."""
    kind = KINDS[name]
    if isinstance(value, str) and not origin.startswith("file "):
        value = _typed(kind.type, value)
    if kind.type is int:
        good = isinstance(value, int) and not isinstance(value, bool) and kind.low <= value <= kind.high
        wanted = f"a whole number from {kind.low} to {kind.high}"
    elif kind.type is bool:
        good, wanted = isinstance(value, bool), "true or false"
    elif kind.choices:
        good, wanted = value in kind.choices, f"one of {', '.join(kind.choices)}"
    else:
        good, wanted = isinstance(value, str) and value.strip() == value != "", "a text without spaces around it"
    if not good:
        raise SettingsError(f"{name} = {value!r} (from {origin}): must be {wanted}")
    return value


def _typed(kind: type[Any], text: str) -> str | int | bool:
    """Text as a value of a type, or the text itself where it cannot be that."""
    if kind is int and text.removeprefix("-").isdecimal() and text.isascii():
        return int(text) if len(text) < 20 else text
    if kind is bool:
        return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}.get(text.lower(), text)
    return text


def load(flags: Mapping[str, str], environment: Mapping[str, str], config: str | None = None) -> Settings:
    """The settings in force.

    Args:
        flags: what was given on the command line, by the name of the setting.
        config: path of a TOML file.

    Raises:
        SettingsError: a value cannot be used, or the file cannot be read.
    """
    values: dict[str, Any] = {}
    origins: dict[str, str] = {}

    def take(name: str, value: object, origin: str) -> None:
        values[name] = _check(name, value, origin)
        origins[name] = origin

    if config is not None:
        for name, value in _read(config).items():
            if name not in KINDS:
                raise SettingsError(f"{name} (from file {config}): no such setting (there are {', '.join(KINDS)})")
            take(name, value, f"file {config}")
    for name in KINDS:
        variable = ENV_PREFIX + name.upper()
        if variable in environment:
            take(name, environment[variable], variable)
    for name, value in flags.items():
        take(name, value, "--" + name.replace("_", "-"))
    return Settings(**values, origins=origins)


def _read(path: str) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"config = {path!r}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"config = {path!r}: not valid TOML ({error})") from error


class _Parser(argparse.ArgumentParser):
    """One line for a mistake, not the usage and then a line."""

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{message}; --help lists all flags")


def parse(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> Settings | str:
    """The settings, or the text that the operator asked for instead (`--list-scenes`, `--print-config`).

    Raises:
        SettingsError: see `load`; also for flags that do not exist.
        SystemExit: after `--help`.
    """
    parser = _Parser(
        prog="python -m server",
        description="An authoritative game server: fixed ticks, WebSocket clients, one world.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    for name, kind in KINDS.items():
        default = getattr(Settings, name)
        parser.add_argument(
            "--" + name.replace("_", "-"),
            nargs="?" if kind.type is bool else None,
            const="true" if kind.type is bool else None,
            metavar="|".join(kind.choices) or kind.metavar or "true|false",
            help=kind.help + ("" if default is None else f" (default: {str(default).lower()})"),
            default=argparse.SUPPRESS,
        )
    parser.add_argument("--config", metavar="FILE", help=f"TOML file with settings (or {ENV_PREFIX}CONFIG)")
    parser.add_argument("--list-scenes", action="store_true", help="print the built-in scenes and exit")
    parser.add_argument("--print-config", action="store_true", help="print the settings in force and exit")
    flags = vars(parser.parse_args(arguments))
    config, listing, printing = (flags.pop(name) for name in ("config", "list_scenes", "print_config"))
    if listing:
        return list_scenes()
    settings = load(flags, environment, config or environment.get(ENV_PREFIX + "CONFIG"))
    return settings.to_toml() if printing else settings


def list_scenes() -> str:
    """One line for each built-in scene."""
    lines = []
    for path in sorted(SCENES.glob("*.toml")):
        try:
            scene = load_scene(path.stem)
        except SceneError as error:
            raise SettingsError(str(error)) from error
        size = " x ".join(str(32 * part) for part in scene.size)
        lines.append(f"{path.stem:<12} {size} blocks, {scene.tick_rate} ticks/s")
    return "\n".join(lines) + "\n"
