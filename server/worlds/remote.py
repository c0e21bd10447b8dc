"""A world of another process, as matchmaking sees it."""

from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from server.players.ticket import Property
    from server.worlds.fleet_entries import Figures
    from server.worlds.kinds import Kind


class RemoteWorld(NamedTuple):
    """A world of another process. Fields as those of `HostedWorld`; `url` is the address of its process."""

    name: str
    kind: "Kind"
    properties: "dict[str, Property]"
    code: str
    url: str
    free: int
    locked: bool = False
    ending: str | None = None

    def entry(self, figures: "Figures | None", named: bool) -> dict[str, Any]:
        """Returns the world's entry in the list of worlds. Arguments as for `HostedWorld.entry`."""
        entry = {
            "name": self.name,
            "kind": self.kind.name,
            "players": 0 if figures is None else figures.players,
            "players_max": self.kind.players_max,
            "locked": self.locked,
            "full": self.free < 1,
            "properties": self.properties,
            "age_s": 0.0 if figures is None else figures.age_s,
        }
        return entry | ({"code": self.code, "who": {}, "url": self.url} if named else {})
