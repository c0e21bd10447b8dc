"""The shared values of a game, such as the time left: all clients get them, also clients that join later."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from server.game_api import values
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import SHARED
from server.replication.client_stream import ClientStream
from shared.messages import Shared, encode


class SharedValues:
    """The shared values of one game.

    Args:
        world: notes each change, for a recording and for the saved world.
        table: the values by name, as part of the persisted state.
    """

    def __init__(self, world: RecordedWorld, table: dict[str, Any]) -> None:
        self._world, self._table = world, table
        self.version = int(bool(table))
        """Version of the values; it grows with each change."""
        self._message = encode(Shared(table))

    def copy(self) -> Mapping[str, Any]:
        """Returns a copy of the values by name."""
        return MappingProxyType({name: values.copied(value) for name, value in self._table.items()})

    def set(self, name: str, value: Any) -> None:
        """Sets a value. None removes it.

        Raises:
            SceneError: the game would have too many values, or the name or the value is wrong.
        """
        payload = values.checked(name, value)
        if payload == values.packed(self._table.get(name)):
            return
        after = values.with_value(self._table, name, payload, "the game")
        self._table.clear()
        self._table.update(after)
        self._world.note([SHARED, after])
        self.renew()

    def renew(self) -> None:
        """Takes note of a change of the table: all clients are sent the values again."""
        self.version += 1
        self._message = encode(Shared(self._table))

    def show(self, stream: ClientStream) -> None:
        """Queues the values for a client if they have changed since it got them."""
        if stream.shared != self.version:
            stream.shared = self.version
            stream.shared_due = self._message
