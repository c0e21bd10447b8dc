"""All worlds of one server, and the way of each connection into one of them.

Theory of operation. A world begins with a game that the host makes, and ticks while somebody is in it. `tick`, which
the host calls about ten times per second, gives seats to those who wait, lets empty worlds rest, and ends those that
were empty for too long. A client is never moved from world to world over one connection: it gets a path with a reserved
seat, and connects anew. So a world never sees a client of another one, and a world may as well be in another process.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from server.bucket import Bucket
from server.config.limits import Limits
from server.game import Game
from server.game.loading import Runner, at_once
from server.game.session import Session
from server.observability.errors import FaultReporter
from server.worlds.api import RulesWorlds
from server.worlds.directory import Directory
from server.worlds.host import Host, Way
from server.worlds.hosted import Entrance, HostedWorld
from server.worlds.kinds import Kind, WorldsError
from server.worlds.lobby import VERBS, Lobby, LobbySession, Request
from server.worlds.matchmaking import Matchmaking
from server.worlds.seats import Seat
from shared.fields import PATH_MAX
from shared.messages import Go

NO_DEFAULT = "there is no default world; ask for a match"
"""Reason for a path that leads to the default world where there is none."""
ADDRESSES_MAX = 4096
"""Maximum number of addresses whose requests are counted. Of more, the one that asked longest ago is forgotten."""
BURST_S = 10.0
"""Seconds whose allowed requests of an address may come at once."""


class Worlds(Directory):
    """All worlds of one server.

    Args:
        kinds: the kinds of worlds.
        limits: the limits.
        host: makes the games and runs the ticks.
        default: the default world, at the path `/`; None: there is none.
        authenticate: returns the subject of a client's token, as for `Game`.
        key: key of the seats, at least 32 bytes; None: a new one.
        faults: where exceptions in our own code are reported.
        run: runs `Rules.load_player` for those who wait for a match.
    """

    matchmaking_of: type[Matchmaking] = Matchmaking
    alone = True
    """Whether no other process can take the clients of this one."""

    def __init__(
        self,
        kinds: Mapping[str, Kind],
        limits: Limits,
        host: Host,
        *,
        default: Game | None = None,
        authenticate: Callable[[str], str] | None = None,
        key: bytes | None = None,
        faults: FaultReporter | None = None,
        run: Runner = at_once,
    ) -> None:
        super().__init__(kinds, limits, host, key=key, faults=faults)
        self.default = default
        self.matchmaking = self.matchmaking_of(self)
        self.lobby = self.matchmaking.lobby = Lobby(self.matchmaking, limits, authenticate, self.faults, run)
        self._asked: dict[str, Bucket] = {}
        if default is not None:
            default.api.hosting = RulesWorlds(self, None)

    def may_ask(self, target: str, address: str) -> bool:
        """Returns whether an address may send a request now; those for a world, by the lobby, have a limit.

        Args:
            target: path and query of the request.
            address: the client's address, or its network.
        """
        if name_in(target) not in VERBS or self._limit(address).take(self.now):
            return True
        self.counts["refused_often"] += 1
        return False

    def route(self, target: str) -> Way | str:
        """Returns what the path and query of a WebSocket request lead to, or the reason why they lead nowhere."""
        name, query = name_in(target[:PATH_MAX]), target[:PATH_MAX].partition("?")[2]
        seated = query.startswith("seat=")
        if not name and not seated:
            return self.default or NO_DEFAULT
        try:
            if name in VERBS:
                return self.lobby_way(Request(name, query))
            world = self.get(name) if name else None
            game = self.default if world is None else world.game
            if game is None:
                return NO_DEFAULT
            seat = self.seats.take(name, query.removeprefix("seat="), self.now) if seated else None
            if isinstance(seat, str):
                self.counts["seats_refused"] += 1
                return seat
            return Entrance(game, partial(self._opened, world, seat))
        except WorldsError as error:
            return str(error)

    def lobby_way(self, request: Request) -> Way:
        """Returns the way into the lobby for a request."""
        return _LobbyWay(self.lobby, request)

    def seat(self, name: str, subject: str, data: Any, reason: str) -> Go:
        """Reserves a seat in a world, or in the default one. Returns the message that sends a client there.

        Raises:
            WorldsError: there is no such world, or it has no free seat.
        """
        if name:
            return super().seat(name, subject, data, reason)
        if self.default is None:
            raise WorldsError(NO_DEFAULT)
        return Go(f"/?seat={self.seats.reserve('', subject, data, self.now)}", "", [], reason)

    def tick(self, now: float) -> None:
        """Does what is due: call it about ten times per second.

        Args:
            now: the current time in seconds.
        """
        self.look_after(now)
        self.matchmaking.tick(now)

    def shut_down(self, reason: str, wait: float) -> None:
        """Closes all connections but those of the default world, because the server goes down.

        Args:
            reason: the reason, sent to the clients.
            wait: seconds after which the clients should reconnect.
        """
        self.draining = True
        self.lobby.shut_down(reason, wait)
        for world in tuple(self.worlds.values()):
            self.rest(world)
            world.game.shut_down(reason, wait)

    def stats(self) -> dict[str, Any]:
        """Returns figures for `/stats`."""
        return {
            "worlds": len(self.worlds),
            "worlds_ticking": sum(world.ticking for world in self.worlds.values()),
            "worlds_asleep": len(self.asleep),
            "seats_reserved": len(self.seats),
            "waiting": self.matchmaking.waiting,
            "lobby_connections": len(self.lobby.sessions),
            "worlds_counts": dict(self.counts),
        }

    def _opened(self, world: HostedWorld | None, seat: Seat | None, session: Session) -> None:
        """Takes a new connection to a world."""
        session.reserved = seat
        if seat is not None:
            seat.session = session
        if world is not None:
            self.wake(world)

    def _limit(self, address: str) -> Bucket:
        """Returns the limit of an address, and makes it the one that asked last."""
        rate = self.limits.asks_per_s
        limit = self._asked.pop(address, None) or Bucket(rate, max(1.0, rate * BURST_S))
        if len(self._asked) >= ADDRESSES_MAX:
            del self._asked[next(iter(self._asked))]
        self._asked[address] = limit
        return limit


def name_in(target: str) -> str:
    """Returns the name of a world, or a path of the lobby, in path and query of a request."""
    return target.partition("?")[0].strip("/")


class _LobbyWay:
    """The way into the lobby for one connection.

    Args:
        lobby: the lobby.
        request: what the client asks for.
    """

    def __init__(self, lobby: Lobby, request: Request) -> None:
        self._lobby, self._request = lobby, request
        self.receive, self.lost = lobby.receive, lobby.lost

    def open(self, link: Any, now: float) -> LobbySession:
        return self._lobby.open(link, self._request, now)
