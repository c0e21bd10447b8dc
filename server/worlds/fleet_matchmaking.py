"""Matchmaking in a fleet: worlds of all processes, and clients that ask for a world by its name."""

from typing import TYPE_CHECKING, cast

from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, WorldsError
from server.worlds.lobby import LobbySession, Request
from server.worlds.matchmaking import Matchmaking
from shared import fields, messages
from shared.messages import Edges, Go, encode

if TYPE_CHECKING:
    from server.worlds.fleet_worlds import FleetWorlds
    from server.worlds.remote import RemoteWorld

FIND_S, SEAT_S = 20.0, 5.0
"""Seconds that a client waits for a world whose process is gone, and for one that is just being made."""
ASK_S = 1.0
"""Seconds between two questions for a world that is not known."""
AGAIN_S = 1.0
"""Seconds after which a client may ask again for a world that did not come."""


class Wanted(Request):
    """The request of a client for a world by its name.

    Args:
        name: name of the world.
        query: the query of its path.
        code: its code, if the client has named that.
    """

    def __init__(self, name: str, query: str, code: str = "") -> None:
        super().__init__("find", "")
        self.name, self.query, self.code = name, query, code

    @property
    def target(self) -> str:
        """Path and query of the request."""
        return f"/{self.name}" + (f"?{self.query}" if self.query else "")


class FleetMatchmaking(Matchmaking):
    """The matchmaking of one process of a fleet."""

    def __init__(self, directory: "FleetWorlds") -> None:
        super().__init__(directory)
        self._fleet_worlds = directory
        self._finding: dict[LobbySession, tuple[float, float]] = {}

    def ask(self, session: LobbySession, now: float) -> None:
        """Answers a client, lets it wait, or sends it to the process that matches those of its kind."""
        request = self._by_name(session)
        if isinstance(request, Wanted):
            self._finding[session] = now, -ASK_S
            self._find(session, request, now)
            return
        if request.here or request.verb == "join":
            super().ask(session, now)
            return
        fleet = self._fleet_worlds.fleet
        try:
            there = fleet.matchmaker(self._fitting(request).name)
        except WorldsError as error:
            self.lobby.refuse(session, messages.NOT_ADMITTED, str(error))
            return
        if there in ("", fleet.me):
            super().ask(session, now)
            return
        query = f"{request.query}&here=1" if request.query else "here=1"
        self._go(session, Go(f"{fleet.address(there)}/{request.verb}?{query}", "", [], "matched at another server"))

    def _by_name(self, session: LobbySession) -> Request:
        """Returns the request of a client. One by the code of a world that has to come up first is one by its name."""
        worlds, request = self._fleet_worlds, session.request
        name = worlds.fleet.coded(request.code) if request.verb == "join" and request.seats == 1 else ""
        if name and name not in worlds.worlds and worlds.elsewhere(name) is None:
            assert session.ticket is not None
            _, token = worlds.seats.reserve_elsewhere(name, session.ticket.subject, None)
            session.request = Wanted(name, f"seat={token}", request.code)
        return session.request

    def gone(self, session: LobbySession) -> None:
        """Takes a client that waits no longer out of its queue."""
        super().gone(session)
        self._finding.pop(session, None)

    def tick(self, now: float) -> None:
        """Gives worlds to those who wait, as far as there are any."""
        super().tick(now)
        for session in tuple(self._finding):
            self._find(session, cast("Wanted", session.request), now)

    def _find(self, session: LobbySession, request: Wanted, now: float) -> None:
        """Sends a client to the world that it wants, refuses it, or lets it wait."""
        worlds, fleet, name = self._fleet_worlds, self._fleet_worlds.fleet, request.name
        since, asked = self._finding[session]
        if name in worlds.worlds:
            self._go(session, Go(request.target, request.code, [], "found"))
            return
        owner = fleet.owner(name)
        if owner and owner != fleet.me and fleet.fresh(owner):
            self._go(session, Go(fleet.address(owner) + request.target, request.code, [], "found"))
            return
        if now - asked >= ASK_S:
            self._finding[session] = since, now
            fleet.want(name)
        if not fleet.taken(name) and not fleet.asking(name) and fleet.holds(fleet.now):
            coming = request.query.startswith("seat=") and worlds.seats.genuine(name, request.query[5:])
            if now - since >= (SEAT_S if coming else 0.0) and now > since:
                self._refuse(session, messages.NOT_ADMITTED, f"there is no world {name[:40]!r}")
                return
        if now - since >= FIND_S:
            self._refuse(session, messages.GOING_AWAY, f"the world {name[:40]!r} does not come back", AGAIN_S)

    def _refuse(self, session: LobbySession, code: int, reason: str, wait: float = -1.0) -> None:
        self._finding.pop(session, None)
        self._fleet_worlds.counts["refused"] += 1
        self.lobby.refuse(session, code, reason, wait)

    def _go(self, session: LobbySession, go: Go) -> None:
        """Sends a client on, with the addresses of the fleet's processes."""
        self._finding.pop(session, None)
        fleet = self._fleet_worlds.fleet
        urls = [fleet.url, *(entry.url for _, entry in fleet.others() if not entry.draining)]
        session.link.send(encode(Edges(urls[: fields.EDGES_MAX])))
        self.lobby.send_on(session, go)

    def _rooms(self, kind: Kind) -> "list[HostedWorld | RemoteWorld]":
        return self._fleet_worlds.rooms(kind)

    def _room_for(self, kind: Kind) -> bool:
        return bool(self._fleet_worlds.fleet.place(kind.name))
