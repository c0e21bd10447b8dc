"""One of the worlds of a server: its game, its place in the directory, and the door that lets players in."""

from collections.abc import Callable
from typing import Any

from server.game import Game
from server.game.session import Session
from server.players.ticket import Property
from server.replication.client_stream import Transport
from server.worlds.kinds import Kind
from server.worlds.seats import Seats
from shared import messages

FULL = "this world is full"
LOCKED = "this world is locked"
PRIVATE = "this world is private; join it by its code"


class HostedWorld:
    """One world of a server.

    Args:
        name: name of the world, the path at which clients join it.
        kind: its kind.
        properties: its properties, which the list of worlds shows.
        code: the code by which clients join a private world; empty: the world is public.
        seats: the reserved seats of the server.
        now: time in seconds.
    """

    url = ""
    """Address of the world's server; empty: this one."""
    game: Game
    """The game. It is made by `server.worlds.worlds.Host.begin`."""

    def __init__(
        self, name: str, kind: Kind, properties: dict[str, Property], code: str, seats: Seats, now: float
    ) -> None:
        self.name, self.kind, self.properties, self.code = name, kind, properties, code
        self.locked = False
        """Whether only players with a seat may join. The rules lock a match when it begins."""
        self.stays = False
        """Whether the world never ends because it is empty."""
        self.made_at = self.used_at = now
        """Times in seconds at which the world was made, and at which it was last seen with players or seats."""
        self.ticking = False
        """Whether its ticks run."""
        self.ending: str | None = None
        """Reason for which the world ends; None: it goes on."""
        self._seats = seats

    def begin(self, game: Game) -> None:
        """Takes the world's game."""
        self.game = game
        game.joining.door = self

    @property
    def players(self) -> int:
        """Number of players, including those who have lost their connection and may reconnect."""
        return len(self.game.players)

    @property
    def free(self) -> int:
        """Number of seats that are neither taken nor reserved."""
        return self.kind.players_max - self.players - self._seats.reserved(self.name)

    @property
    def empty(self) -> bool:
        """Whether nobody plays in the world, or is about to."""
        return not (self.game.players or self.game.sessions or self._seats.reserved(self.name))

    def refusal(self, session: Session) -> tuple[int, str] | None:
        """Returns the close code and the reason for which a new player may not join; None: the player may join."""
        seat = session.reserved
        if self.ending is not None:
            return messages.ENDED, self.ending
        if seat is not None:
            if seat.subject and seat.subject != session.subject:
                return messages.NOT_ADMITTED, "the seat is another player's"
            return (messages.FULL, FULL) if seat not in self._seats and self.free < 1 else None
        if self.code:
            return messages.NOT_ADMITTED, PRIVATE
        if self.locked:
            return messages.NOT_ADMITTED, LOCKED
        return (messages.FULL, FULL) if self.free < 1 else None

    def entry(self, now: float, named: bool) -> dict[str, Any]:
        """Returns the world's entry in the list of worlds.

        Args:
            now: time in seconds.
            named: whether the entry has the code of a private world and the names of the players, for operators.
        """
        entry = {
            "name": self.name,
            "kind": self.kind.name,
            "players": self.players,
            "players_max": self.kind.players_max,
            "locked": self.locked,
            "full": self.free < 1,
            "properties": self.properties,
            "age_s": round(now - self.made_at, 1),
        }
        if named:
            who = {player.entity: player.name for player in self.game.players.values()}
            entry |= {"code": self.code, "who": who, "ticking": self.ticking}
        return entry


class Entrance:
    """The way into a game for one connection.

    Args:
        game: the game.
        opened: called with the new session.
    """

    def __init__(self, game: Game, opened: Callable[[Session], None]) -> None:
        self._game, self._opened = game, opened
        self.receive, self.lost = game.receive, game.lost

    def open(self, link: Transport, now: float) -> Session:
        """Adds the connection to the game and returns its session."""
        session = self._game.open(link, now)
        self._opened(session)
        return session
