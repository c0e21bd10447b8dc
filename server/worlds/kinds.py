"""The kinds of worlds that a server may make, and the names and properties of worlds."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from server.game_api.hosting import WorldsError as WorldsError
from server.players.ticket import Property, Ticket
from server.rules import Rules, overrides, prepared
from shared.checks import SceneError, shown, whole
from shared.scene import Scene

NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")
"""Pattern of the name of a kind or a world."""
TAKEN = frozenset("create drain healthz join live match metrics play readyz stats worlds".split())
"""Paths of the server that are no names of worlds."""
PROPERTIES_MAX, TEXT_MAX, WHOLE_MAX = 16, 64, (1 << 53) - 1
"""Maximum number of properties of a world, longest name or text of one, largest whole number in one."""


Pair = Callable[[list[Ticket]], Iterable[Sequence[Ticket]]]
"""Function that forms groups of tickets; each group gets a world of its own."""


@dataclass(frozen=True)
class Kind:
    """A declared kind of worlds.

    Args:
        name: name of the kind; its worlds are called NAME-1, NAME-2 and so on.
        scene: the scene, as the rules prepared it.
        rules: returns new rules for each world.
        pair: the rules' function `pair`, which forms groups of those who wait; None: a client joins at once.
        players_max: maximum number of players of one world.
        worlds_max: maximum number of worlds of this kind.
        empty_s: seconds after which a world without players ends.
        create: whether clients may create worlds, by themselves or by asking for a match.
        keep: whether a world that has ended because it was empty comes back with its data when a player joins it.
        runs_empty: whether a world ticks without players.
    """

    name: str
    scene: Scene
    rules: Callable[[], Rules]
    pair: Pair | None = None
    players_max: int = 16
    worlds_max: int = 200
    empty_s: float = 30.0
    create: bool = True
    keep: bool = False
    runs_empty: bool = False

    def __post_init__(self) -> None:
        checked_name(self.name, "kind")
        if not isinstance(self.scene, Scene):
            raise SceneError(f"kind {self.name}: scene = {shown(self.scene)}: must be a `Scene`")
        whole(self.players_max, f"kind {self.name}: players_max", 1, 1_000_000)
        whole(self.worlds_max, f"kind {self.name}: worlds_max", 1, 1_000_000)


def kind_of(name: str, rules: Callable[[], Rules], scene: Scene, **limits: Any) -> Kind:
    """Returns a kind whose worlds play by rules, in a scene that these prepare.

    Args:
        name: name of the kind.
        rules: returns new rules for each world.
        scene: the scene before `Rules.prepare`.
        limits: further fields of `Kind`.

    Raises:
        RulesError: the rules cannot be used.
        SceneError: the scene cannot be used, or a limit is out of range.
        WorldsError: the name cannot be used.
    """
    first = rules()
    pair = type(first).pair if overrides(first, "pair") else None
    return Kind(name, prepared(first, scene), rules, pair, **limits)


def checked_name(name: object, what: str) -> str:
    """Returns the name of a kind or a world.

    Raises:
        WorldsError: it is not a text of 1 to 32 small letters, digits and hyphens, or is a path of the server.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise WorldsError(f"{what} = {shown(name)}: must be 1 to 32 small letters, digits and hyphens, a letter first")
    if name in TAKEN:
        raise WorldsError(f"{what} = {name!r}: is a path of the server")
    return name


def checked_properties(properties: Mapping[str, object]) -> dict[str, Property]:
    """Returns the properties of a world.

    Raises:
        WorldsError: there are too many, or one is not a text, a whole number or a truth value, or is too long.
    """
    if len(properties) > PROPERTIES_MAX:
        raise WorldsError(f"{len(properties)} properties: at most {PROPERTIES_MAX}")
    checked: dict[str, Property] = {}
    for name, value in properties.items():
        if not 1 <= len(name) <= TEXT_MAX:
            raise WorldsError(f"property {shown(name)}: its name must be a text of 1 to {TEXT_MAX} characters")
        good = type(value) is bool or (type(value) is int and abs(value) <= WHOLE_MAX)
        if not good and not (isinstance(value, str) and len(value) <= TEXT_MAX):
            raise WorldsError(
                f"property {name} = {shown(value)}: must be a text of at most {TEXT_MAX} characters, a whole number, "
                "true or false"
            )
        checked[name] = value  # type: ignore[assignment]
    return checked


def matches(properties: Mapping[str, Property], wanted: Mapping[str, Property]) -> bool:
    """Returns whether a world's properties are those that a client wants; a client's values may all be texts."""
    return all(name in properties and as_text(properties[name]) == as_text(value) for name, value in wanted.items())


def as_text(value: Property) -> str:
    """Returns a property as it stands in the query of a path."""
    return str(value).lower() if isinstance(value, bool) else str(value)
