"""The sending side of one connection: what the client has been sent, what it has acknowledged, and what is due."""

from collections.abc import Callable
from typing import Protocol

from server.replication.client_view import ClientView
from server.replication.flow_control import FlowControl
from shared.checks import Cell


class Transport(Protocol):
    """The part of a transport that a session uses."""

    def send(self, message: bytes) -> None:
        """Queues one message; never blocks."""

    def outstanding(self) -> int | None:
        """Returns the bytes handed over that the peer's system has not yet acknowledged; None if unknown."""
        ...

    def close(self, code: int, reason: str) -> None:
        """Closes the connection once everything that was sent has gone out."""


class Framed(Protocol):
    """A transport that also takes and gives whole WebSocket frames. Only such a transport has an `inlet`."""

    inlet: Callable[[bytes, float], bool] | None
    """Is offered what arrives, before it is parsed, with the time in seconds. If it takes it, it returns True."""

    def outlet(self) -> Callable[[bytes], None]:
        """Returns a function that queues one message in its frame and never blocks, until the session has ended."""
        ...


class ClientStream:
    """The state of sending to one client.

    Args:
        link: the transport.
        now: time in seconds at which the connection was opened.
    """

    def __init__(self, link: Transport, now: float) -> None:
        self.link = link
        self.flow = FlowControl(link.outstanding)
        self.view = ClientView()
        self.sent_at = now
        """Time in seconds of the latest snapshot, or of the latest reason not to count the time since."""
        self.tick = -1
        """Tick of the latest snapshot that was sent; -1: none."""
        self.acked = -1
        """Tick of the latest snapshot that the client has acknowledged; -1: none."""
        self.snapshot_bytes = 0
        """Size of the latest snapshot."""
        self.gaps: tuple[tuple[int, int], ...] = ()
        """Pairs of ticks of consecutive snapshots between which other ticks were left out, for lag compensation."""
        self.probe: tuple[int, float, int] | None = None
        """Snapshot that measures the round trip, sent when nothing was on the way: its tick, time in seconds, bytes."""
        self.terrain_due: list[Cell] = []
        """Segments whose blocks are still to be sent, nearest first."""
        self.terrain_now: tuple[Cell, bytes, int] | None = None
        """The segment that is being sent: its cell, its packed blocks, and how many bytes of them have been sent."""
        self.shared = 0
        """Version of the game's shared values that the client has been sent or that waits in `shared_due`."""
        self.shared_due = b""
        """Message with the shared values that follows the next snapshot; empty: there is none."""
        self.private_due = b""
        """Message with the values of this player alone that follows the next snapshot; empty: there is none."""

    def send(self, message: bytes) -> None:
        """Hands a message to the link."""
        self.flow.sent_bytes += len(message)
        self.link.send(message)
