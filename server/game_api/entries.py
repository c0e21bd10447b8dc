"""Tables of a game that are part of the persisted state."""

from typing import Any

from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import ENTRY, PersistedState


class Entries:
    """A table of the persisted state, whose changes are noted. An unused one costs nothing.

    Args:
        world: notes each change, for a recording and for the saved world.
        kept: the persisted state.
        name: name of the table in it.
    """

    def __init__(self, world: RecordedWorld, kept: PersistedState, name: str) -> None:
        self._world, self._name = world, name
        self.table: dict[Any, Any] = kept.tables.setdefault(name, {})
        """Values by key. Do not change it."""

    def put(self, key: str | int, value: Any) -> None:
        """Sets an entry to a MessagePack value other than None."""
        self.table[key] = value
        self._world.note([ENTRY, self._name, key, value])

    def forget(self, key: str | int) -> None:
        """Removes an entry whose removal another note implies."""
        self.table.pop(key, None)

    def drop(self, key: str | int) -> None:
        """Removes an entry, if it exists."""
        if self.table.pop(key, None) is not None:
            self._world.note([ENTRY, self._name, key, None])
