"""The settings of a server, from flags, environment variables, a TOML file and defaults.

A flag takes precedence over the environment, the environment over the file, the file over the default. An error names
the setting, its value and where it came from.
"""

import argparse
import dataclasses
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

from server.config.kinds import KindSettings, kinds_from
from server.config.limits import HOUR_S, Limits
from server.config.options import Option, Parser, SettingsError, checked, kinds_of, nearest, setting, to_toml
from server.config.together import check_together
from shared import kernels
from shared.bounds import TICK_RATE_MAX
from shared.checks import SceneError
from shared.scene import SCENES, load_scene
from shared.units import SEGMENT

ENV_PREFIX = "SOVEREIGN_"
"""Beginning of the names of all environment variables that the server reads."""
CONFIG_VARIABLE = ENV_PREFIX + "CONFIG"
"""Environment variable with the path of the TOML file."""
ADDRESSES = ("none", "loopback", "private", "all")
"""Groups of client addresses, each including the one before; choices of the setting `figures`."""
KEY_VARIABLE, OPERATOR_VARIABLE = "SOVEREIGN_AUTH_KEY", "SOVEREIGN_OPERATOR_TOKEN"
"""Environment variables with secrets. They have no flags, because every user of a machine can read flags."""
ROLES = ("server", "sequencer", "edge", "standby")
"""Choices of the setting `role`."""
LOG_FORMATS = ("pretty", "json")
"""Choices of the setting `log_format`."""
LOG_LEVELS = ("debug", "info", "warning", "error")

DESCRIPTION = """\
An authoritative game server for WebSocket clients: a world of blocks at a fixed tick rate, with the rules of a game.

  sovereign-server                                              players walk, jump, dig and build on hills
  sovereign-server --game sovereign_netcode.examples.tag:Tag    the sample game; sovereign-play opens a window on it
"""
EPILOG = f"""\
Other commands: `sovereign-server token --help` issues tokens; `sovereign-server check --help` asks whether a
server is ready; `sovereign-server describe --game MODULE:CLASS` prints what a game consists of. Each setting
can also come from an environment variable ({ENV_PREFIX}PORT=9000) or from a TOML file (port = 9000; see
--print-config). A flag takes precedence over the environment, the environment over the file, the file over the
default. When the server is ready, it prints "listening on ws://HOST:PORT" and then the address of its live
page. It answers GET /healthz, /readyz, /stats and /metrics on the same port. After SIGTERM, SIGINT or SIGHUP it
tells its clients to reconnect later and exits with code 0. If a setting cannot be used, it exits with code 2.
"""


