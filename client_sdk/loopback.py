"""A server within the program, for single player and for tests of a game. No socket, no thread.

    client = Loopback(Game(scene, rules=rules)).join("Ann")
    client = Loopback(LocalWorlds(kind_of("arena", Arena, scene))).match("arena", name="Ann")

Theory of operation. Time is the `now` of the clients' calls. Each call runs the ticks of the game that are due, each at
its own deadline. So a program that passes its own `now` plays as fast as it can, and every run gives the same result.
All clients of one game have to use one clock. If no call came for `LEAP_S` seconds, the program stood still, and so did
the world: the missed ticks are dropped, and the players reconnect as after a lost connection.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from client_sdk import addresses
from client_sdk.base import set_link
from client_sdk.client import PATIENCE_S, Client
from client_sdk.core import Core
from shared.behaviours import Behaviour
from shared.checks import SceneError, shown
from shared.scene import Scene

if TYPE_CHECKING:
    from client_sdk.netsim.links import Link


LEAP_S = 2.0
"""Time without a call after which the program counts as having stood still, in seconds."""
GONE = 1006
"""Close code of a WebSocket that broke off (RFC 6455)."""


class Host(Protocol):
    """The interface of a game that a loopback runs; `server.game.Game` has it."""

    scene: Scene

    def open(self, link: Any, now: float) -> Any:
        """Takes a new connection. Returns its session."""

    def receive(self, session: Any, data: bytes, now: float) -> None:
        """Takes one message of a client."""

    def lost(self, session: Any, now: float) -> None:
        """Takes the loss of a connection."""

    def tick(self, deadline: float, now: float) -> None:
        """Runs one tick, which is due at `deadline`."""


class Hosts(Protocol):
    """The interface of several worlds that a loopback runs; `sovereign_netcode.playtest.LocalWorlds` has it."""

    @property
    def behaviours(self) -> Sequence[type[Behaviour]]:
        """The classes of the behaviours of all worlds."""
        ...

    @property
    def due(self) -> float:
        """Time of the next tick, in seconds."""
        ...

    def route(self, path: str, now: float) -> Any:
        """Returns what takes a connection to a path, or the reason why nothing does.

        Args:
            path: the path; behind the address of a server if the client was sent to another one.
            now: time in seconds.
        """

    def advance(self, now: float) -> None:
        """Runs the ticks that are due."""

    def restart(self, now: float) -> None:
        """Drops the ticks that are due, and begins again at `now`."""


class Loopback:
    """A game with its clock and its clients, or several worlds with theirs.

    Args:
        game: the game to run, from the first poll of a client on; nothing else may call its `tick`. Or the worlds to
            run.
    """

    def __init__(self, game: Host | Hosts) -> None:
        if not isinstance(game, type) and callable(getattr(game, "route", None)):
            self._hosts: Hosts = game  # type: ignore[assignment]
        elif isinstance(game, type) or not callable(getattr(game, "tick", None)):
            raise SceneError(f"game = {shown(game)}: must be a `Game` or `LocalWorlds`")
        else:
            self._hosts = _OneGame(game)  # type: ignore[arg-type]
        self.game = game
        self._seats: list[_Seat] = []
        self._began = False

    def join(
        self,
        name: str = "",
        *,
        token: str = "",
        link: "str | Link | None" = None,
        code: str = "",
        seat: str = "",
        world: str = "",
    ) -> Client:
        """Adds a player and returns its client, which joins within about half a second of polls and updates.

        Args:
            name: the player's name, shown to others, up to 32 characters.
            token: proves the client's identity, if the game asks for it.
            link: a simulated link: the name of a preset, or a `Link`; None: none.
            code, seat, world: the world to join, as for `Client.join`; without them, the default world.

        Raises:
            ValueError: no preset has the name in `link`; or UTF-8 cannot hold the name or the token.
        """
        path = "/" if (code, seat, world) == ("", "", "") else addresses.joining(code, seat, world)
        return self._add(path, name, token, link)

    def match(
        self,
        kind: str,
        *,
        seats: int = 1,
        name: str = "",
        token: str = "",
        link: "str | Link | None" = None,
        **properties: str | int,
    ) -> Client:
        """Adds a player that looks for a world of a kind, as `Client.match` does.

        Raises:
            ValueError: an argument is not valid.
        """
        return self._add(addresses.matching(kind, seats, properties), name, token, link)

    def create(
        self,
        kind: str,
        *,
        private: bool = False,
        name: str = "",
        token: str = "",
        link: "str | Link | None" = None,
        **properties: str | int,
    ) -> Client:
        """Adds a player that makes a world of a kind and joins it, as `Client.create` does.

        Raises:
            ValueError: an argument is not valid.
        """
        return self._add(addresses.creating(kind, private, properties), name, token, link)

    def advance(self, now: float) -> None:
        """Runs the ticks that are due."""
        if not self._began or now > self._hosts.due + LEAP_S:
            self._began = True
            for seat in self._seats:
                seat.leap(now)
            self._hosts.restart(now)
        self._hosts.advance(now)

    def _add(self, path: str, name: str, token: str, link: "str | Link | None") -> Client:
        core = Core(name, token=token, patience_s=PATIENCE_S, behaviours=self._hosts.behaviours)
        core.travel.path = path
        set_link(core, link)
        seat = _Seat(self, self._hosts, core)
        self._seats.append(seat)
        return Client(core, seat)

    def _leave(self, seat: "_Seat") -> None:
        if seat in self._seats:
            self._seats.remove(seat)


class _OneGame:
    """A game at every path."""

    def __init__(self, game: Host) -> None:
        self._game = game
        self._began, self._ticks, self._tick_s = 0.0, 0, 1.0 / game.scene.tick_rate

    @property
    def behaviours(self) -> list[type[Behaviour]]:
        return [entry.code for entry in self._game.scene.behaviours if entry.code is not None]

    @property
    def due(self) -> float:
        return self._began + self._ticks * self._tick_s

    def route(self, path: str, now: float) -> Host:
        return self._game

    def advance(self, now: float) -> None:
        while (due := self.due) <= now:
            self._ticks += 1
            self._game.tick(due, due)

    def restart(self, now: float) -> None:
        self._began, self._ticks = now, 0


class _Wire:
    """The connection to a client, as the game sees it."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self.inbox: list[bytes] = []
        self.over: tuple[int, str] | None = None

    def send(self, message: bytes) -> None:
        self.inbox.append(message)

    def outstanding(self) -> int:
        return sum(map(len, self.inbox)) + self._core.port.outstanding()

    def close(self, code: int, reason: str) -> None:
        self.over = code, reason


