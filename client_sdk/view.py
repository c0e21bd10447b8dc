"""The view: what to draw at one moment, as the program gets it. `client_sdk.view_builder` makes it."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from shared.checks import Vec

NO_VALUES: Mapping[str, Any] = MappingProxyType({})
"""Attributes or fields of an entity that has none."""


class EntityView(NamedTuple):
    """One entity to draw: its number, position in blocks, velocity in blocks/s, and the name of its template.

    `attributes` are the named values that the rules of the game gave to the entity, for example "name". `fields` are
    the fields of its behaviour. `facing` is a direction of length 1, east and north: the one in which the entity aims,
    or else last walked or moved.
    """

    entity: int
    template: str
    position: Vec
    velocity: Vec
    attributes: Mapping[str, Any] = NO_VALUES
    fields: Mapping[str, int] = NO_VALUES
    facing: tuple[float, float] = (1.0, 0.0)


@dataclass(frozen=True)
class View:
    """Everything to draw at one moment.

    `me` is the own entity at `tick`; None before there is one. `others` are all other entities, ascending by number.
    `seen` is the view tick: the server time at which the others are drawn, in ticks. Commands carry it, so that the
    server can judge a shot by what the player saw (`game.rewound`).
    """

    tick: float
    me: EntityView | None
    others: list[EntityView]
    seen: float = 0.0

    @property
    def figures(self) -> list[EntityView]:
        """All entities of the view, the own one last."""
        return self.others if self.me is None else [*self.others, self.me]


NOTHING = View(0.0, None, [])
"""The view before the client has joined."""
