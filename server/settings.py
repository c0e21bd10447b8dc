"""What an operator can set: defaults < TOML file < environment < flags; every mistake is named with its origin."""

import argparse
import dataclasses
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

from server.door import ANY, is_loopback
from server.kinds import Kind, Parser, SettingsError, checked, kinds_of, nearest, setting, to_toml
from server.limits import Limits
from server.log import FORMATS
from server.tokens import KEY_VARIABLE
from shared import kernels
from shared.bounds import TICK_RATE_MAX
from shared.checks import SceneError
from shared.scene import SCENES, load_scene
from shared.units import SEGMENT

ENV_PREFIX = "SOVEREIGN_"
CONFIG_VARIABLE = ENV_PREFIX + "CONFIG"
ADDRESSES = ("none", "loopback", "private", "all")
LOG_LEVELS = ("debug", "info", "warning", "error")

DESCRIPTION = """\
An authoritative game server: fixed ticks, WebSocket clients, one world of blocks, and the rules of a game on top.

  sovereign-server                                              players walk, jump, dig and build on hills
  sovereign-server --game sovereign_netcode.examples.tag:Tag    the sample game; sovereign-play opens a window on it
"""
EPILOG = f"""\
Other commands: `sovereign-server token --help` (issue tokens), `sovereign-server check --help` (is it ready?).
Each setting can also come from the environment ({ENV_PREFIX}PORT=9000) or from a TOML file (port = 9000; see
--print-config). A flag wins over the environment, that over the file, and that over the default.
The server prints "listening on ws://HOST:PORT" when it is ready, then the address of its live page. It answers GET
/healthz, /readyz, /stats and /metrics on the same port. SIGTERM, SIGINT or SIGHUP: clients are told, exit code 0.
A bad setting: exit code 2.
"""


@dataclass(frozen=True)
class Settings:
    """All settings, valid. `origins` says where each one came from."""

    host: str = setting("127.0.0.1", Kind(str, "address to listen on; 0.0.0.0 or :: for every interface", "ADDRESS"))
    port: int = setting(8765, Kind(int, "TCP port; 0 lets the system pick one", "PORT", 0, 65535))
    scene: str = setting("hills", Kind(str, "one of --list-scenes, or a scene file; games may have their own", "SCENE"))
    reach: float | None = setting(
        None,
        Kind(float, "blocks that a player's hands reach, instead of the scene's own", "BLOCKS", 0, 1024),
    )
    tick_rate: int | None = setting(
        None, Kind(int, "ticks per second (default: the scene's own)", "HZ", 1, TICK_RATE_MAX)
    )
    auth: str = setting(
        "none", Kind(str, "who may play: none (anyone), token (see `token --help`), or MODULE:NAME of your own", "AUTH")
    )
    auth_key_file: str | None = setting(
        None, Kind(str, f"file with the key of the tokens; or the key itself in {KEY_VARIABLE}", "FILE")
    )
    tls_cert: str | None = setting(None, Kind(str, "file with the certificate (chain) for wss://, PEM", "FILE"))
    tls_key: str | None = setting(None, Kind(str, "file with the certificate's key, PEM", "FILE"))
    figures: str = setting(
        "private", Kind(str, "whose addresses get /stats, /metrics and the live page", choices=ADDRESSES)
    )
    page: bool = setting(True, Kind(bool, "serve the live page: the world and its players in a browser, at /"))
    allowed_origins: tuple[str, ...] = setting(
        (),
        Kind(
            tuple,
            "pages that browsers may play from, besides those at the server's own IP address; * for all",
            "ORIGIN,...",
        ),
    )
    allowed_hosts: tuple[str, ...] = setting(
        (),
        Kind(
            tuple,
            "names by which pages (/stats, /healthz, ...) may be asked for, besides IP addresses, localhost and the "
            "name in host; * for all",
            "NAME,...",
        ),
    )
    restart_s: float = setting(
        2.0, Kind(float, "when it ends, clients are told to come back after so long", "S", 0, 3600)
    )
    log_level: str = setting("info", Kind(str, "what goes to stderr", choices=LOG_LEVELS))
    log_format: str = setting("pretty", Kind(str, "how it looks", choices=FORMATS))
    game: str | None = setting(None, Kind(str, "the rules of a game (default: none)", "MODULE:CLASS"))
    seed: int = setting(0, Kind(int, "of the randomness of its rules", "N", 0, (1 << 63) - 1))
    record: str | None = setting(None, Kind(str, "record every change of the world into a new file", "FILE"))
    kernel: str = setting(
        kernels.AUTO,
        Kind(
            str,
            "what computes the physics, all to the same bits; auto: the first that is there",
            choices=kernels.CHOICES,
        ),
    )
    data: str | None = setting(None, Kind(str, "save the world there, and go on with the one that is there", "DIR"))
    durability: str = setting(
        "power",
        Kind(str, "what a saved edit survives: the end of the process, or a power cut", choices=("process", "power")),
    )
    checkpoint_s: float = setting(60.0, Kind(float, "a checkpoint of the saved world so often", "S", 0.1, 3600))
    limits: Limits = field(default_factory=Limits)
    origins: Mapping[str, str] = field(default_factory=dict, compare=False)

    def to_toml(self) -> str:
        """The settings as a file that `--config` reads, with their origins as comments."""
        lines = []
        for section, names in SECTIONS.items():
            owner = getattr(self, section) if section else self
            lines += ["", f"[{section}]"] if section else []
            for name in names:
                value = getattr(owner, name)
                line = f"# {name} is not set" if value is None else f"{name} = {to_toml(value)}"
                runs = f"; runs: {kernels.describe(self.kernel)}" if name == "kernel" else ""
                lines.append(f"{line}  # {self.origins.get(name, 'default')}{runs}")
        return "\n".join(lines) + "\n"


