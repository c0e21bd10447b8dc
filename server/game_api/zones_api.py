"""The part of the game API that has the zones of a game."""

from server.game_api.turn import Turn
from server.game_api.zones import Zones
from shared.checks import Vec, text


class ZonesApi:
    """The zones of a game, for its rules."""

    turn: Turn
    _zones: Zones

    def add_zone(self, name: str, low: Vec, high: Vec) -> None:
        """Adds a box that reports by `on_enter` and `on_exit` which entities enter and leave it, or moves that box.

        It stops nothing, and clients do not get it. It survives a restart. Entities that are inside already enter it
        in the next tick.

        Args:
            name: name of the zone, 1 to 64 characters.
            low, high: two opposite corners (x, y, z) in blocks, the lower one first.

        Raises:
            SceneError: the game has 256 zones, or a value is wrong.
        """
        self.turn.check("add_zone")
        self._zones.add(text(name, "name"), low, high)

    def remove_zone(self, name: str) -> None:
        """Removes a zone. `on_exit` is not called for the entities inside.

        Raises:
            SceneError: there is no such zone.
        """
        self.turn.check("remove_zone")
        self._zones.remove(text(name, "name"))

    def inside(self, zone: str) -> list[int]:
        """Returns the entities whose boxes overlap a zone now, in ascending order.

        Raises:
            SceneError: there is no such zone.
        """
        return self._zones.inside(text(zone, "zone"))