@dataclass(frozen=True)
class Settings:
    """All settings of a server, checked.

    `origins` has the origin of each setting that is not a default, by name: a flag, a variable or a file.
    """

    host: str = setting("127.0.0.1", Option(str, "address to listen on; 0.0.0.0 or :: for every interface", "ADDRESS"))
    port: int = setting(8765, Option(int, "TCP port; 0: the system chooses a free one", "PORT", 0, 65535))
    scene: str = setting(
        "hills", Option(str, "one of --list-scenes, or a scene file; a game may name its own", "SCENE")
    )
    reach: float | None = setting(
        None,
        Option(float, "distance up to which a player can edit blocks (default: the scene's own)", "BLOCKS", 0, 1024),
    )
    tick_rate: int | None = setting(
        None, Option(int, "ticks per second (default: the scene's own)", "HZ", 1, TICK_RATE_MAX)
    )
    auth: str = setting(
        "none",
        Option(
            str, "who may play: none (anyone), token (see `token --help`), or your own function MODULE:NAME", "AUTH"
        ),
    )
    auth_key_file: str | None = setting(
        None, Option(str, f"file with the key of the tokens; alternatively the key itself in {KEY_VARIABLE}", "FILE")
    )
    tls_cert: str | None = setting(None, Option(str, "file with the certificate (chain) for wss://, PEM", "FILE"))
    tls_key: str | None = setting(None, Option(str, "file with the certificate's key, PEM", "FILE"))
    figures: str = setting(
        "private", Option(str, "addresses that may read /stats, /metrics and the live page", choices=ADDRESSES)
    )
    page: bool = setting(True, Option(bool, "serve the live page at /: the world and its players in a browser"))
    play: bool = setting(True, Option(bool, "serve the page /play, on which everybody can play in a browser"))
    allowed_origins: tuple[str, ...] = setting(
        (),
        Option(
            tuple,
            "origins of web pages that may connect, besides those at the server's own IP address; * for all",
            "ORIGIN,...",
        ),
    )
    allowed_hosts: tuple[str, ...] = setting(
        (),
        Option(
            tuple,
            "host names under which pages (/stats, /healthz, ...) are served, besides IP addresses, localhost and the "
            "name in host; * for all",
            "NAME,...",
        ),
    )
    restart_s: float = setting(
        2.0, Option(float, "seconds after which clients should reconnect when the server stops", "S", 0, 3600)
    )
    drain_s: float = setting(
        0.0, Option(float, "seconds that worlds may go on to their end when the server is to stop", "S", 0, 24 * HOUR_S)
    )
    operator_token_file: str | None = setting(
        None, Option(str, f"file with the token of operators; alternatively itself in {OPERATOR_VARIABLE}", "FILE")
    )
    log_level: str = setting("info", Option(str, "lowest level of the log lines on stderr", choices=LOG_LEVELS))
    log_format: str = setting("pretty", Option(str, "format of the log", choices=LOG_FORMATS))
    game: str | None = setting(None, Option(str, "class with the rules of a game (default: none)", "MODULE:CLASS"))
    reload: bool = setting(
        False, Option(bool, "restart when a file beside the game changes; players come back by themselves")
    )
    seed: int = setting(0, Option(int, "seed of the random numbers of the rules", "N", 0, (1 << 63) - 1))
    record: str | None = setting(None, Option(str, "record every change of the world into this new file", "FILE"))
    kernel: str = setting(
        kernels.AUTO,
        Option(
            str,
            "code that computes the physics; all give the same bits; auto: the first that is available",
            choices=kernels.CHOICES,
        ),
    )
    data: str | None = setting(None, Option(str, "directory to save the world in, and to restore it from", "DIR"))
    durability: str = setting(
        "power",
        Option(str, "what a saved edit survives: the end of the process, or a power cut", choices=("process", "power")),
    )
    checkpoint_s: float = setting(
        60.0, Option(float, "seconds between two checkpoints of the saved world", "S", 0.1, 3600)
    )
    role: str = setting(
        "server",
        Option(str, "server: all of it; the others: one part of a world on many processes", choices=ROLES),
    )
    bus: str | None = setting(
        None, Option(str, "address of the NATS servers that join the parts: nats://HOST:PORT,...", "URL")
    )
    fleet: str | None = setting(
        None, Option(str, "name of the processes on the bus that hold many worlds together", "NAME")
    )
    world: str = setting("world", Option(str, "name of the world on the bus", "NAME"))
    bus_replicas: int = setting(1, Option(int, "NATS servers that each store the log of the world", "N", 1, 5))
    takeover_s: float = setting(
        0.25, Option(float, "seconds without a record after which a standby takes over", "S", 0.05, 60)
    )
    public_url: str | None = setting(
        None, Option(str, "address of this server for clients (default: ws://, its host and port)", "URL")
    )
    limits: Limits = field(default_factory=Limits)
    options: Mapping[str, object] = field(default_factory=dict)
    """Options of the game by name, as the operator gave them; `server.rules` checks them."""
    worlds: Mapping[str, KindSettings] = field(default_factory=dict)
    """Kinds of worlds by name; empty: the server has one world."""
    origins: Mapping[str, str] = field(default_factory=dict, compare=False)

    def to_toml(self) -> str:
        """Returns the settings as the text of a file for `--config`, with their origins as comments."""
        lines = []
        for section, names in SECTIONS.items():
            owner = getattr(self, section) if section else self
            lines += ["", f"[{section}]"] if section else []
            for name in names:
                value = getattr(owner, name)
                line = f"# {name} is not set" if value is None else f"{name} = {to_toml(value)}"
                runs = f"; runs: {kernels.describe(self.kernel)}" if name == "kernel" else ""
                lines.append(f"{line}  # {self.origins.get(name, 'default')}{runs}")
        lines += ["", "[options]"] if self.options else []
        for name, value in self.options.items():
            shown = to_toml(value) if isinstance(value, str | int | float | bool) else repr(value)
            lines.append(f"{name} = {shown}  # {self.origins.get(f'option {name}', 'default')}")
        for name, kind in self.worlds.items():
            lines += ["", *kind.to_toml(name)]
        return "\n".join(lines) + "\n"


