"""Seats: places in worlds that are reserved for some seconds, each held by a signed token.

A token names its world and the seat. It lets one client in: if its connection is lost before the client has
acknowledged anything, because the welcome never came, for example, the token counts again for the rest of its time, and
the client goes on as the same player. What the rules hand over with a player stays on the server.
"""

import json
import secrets
from typing import TYPE_CHECKING, Any

import jwt

if TYPE_CHECKING:
    from server.game.session import Session
    from server.players.player import Player

ALGORITHM = "HS256"
EXPIRED = "the seat has expired; ask for a match again"
"""Reason for a token that was valid and is not any more."""
IN_USE = "the seat is in use"
"""Reason for a token whose client has a connection already."""


class Seat:
    """A reserved seat.

    Args:
        number: its number.
        world: name of its world.
        subject: subject of the only client that may use it; empty: any client.
        data: data that the rules hand over with the player.
        until: time in seconds at which it expires.
    """

    def __init__(self, number: str, world: str, subject: str, data: Any, until: float) -> None:
        self.number, self.world, self.subject, self.data, self.until = number, world, subject, data, until
        self.session: Session | None = None
        """Newest connection of the client that uses it."""
        self.player: Player | None = None
        """Player who has joined on it."""
        self.settled = False
        """Whether its client has acknowledged a snapshot, so that the token is of no more use."""


class Seats:
    """The reserved seats of one process.

    Args:
        key: the key to sign tokens with, at least 32 bytes.
        seat_s: seconds for which a seat is reserved.
    """

    def __init__(self, key: bytes, seat_s: float) -> None:
        self.seat_s = seat_s
        self._key = key
        self._signatures = jwt.PyJWS(algorithms=[ALGORITHM])
        self._seats: dict[str, Seat] = {}  # those that expire first in front
        self._of_world: dict[str, dict[str, Seat]] = {}

    def __len__(self) -> int:
        return len(self._seats)

    def __contains__(self, seat: Seat) -> bool:
        return seat.number in self._seats

    def reserved(self, world: str) -> int:
        """Returns the number of seats of a world that are reserved for clients that have not joined yet."""
        return sum(seat.player is None for seat in self._of_world.get(world, {}).values())

    def reserve(self, world: str, subject: str, data: Any, now: float) -> str:
        """Reserves a seat. Returns its token."""
        number = secrets.token_urlsafe(12)
        seat = Seat(number, world, subject, data, now + self.seat_s)
        self._seats[number] = self._of_world.setdefault(world, {})[number] = seat
        payload = json.dumps({"world": world, "seat": number}, separators=(",", ":")).encode()
        return self._signatures.encode(payload, self._key, ALGORITHM)

    def take(self, world: str, token: str, now: float) -> Seat | str:
        """Returns the seat of a token for a new connection, or the reason why the token is not valid."""
        try:
            payload = json.loads(self._signatures.decode(token, self._key, algorithms=[ALGORITHM]))
            named, number = payload["world"], payload["seat"]
        except (jwt.PyJWTError, ValueError, TypeError, KeyError, RecursionError):
            return "this is no seat of this server"
        if named != world:
            return "the seat is in another world"
        self.expire(now)
        seat = self._seats.get(number)
        if seat is None or seat.settled:
            return EXPIRED
        if seat.session is not None and not seat.session.closed:
            return EXPIRED if seat.session.acknowledged else IN_USE
        return seat

    def expire(self, now: float) -> None:
        """Gives back the seats whose time is over."""
        while self._seats:
            number, seat = next(iter(self._seats.items()))
            if seat.until > now:
                return
            del self._seats[number]
            of_world = self._of_world[seat.world]
            del of_world[number]
            if not of_world:
                del self._of_world[seat.world]

    def ended(self, world: str) -> None:
        """Gives back all seats of a world that has ended."""
        for number in self._of_world.pop(world, {}):
            del self._seats[number]
