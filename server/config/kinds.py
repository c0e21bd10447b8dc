"""The settings of the kinds of worlds: the tables `[worlds.NAME]` of the TOML file. Without any, there is one world.

[worlds.arena]
game = "my_game:Arena"
scene = "arena"
players_max = 8
options = { round_s = 90 }
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from server.config.limits import HOUR_S
from server.config.options import Option, SettingsError, checked, kinds_of, nearest, setting, to_toml

OPTIONS = "options"
"""Name of the table with the options of a kind's game."""


@dataclass(frozen=True)
class KindSettings:
    """The settings of one kind of worlds, checked. `origin` says where they come from, such as "file server.toml"."""

    game: str | None = setting(None, Option(str, "class with the rules of the game (default: none)", "MODULE:CLASS"))
    scene: str | None = setting(None, Option(str, "scene (default: the game's own, or the server's default)", "SCENE"))
    players_max: int = setting(16, Option(int, "maximum players of a world", "N", 1, 1_000_000))
    worlds_max: int = setting(200, Option(int, "maximum worlds of this kind at once", "N", 1, 100_000))
    empty_s: float = setting(
        30.0, Option(float, "seconds without players after which a world ends", "S", 0, 1000 * HOUR_S)
    )
    create: bool = setting(True, Option(bool, "clients may make worlds, by themselves or by asking for a match"))
    keep: bool = setting(
        False, Option(bool, "a world that ended because it was empty comes back with its data when a player joins it")
    )
    runs_empty: bool = setting(False, Option(bool, "a world ticks without players"))
    record: str | None = setting(
        None, Option(str, "directory for recordings, one file for each world (default: none)", "DIR")
    )
    start: int = setting(0, Option(int, "worlds made at the start: NAME, NAME-2, NAME-3, ...", "N", 0, 100_000))
    options: Mapping[str, object] = field(default_factory=dict)
    """Options of the game by name, as the operator gave them; `server.rules` checks them."""
    origin: str = field(default="", compare=False)
    given: frozenset[str] = field(default=frozenset(), compare=False)
    """Names of the settings that are not defaults."""

    def to_toml(self, name: str) -> Iterator[str]:
        """Yields the lines of the kind's table for the file, with the origins of the values as comments."""
        yield f"[worlds.{name}]"
        for key in KINDS:
            value = getattr(self, key)
            origin = self.origin if key in self.given else "default"
            yield f"# {key} is not set" if value is None else f"{key} = {to_toml(value)}  # {origin}"
        if self.options:
            yield f"[worlds.{name}.{OPTIONS}]"
        for key, option in self.options.items():
            shown = to_toml(option) if isinstance(option, str | int | float | bool) else repr(option)
            yield f"{key} = {shown}  # {self.origin}"


KINDS: dict[str, Option] = kinds_of(KindSettings)
"""Options of a kind's settings by name."""


def kinds_from(tables: object, origin: str) -> dict[str, KindSettings]:
    """Returns the kinds that a file declares, by name.

    Args:
        tables: the value of `worlds` in the file.
        origin: where it comes from, such as "file server.toml".

    Raises:
        SettingsError: a kind is not a table, or has an unknown name or a value that cannot be used.
    """
    if not isinstance(tables, dict):
        raise SettingsError(f"worlds = {tables!r} (from {origin}): must be tables, such as [worlds.arena]")
    return {name: _kind(name, table, origin) for name, table in tables.items()}


def _kind(name: str, table: object, origin: str) -> KindSettings:
    at = f"worlds.{name}"
    if not isinstance(table, dict):
        raise SettingsError(f"{at} = {table!r} (from {origin}): must be a table, such as [worlds.arena]")
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key in KINDS:
            values[key] = checked(f"{at}.{key}", KINDS[key], value, origin)
        elif key != OPTIONS:
            known = [*KINDS, OPTIONS]
            hint = nearest(key, known) or f" (there are {', '.join(known)})"
            raise SettingsError(f"{at}.{key} (from {origin}): no such setting{hint}")
    options = table.get(OPTIONS, {})
    if not isinstance(options, dict):
        raise SettingsError(f"{at}.{OPTIONS} = {options!r} (from {origin}): must be a table")
    if options and values.get("game") is None:
        raise SettingsError(f"{at}.{OPTIONS}.{next(iter(options))} (from {origin}): is of a game; set game, too")
    return KindSettings(**values, options=options, origin=origin, given=frozenset(values))