GROUPS = {
    "the game": ("scene", "game", "seed", "tick_rate", "reach", "kernel"),
    "network": ("host", "port", "tls_cert", "tls_key", "allowed_origins", "allowed_hosts"),
    "access": ("auth", "auth_key_file"),
    "saving": ("data", "durability", "checkpoint_s", "record"),
    "many processes": ("role", "bus", "fleet", "world", "bus_replicas", "takeover_s", "public_url"),
    "operation": ("log_level", "log_format", "figures", "page", "play", "restart_s", "drain_s", "operator_token_file"),
}
"""Groups of settings as `--help` shows them, the ones for beginners first. Settings in no group are shown as limits."""
SECTIONS: dict[str, dict[str, Option]] = {"": kinds_of(Settings), "limits": kinds_of(Limits)}
"""Options by the table of the TOML file that has them, and by name. A name is in one table only."""
KINDS: dict[str, Option] = {name: kind for names in SECTIONS.values() for name, kind in names.items()}
"""Options of all settings by name."""
VARIABLES = [*(ENV_PREFIX + name.upper() for name in KINDS), CONFIG_VARIABLE, KEY_VARIABLE, OPERATOR_VARIABLE]
"""Environment variables that are read. Another variable that begins with `ENV_PREFIX` is an error."""
DEFAULTS: dict[str, Any] = {f.name: f.default for owner in (Settings, Limits) for f in dataclasses.fields(owner)}
"""Default values of all settings by name."""


def load(
    flags: Mapping[str, str],
    environment: Mapping[str, str],
    config: str | None = None,
    options: Sequence[str] = (),
) -> Settings:
    """Returns the settings from flags, environment, file and defaults, in this order of precedence.

    Args:
        flags: the values from the command line by the name of the setting.
        environment: the environment variables.
        config: path of a TOML file; None: no file.
        options: options of the game from the command line, each NAME=VALUE.

    Raises:
        SettingsError: a value cannot be used, a name is unknown, settings exclude each other, or the file cannot be
            read.
    """
    values: dict[str, Any] = {}
    origins: dict[str, str] = {}

    def take(name: str, value: object, origin: str) -> None:
        values[name] = checked(name, KINDS[name], value, origin)
        origins[name] = origin

    if config is not None:
        for name, value in _entries(config):
            take(name, value, f"file {config}")
    for variable in environment:
        if variable.startswith(ENV_PREFIX) and variable not in VARIABLES:
            raise SettingsError(
                f"{variable}: there is no such setting{nearest(variable.upper(), VARIABLES, ENV_PREFIX)}"
            )
    for name in KINDS:
        variable = ENV_PREFIX + name.upper()
        if variable in environment:
            take(name, environment[variable], variable)
    for name, value in flags.items():
        take(name, value, "--" + name.replace("_", "-"))
    if "host" in values:
        values["host"] = values["host"].removeprefix("[").removesuffix("]")  # an IPv6 address as it stands in a URL
    of_game: dict[str, object] = {}
    for name, value, origin in _options(options, config):
        of_game[name], origins[f"option {name}"] = value, origin
    limits = Limits(**{name: values.pop(name) for name in SECTIONS["limits"] if name in values})
    worlds = {} if config is None else kinds_from(_read(config).get("worlds", {}), f"file {config}")
    settings = Settings(**values, limits=limits, options=of_game, worlds=worlds, origins=origins)
    check_together(settings)
    return settings


