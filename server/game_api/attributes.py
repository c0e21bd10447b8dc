"""The attributes of entities: values that the rules set, and that every client gets that sees the entity."""

from collections.abc import Mapping
from typing import Any

from server.game_api import values
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import ATTRIBUTES
from shared.checks import text
from shared.fields import NAME_MAX


class Attributes:
    """The attributes of all entities of one game.

    Args:
        world: notes each change, for a recording and for the saved world.
        changed: where entities are added whose attributes change (`Outcome.attributes`).
        table: attributes by entity, as part of the persisted state.
    """

    def __init__(self, world: RecordedWorld, changed: set[int], table: dict[int, dict[str, Any]]) -> None:
        self._world, self._changed, self._table = world, changed, table

    def get(self, entity: int, name: str, default: Any) -> Any:
        """Returns an attribute, or `default` if it is not set. A list or a table is a copy."""
        known = self._table.get(entity, {})
        return values.copied(known.get(text(name, "name", NAME_MAX), default))

    def set(self, entity: int, name: str, value: Any) -> None:
        """Sets an attribute of an existing entity.

        Raises:
            SceneError: the entity would have too many attributes, or the name or the value is wrong.
        """
        before, payload = self._table.get(entity, {}), values.checked(name, value)
        if payload != values.packed(before.get(name)):
            self.put(entity, values.with_value(before, name, payload, f"entity {entity}"))

    def put(self, entity: int, attributes: Mapping[str, Any]) -> None:
        """Replaces all attributes of an existing entity by checked ones."""
        self._table[entity] = dict(attributes)
        self._changed.add(entity)
        self._world.note([ATTRIBUTES, entity, attributes])

    def forget(self, entity: int) -> None:
        """Forgets the attributes of an entity that was removed."""
        self._table.pop(entity, None)


def checked(attributes: Mapping[str, Any], owner: str) -> Mapping[str, Any]:
    """Returns the attributes of a new entity after a check, without those that are None.

    Args:
        attributes: the attributes by name.
        owner: the template of the entity, for the error.

    Raises:
        SceneError: there are too many attributes, or a name or a value is wrong.
    """
    known: Mapping[str, Any] = {}
    for name, value in attributes.items():
        known = values.with_value(known, name, values.checked(name, value), owner)
    return known