class _Seat:
    """The transport of one client."""

    def __init__(self, loopback: Loopback, hosts: Hosts, core: Core) -> None:
        self._loopback, self._hosts, self._core = loopback, hosts, core
        self._wire = _Wire(core)
        self._way: Any = None
        self._session: Any = None
        self._opened = False
        self._now = 0.0

    def poll(self, now: float) -> None:
        self._advance(now)
        core = self._core
        # The first connection is opened only once: with a `link`, a refusal arrives later, and the state is still
        # "joining" until then.
        if self._session is None and (core.dials(now) or not (self._opened or core.state == "closed")):
            self._open(now)
        self._read(now)
        self.send(now)

    def send(self, now: float) -> None:
        self._advance(now)
        if self._session is None:
            return
        for message in self._core.port.outgoing():
            self._way.receive(self._session, message, now)
        if self._core.close_request or self._core.state == "closed":
            self._end(now)
            if self._core.travel.leaving:
                self._core.port.lost(1000, "", now)

    def close(self, timeout: float) -> None:
        self.send(self._now)
        self._loopback._leave(self)

    def leap(self, now: float) -> None:
        """Ends the connection of a client that plays, because the program stood still; the client reconnects."""
        if self._session is not None and self._core.state == "playing":
            self._end(now)
            self._core.port.lost(GONE, "the program stood still", now)

    def _advance(self, now: float) -> None:
        self._now = now
        self._loopback.advance(now)

    def _open(self, now: float) -> None:
        self._opened = True
        core = self._core
        core.reconnect.trying()
        self._wire = _Wire(core)
        way = self._hosts.route(core.travel.server + core.travel.path, now)
        if isinstance(way, str):
            core.port.lost(GONE, way, now)
            return
        self._way, self._session = way, way.open(self._wire, now)
        core.port.open(now)

    def _read(self, now: float) -> None:
        wire = self._wire
        messages, wire.inbox = wire.inbox, []
        for message in messages:
            self._core.port.receive(message, now)
        if wire.over is not None and self._session is not None:
            self._end(now)
            self._core.port.lost(*wire.over, now)

    def _end(self, now: float) -> None:
        self._way.lost(self._session, now)
        self._session = None
        self._wire.inbox.clear()
