"""The side of a core that a transport talks to, for each of its connections."""

from typing import Protocol

READ_BYTES = 64 * 1024
"""Number of bytes that a transport reads at once from a connection without a simulated link."""


class Port(Protocol):
    """The side of a core that a transport talks to: the core itself, or a simulated link in front of it."""

    @property
    def appetite(self) -> int:
        """The number of bytes that the transport should read at once; 0: it should not read now."""
        ...

    def open(self, now: float) -> None:
        """Takes a new connection, and sends Hello."""

    def receive(self, data: bytes, now: float) -> None:
        """Takes one message of the server."""

    def lost(self, code: int, reason: str, now: float) -> None:
        """Takes the loss of the connection."""

    def update(self, now: float) -> None:
        """Does what is due."""

    def next_update(self, now: float) -> float:
        """Returns the local time at which `update` has something to do; `inf`: not before a message arrives."""
        ...

    def outgoing(self) -> list[bytes]:
        """Returns the messages to send, and forgets them."""
        ...

    def outstanding(self) -> int:
        """Returns the bytes on the way to this client that have not reached the core yet."""
        ...
