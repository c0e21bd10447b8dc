"""The kinds of worlds that the settings declare, with their rules and scenes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from server.config.kinds import KindSettings
from server.config.options import SettingsError
from server.config.settings import DEFAULTS, Settings
from server.rules import Rules, RulesError, load_rules
from server.worlds.kinds import Kind, WorldsError, kind_of
from shared.checks import SceneError
from shared.scene import load_scene


def declared_kinds(settings: Settings) -> dict[str, Kind]:
    """Returns the kinds of the settings, by name.

    Raises:
        SettingsError: a kind cannot be used. The text names it and says why.
    """
    return {name: _kind(name, found) for name, found in settings.worlds.items()}


def _kind(name: str, found: KindSettings) -> Kind:
    with _named(name, found):
        rules = _maker(found)
        first = rules()
        scene = load_scene(found.scene or first.scene or DEFAULTS["scene"])
        return kind_of(
            name,
            rules,
            scene,
            players_max=found.players_max,
            worlds_max=found.worlds_max,
            empty_s=found.empty_s,
            create=found.create,
            keep=found.keep,
            runs_empty=found.runs_empty,
        )


def _maker(found: KindSettings) -> Callable[[], Rules]:
    """Returns the function that makes new rules for each world."""
    game = found.game
    return Rules if game is None else lambda: load_rules(game, found.options)


@contextmanager
def _named(name: str, found: KindSettings) -> Iterator[None]:
    """Puts the name of a kind in front of the errors within the context."""
    try:
        yield
    except (RulesError, SceneError, WorldsError) as error:
        raise SettingsError(f"worlds.{name} (from {found.origin}): {error}") from error
