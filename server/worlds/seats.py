"""Seats: places in worlds that are reserved for some seconds, each held by a signed token.

A token names its world and the seat, and can be used once. What the rules hand over with a player stays on the server.
"""

import json
import secrets
from typing import Any, NamedTuple

import jwt

ALGORITHM = "HS256"
EXPIRED = "the seat has expired; ask for a match again"
"""Reason for a token that was valid and is not any more."""


class Seat(NamedTuple):
    """A reserved seat.

    `subject` is the subject of the only client that may use it; empty: any client. `data` is what the rules hand over.
    `until` is the time in seconds at which it expires.
    """

    world: str
    subject: str
    data: Any
    until: float


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
        self._seats: dict[str, Seat] = {}  # by the number in the token, those that expire first in front
        self._reserved: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._seats)

    def reserved(self, world: str) -> int:
        """Returns the number of seats of a world that are reserved and not used yet."""
        return self._reserved.get(world, 0)

    def reserve(self, world: str, subject: str, data: Any, now: float) -> str:
        """Reserves a seat. Returns its token."""
        number = secrets.token_urlsafe(12)
        self._seats[number] = Seat(world, subject, data, now + self.seat_s)
        self._reserved[world] = self._reserved.get(world, 0) + 1
        payload = json.dumps({"world": world, "seat": number}, separators=(",", ":")).encode()
        return self._signatures.encode(payload, self._key, ALGORITHM)

    def take(self, world: str, token: str, now: float) -> Seat | str:
        """Uses a seat. Returns it, or the reason why the token is not valid."""
        try:
            payload = json.loads(self._signatures.decode(token, self._key, algorithms=[ALGORITHM]))
            named, number = payload["world"], payload["seat"]
        except (jwt.PyJWTError, ValueError, TypeError, KeyError, RecursionError):
            return "this is no seat of this server"
        if named != world:
            return "the seat is in another world"
        self.expire(now)
        return self._drop(number) or EXPIRED

    def expire(self, now: float) -> None:
        """Gives back the seats whose time is over."""
        while self._seats:
            number, seat = next(iter(self._seats.items()))
            if seat.until > now:
                return
            self._drop(number)

    def ended(self, world: str) -> None:
        """Gives back all seats of a world that has ended."""
        if world in self._reserved:
            for number in [number for number, seat in self._seats.items() if seat.world == world]:
                self._drop(number)

    def _drop(self, number: str) -> Seat | None:
        seat = self._seats.pop(number, None)
        if seat is not None:
            self._reserved[seat.world] -= 1
            if not self._reserved[seat.world]:
                del self._reserved[seat.world]
        return seat
