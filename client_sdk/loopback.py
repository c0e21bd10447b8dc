"""A server within the program, for single player and for tests of a game. No socket, no thread.

    client = Loopback(Game(scene, rules=rules)).join("Ann")

Theory of operation. Time is the `now` of the clients' calls. Each call runs the ticks of the game that are due, each at
its own deadline. So a program that passes its own `now` plays as fast as it can, and every run gives the same result.
All clients of one game have to use one clock. If no call came for `LEAP_S` seconds, the program stood still, and so did
the world: the missed ticks are dropped, and the players reconnect as after a lost connection.
"""

import math
from typing import TYPE_CHECKING, Any, Protocol

from client_sdk.base import set_link
from client_sdk.client import PATIENCE_S, Client
from client_sdk.core import Core
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


class Loopback:
    """A game with its clock and its clients.

    Args:
        game: the game to run, from the first poll of a client on; nothing else may call its `tick`.
    """

    def __init__(self, game: Host) -> None:
        if isinstance(game, type) or not callable(getattr(game, "tick", None)):
            raise SceneError(f"game = {shown(game)}: must be a `Game`")
        self.game = game
        self._seats: list[_Seat] = []
        self._began = -math.inf
        self._ticks = 0

    def join(self, name: str = "", *, token: str = "", link: "str | Link | None" = None) -> Client:
        """Adds a player and returns its client, which joins within about half a second of polls and updates.

        Args:
            name: the player's name, shown to others, up to 32 characters.
            token: proves the client's identity, if the game asks for it.
            link: a simulated link: the name of a preset, or a `Link`; None: none.

        Raises:
            ValueError: no preset has the name in `link`; or UTF-8 cannot hold the name or the token.
        """
        behaviours = [entry.code for entry in self.game.scene.behaviours if entry.code is not None]
        core = Core(name, token=token, patience_s=PATIENCE_S, behaviours=behaviours)
        set_link(core, link)
        seat = _Seat(self, core)
        self._seats.append(seat)
        return Client(core, seat)

    def advance(self, now: float) -> None:
        """Runs the ticks that are due."""
        tick_s = 1.0 / self.game.scene.tick_rate
        if now > self._began + self._ticks * tick_s + LEAP_S:
            for seat in self._seats:
                seat.leap(now)
            self._began, self._ticks = now, 0
        while (due := self._began + self._ticks * tick_s) <= now:
            self._ticks += 1
            self.game.tick(due, due)

    def _leave(self, seat: "_Seat") -> None:
        if seat in self._seats:
            self._seats.remove(seat)


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

    def __init__(self, loopback: Loopback, core: Core) -> None:
        self._loopback, self._game, self._core = loopback, loopback.game, core
        self._wire = _Wire(core)
        self._session: Any = None
        self._opened = False
        self._now = 0.0

    def poll(self, now: float) -> None:
        self._advance(now)
        core = self._core
        # A joining client opens one connection only: with a `link`, a refusal arrives later, and the state is still
        # "joining" until then.
        if self._session is None and (
            not self._opened
            if core.state == "joining"
            else core.state == "reconnecting" and now >= core.reconnect.retry_at
        ):
            self._opened = True
            core.reconnect.trying()
            self._wire = _Wire(core)
            self._session = self._game.open(self._wire, now)
            core.port.open(now)
        self._read(now)
        self.send(now)

    def send(self, now: float) -> None:
        self._advance(now)
        if self._session is None:
            return
        for message in self._core.port.outgoing():
            self._game.receive(self._session, message, now)
        if self._core.close_request or self._core.state == "closed":
            self._end(now)

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

    def _read(self, now: float) -> None:
        wire = self._wire
        messages, wire.inbox = wire.inbox, []
        for message in messages:
            self._core.port.receive(message, now)
        if wire.over is not None and self._session is not None:
            self._end(now)
            self._core.port.lost(*wire.over, now)

    def _end(self, now: float) -> None:
        self._game.lost(self._session, now)
        self._session = None
        self._wire.inbox.clear()