def _entries(config: str) -> Iterator[tuple[str, object]]:
    """Yields the names and values of the settings in a file.

    Raises:
        SettingsError: the file cannot be read, or has an unknown name or a name in the wrong table.
    """
    tables = {"": _read(config)}
    for apart in ("options", "worlds"):
        tables[""].pop(apart, None)
    tables |= {name: tables[""].pop(name) for name in SECTIONS if isinstance(tables[""].get(name), dict)}
    for section, table in tables.items():
        known, place = SECTIONS[section], f"[{section}] in " if section else ""
        for name, value in table.items():
            if name not in known:
                hint = nearest(name, known) or f" (there are {', '.join(known)})"
                raise SettingsError(f"{name} (from {place}file {config}): no such setting{hint}")
            yield name, value


def _options(given: Sequence[str], config: str | None) -> Iterator[tuple[str, object, str]]:
    """Yields the options of the game: name, value and origin; those of the command line last.

    Raises:
        SettingsError: an option has no name, or `options` in the file is not a table.
    """
    table = {} if config is None else _read(config).get("options", {})
    if not isinstance(table, dict):
        raise SettingsError(f"options = {table!r} (from file {config}): must be a table")
    for name, value in table.items():
        yield name, value, f"file {config}"
    for text in given:
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise SettingsError(f"option = {text!r} (from --option): must be NAME=VALUE, like round_s=90")
        yield name, value, "--option"


def _read(path: str) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"config = {path!r}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"config = {path!r}: not valid TOML ({error})") from error


def parse(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> Settings | str:
    """Parses a command line.

    Returns:
        The settings, or the text to print instead of serving (`--list-scenes`, `--print-config`).

    Raises:
        SettingsError: a flag does not exist, or `load` raises it.
        SystemExit: after `--help`.
    """
    parser = Parser(
        prog="sovereign-server",
        usage="%(prog)s [options]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    grouped = {name for names in GROUPS.values() for name in names}
    for title, names in {**GROUPS, "limits": tuple(name for name in KINDS if name not in grouped)}.items():
        group = parser.add_argument_group(title)
        for name in names:
            kind, default = KINDS[name], DEFAULTS[name]
            group.add_argument(
                "--" + name.replace("_", "-"),
                nargs="?" if kind.type is bool else None,
                const="true" if kind.type is bool else None,
                metavar="|".join(kind.choices) or kind.metavar or "true|false",
                help=kind.help + ("" if default in (None, ()) else f" (default: {str(default).lower()})"),
                default=argparse.SUPPRESS,
            )
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of the game, like round_s=90; may be given several times (`describe --game ...` lists them)",
    )
    parser.add_argument("--config", metavar="FILE", help=f"TOML file with settings (or {CONFIG_VARIABLE})")
    parser.add_argument("--list-scenes", action="store_true", help="print the built-in scenes and exit")
    parser.add_argument(
        "--print-config", action="store_true", help="print all settings as a TOML file, with their origins, and exit"
    )
    flags = parser.flags(arguments)
    config, listing, printing, options = (
        flags.pop(name) for name in ("config", "list_scenes", "print_config", "option")
    )
    if listing:
        return list_scenes()
    settings = load(flags, environment, config or environment.get(CONFIG_VARIABLE), options)
    return settings.to_toml() if printing else settings


def list_scenes() -> str:
    """Returns a text with the name, the description and the size of each built-in scene."""
    lines = []
    for path in sorted(SCENES.glob("*.toml")):
        try:
            scene = load_scene(path.stem)
        except SceneError as error:
            raise SettingsError(str(error)) from error
        size = " x ".join(str(SEGMENT * part) for part in scene.size)
        kinds = ", ".join(template.name for template in scene.templates)
        lines.append(f"{path.stem:<12} {_said(path)}")
        lines.append(f"{'':<12} {size} blocks, {scene.tick_rate} ticks/s, templates: {kinds}")
    return "\n".join(lines) + "\n"


def _said(path: Path) -> str:
    """Returns the first sentence of the comment at the beginning of a file."""
    comment = takewhile(lambda line: line.startswith("#"), path.read_text("utf-8").splitlines())
    return " ".join(line[2:] for line in comment).partition(". ")[0].rstrip(".")
