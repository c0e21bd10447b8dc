"""A ticket: one client, perhaps with friends, that waits for a world. `Rules.pair` sees the tickets of its kind."""

from collections.abc import Mapping
from typing import Any

Property = str | int | bool
"""Value of a property of a world."""


class Ticket:
    """The request of one client for a world.

    Args:
        name: name that the client gave.
        subject: subject of its token; empty if the server does not ask for tokens.
        properties: properties that the world is to have; they come from the client.
        seats: number of seats, for the client and its friends.
        since: time in seconds at which the client began to wait.
        loaded: result of `Rules.load_player` of the kind.
    """

    def __init__(
        self,
        name: str,
        subject: str,
        properties: Mapping[str, Property],
        seats: int,
        since: float,
        loaded: Any = None,
    ) -> None:
        self.name, self.subject, self.properties, self.seats = name, subject, dict(properties), seats
        self.since, self.loaded = since, loaded
        self.waited_s = 0.0
        """Seconds that the client has waited so far."""

    def __repr__(self) -> str:
        return f"<Ticket of {self.name!r}, {self.seats} seats, {self.waited_s:.1f} s>"
