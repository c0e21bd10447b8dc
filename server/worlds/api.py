"""The worlds of a server, for the rules of one of them: `self.game.worlds` and `self.game.send_away`."""

from typing import TYPE_CHECKING, Any

from server.worlds.hosted import HostedWorld
from server.worlds.kinds import WorldsError, checked_properties
from shared.messages import Go

if TYPE_CHECKING:
    from server.worlds.directory import Directory


class RulesWorlds:
    """The worlds of the server, as the rules of a world see them.

    Args:
        worlds: the directory.
        world: the world of the rules; None: the default world.
    """

    def __init__(self, worlds: "Directory", world: HostedWorld | None) -> None:
        self._worlds, self._world = worlds, world

    @property
    def name(self) -> str:
        """The name of this world; empty: it is the default world."""
        return "" if self._world is None else self._world.name

    @property
    def kind(self) -> str:
        """The name of this world's kind; empty: it is the default world."""
        return "" if self._world is None else self._world.kind.name

    @property
    def code(self) -> str:
        """The code of this world if it is private; otherwise empty."""
        return "" if self._world is None else self._world.code

    @property
    def properties(self) -> dict[str, Any]:
        """The properties of this world, as a copy."""
        return {} if self._world is None else dict(self._world.properties)

    def create(self, kind: str, *, private: bool = False, **properties: Any) -> str:
        """Makes a world and returns its name.

        Raises:
            WorldsError: there is no such kind, a property cannot be used, or the server has too many worlds.
        """
        return self._worlds.create(kind, properties, private=private).name

    def entries(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Returns the entries of all worlds, or of those of a kind: name, kind, players, properties and so on."""
        return [each for each in self._worlds.entries(named=True) if kind in (None, each["kind"])]

    def lock(self) -> None:
        """Lets nobody in any more but players with a seat and players who reconnect."""
        self._own("lock").locked = True

    def unlock(self) -> None:
        """Lets players in again."""
        self._own("unlock").locked = False

    def describe(self, **properties: Any) -> None:
        """Sets properties of this world, which the list of worlds shows; None removes one.

        Raises:
            WorldsError: a property cannot be used.
        """
        world = self._own("describe")
        merged = {**world.properties, **properties}
        world.properties = checked_properties({name: value for name, value in merged.items() if value is not None})

    def end(self, reason: str = "the game is over") -> None:
        """Ends this world after the present tick. Its players get the reason with `Left`."""
        self._own("end").ending = reason

    def seat(self, world: str, subject: str, data: Any, reason: str) -> Go:
        """Reserves a seat in another world. Returns the message that sends a client there.

        Raises:
            WorldsError: there is no such world, or it has no free seat.
        """
        return self._worlds.seat(world, subject, data, reason)

    def _own(self, what: str) -> HostedWorld:
        if self._world is None:
            raise WorldsError(f"{what}: the default world cannot do that")
        return self._world
