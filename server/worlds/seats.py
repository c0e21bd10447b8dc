"""Seats: places in worlds that are reserved for some seconds, each held by a signed token.

A token names its world and the seat. It lets one client in: if its connection is lost before the client has
acknowledged anything, because the welcome never came, for example, the token counts again for the rest of its time, and
the client goes on as the same player. What the rules hand over with a player stays on the server.

The processes of a fleet have one key. A seat that another process has reserved is known by its token only: it has the
time at which it expires, its subject, and what the rules hand over, encrypted.
"""

import base64
import hashlib
import json
import secrets
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING, Any

import jwt
import msgpack

if TYPE_CHECKING:
    from server.game.session import Session
    from server.players.player import Player

ALGORITHM = "HS256"
SHORT = 8
"""Length of the beginning of a seat's number, by which processes tell seats apart."""
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
        self.foreign = False
        """Whether another process has reserved it."""
        self.settled = False
        """Whether its client has acknowledged a snapshot, so that the token is of no more use."""


class Seats:
    """The reserved seats of one process.

    Args:
        key: the key to sign tokens with, at least 32 bytes.
        seat_s: seconds for which a seat is reserved.
        wall: returns the time of day in seconds, which the processes of a fleet share; None: there is no fleet.
    """

    def __init__(self, key: bytes, seat_s: float, wall: Callable[[], float] | None = None) -> None:
        self.seat_s = seat_s
        self.wall = wall
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

    def use(self, key: bytes) -> None:
        """Signs with another key from now on."""
        self._key = key

    def reserve_elsewhere(self, world: str, subject: str, data: Any) -> tuple[str, str]:
        """Reserves a seat in a world of another process. Returns its number and its token.

        Raises:
            ValueError, TypeError: the data cannot be packed.
        """
        assert self.wall is not None
        number = secrets.token_urlsafe(12)
        table = {"world": world, "seat": number, "subject": subject, "until": round(self.wall() + self.seat_s, 3)}
        if data is not None:
            sealed = _sealed(msgpack.packb(data), self._key, number)
            table["data"] = base64.urlsafe_b64encode(sealed).decode()
        payload = json.dumps(table, separators=(",", ":")).encode()
        return number[:SHORT], self._signatures.encode(payload, self._key, ALGORITHM)

    def foreign(self, world: str) -> tuple[str, ...]:
        """Returns the beginnings of the numbers of a world's seats that other processes reserved and clients use."""
        return tuple(number[:SHORT] for number, seat in self._of_world.get(world, {}).items() if seat.foreign)

    def genuine(self, world: str, token: str) -> bool:
        """Returns whether a token is of a seat in a world, reserved by any process."""
        try:
            payload = json.loads(self._signatures.decode(token, self._key, algorithms=[ALGORITHM]))
            return bool(payload["world"] == world)
        except (jwt.PyJWTError, ValueError, TypeError, KeyError, RecursionError):
            return False

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
        seat = self._seats.get(number) or self._from_elsewhere(payload, now)
        if seat is None or seat.settled:
            return EXPIRED
        if seat.session is not None and not seat.session.closed:
            return EXPIRED if seat.session.acknowledged else IN_USE
        return seat

    def _from_elsewhere(self, payload: dict[str, Any], now: float) -> Seat | None:
        """Returns the seat of a token that another process has signed; None: it has expired, or is of this process."""
        left = payload["until"] - self.wall() if self.wall is not None and "until" in payload else 0.0
        if left <= 0:
            return None
        number, world, data = payload["seat"], payload["world"], None
        if "data" in payload:
            sealed = base64.urlsafe_b64decode(payload["data"])
            data = msgpack.unpackb(_sealed(sealed, self._key, number), strict_map_key=False)
        seat = Seat(number, world, payload["subject"], data, now + min(left, self.seat_s))
        seat.foreign = True
        self._seats[number] = self._of_world.setdefault(world, {})[number] = seat
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


def _sealed(data: bytes, key: bytes, number: str) -> bytes:
    """Encrypts or decrypts data by a stream from the key and the number of its seat, which is used once."""
    stream = bytearray()
    for block in count():
        if len(stream) >= len(data):
            break
        stream += hashlib.blake2b(f"{number} {block}".encode(), key=key[:64], person=b"seat").digest()
    return bytes(a ^ b for a, b in zip(data, stream, strict=False))