GROUPS = {
    "what is played": ("scene", "game", "seed", "tick_rate", "reach", "kernel"),
    "where it listens": ("host", "port", "tls_cert", "tls_key", "allowed_origins", "allowed_hosts"),
    "who may play": ("auth", "auth_key_file"),
    "what is kept": ("data", "durability", "checkpoint_s", "record"),
    "what is told": ("log_level", "log_format", "figures", "restart_s"),
}
"""The settings as `--help` shows them, those of a stranger first; all others are limits."""
SECTIONS: dict[str, dict[str, Kind]] = {"": kinds_of(Settings), "limits": kinds_of(Limits)}
"""The settings by the table of a TOML file that they stand in. Names are unique, wherever they stand."""
KINDS: dict[str, Kind] = {name: kind for names in SECTIONS.values() for name, kind in names.items()}
VARIABLES = [*(ENV_PREFIX + name.upper() for name in KINDS), CONFIG_VARIABLE, KEY_VARIABLE]
"""What is read from the environment; others that begin like these are mistakes."""
DEFAULTS: dict[str, Any] = {f.name: f.default for owner in (Settings, Limits) for f in dataclasses.fields(owner)}


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
    limits = Limits(**{name: values.pop(name) for name in SECTIONS["limits"] if name in values})
    settings = Settings(**values, limits=limits, origins=origins)
    _check_together(settings)
    return settings


def _check_together(settings: Settings) -> None:
    """What only makes sense together."""
    host = settings.host
    if "auth" not in settings.origins and not (host == "localhost" or is_loopback(host)):
        raise SettingsError(
            f"host = {host!r} (from {settings.origins['host']}): others can reach it, so say who may play: "
            "--auth token, or --auth none for anyone"
        )
    if settings.auth not in ("none", "token") and not all(settings.auth.partition(":")):
        raise SettingsError(
            f"auth = {settings.auth!r} (from {settings.origins['auth']}): must be none, token, or MODULE:NAME"
        )
    for name in settings.allowed_hosts:
        if any(sign in name for sign in ":/[]*") and name != ANY:
            raise SettingsError(
                f"allowed_hosts = {name!r} (from {settings.origins['allowed_hosts']}): must be a host name, without "
                f"scheme and port, or {ANY} for all"
            )
    if why := kernels.missing(settings.kernel):
        raise SettingsError(f"kernel = {settings.kernel!r} (from {settings.origins['kernel']}): {why}")
    if (settings.tls_cert is None) != (settings.tls_key is None):
        given, missing = ("tls_cert", "tls_key") if settings.tls_key is None else ("tls_key", "tls_cert")
        raise SettingsError(f"{given} (from {settings.origins[given]}): needs {missing} as well")


def _entries(config: str) -> Iterator[tuple[str, object]]:
    """The settings in a file, each in the table where it belongs."""
    tables = {"": _read(config)}
    tables |= {name: tables[""].pop(name) for name in SECTIONS if isinstance(tables[""].get(name), dict)}
    for section, table in tables.items():
        known, place = SECTIONS[section], f"[{section}] in " if section else ""
        for name, value in table.items():
            if name not in known:
                hint = nearest(name, known) or f" (there are {', '.join(known)})"
                raise SettingsError(f"{name} (from {place}file {config}): no such setting{hint}")
            yield name, value


def _read(path: str) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"config = {path!r}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"config = {path!r}: not valid TOML ({error})") from error


def parse(arguments: Sequence[str], environment: Mapping[str, str] = os.environ) -> Settings | str:
    """The settings, or the text that the operator asked for instead (`--list-scenes`, `--print-config`).

    Raises:
        SettingsError: see `load`; also for flags that do not exist.
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
    told = {name for names in GROUPS.values() for name in names}
    for title, names in {**GROUPS, "limits": tuple(name for name in KINDS if name not in told)}.items():
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
    parser.add_argument("--config", metavar="FILE", help=f"TOML file with settings (or {CONFIG_VARIABLE})")
    parser.add_argument("--list-scenes", action="store_true", help="print the built-in scenes and exit")
    parser.add_argument("--print-config", action="store_true", help="print the settings in force and exit")
    flags = parser.flags(arguments)
    config, listing, printing = (flags.pop(name) for name in ("config", "list_scenes", "print_config"))
    if listing:
        return list_scenes()
    settings = load(flags, environment, config or environment.get(CONFIG_VARIABLE))
    return settings.to_toml() if printing else settings


def list_scenes() -> str:
    """For each built-in scene its name, what its file says of it, and its size."""
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
    """The first sentence of the comment that a file begins with."""
    comment = takewhile(lambda line: line.startswith("#"), path.read_text("utf-8").splitlines())
    return " ".join(line[2:] for line in comment).partition(". ")[0].rstrip(".")
