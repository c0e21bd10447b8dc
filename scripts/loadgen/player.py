"""A simple player of the load generator, and the WebSocket frames that all generators of load send."""

import math
import random
import socket

from websockets.speedups import apply_mask

MASK = b"\x5a\x13\xc7\x2e"


PING_S = 1.0
"""Seconds between two pings of a player."""


def request(path: str) -> bytes:
    """Returns the request for a WebSocket at a path."""
    return (
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


REQUEST = request("/")
"""Request for the default world."""


def frame(message: bytes) -> bytes:
    """Returns a message as a masked binary frame."""
    n = len(message)
    head = bytes((0x82, 0x80 | n)) if n < 126 else b"\x82\xfe" + n.to_bytes(2, "big")
    return head + MASK + bytes(apply_mask(message, MASK))


class WorldTime:
    """The time of one world, in ticks, by the quickest pong of the last second."""

    __slots__ = ("_asked", "_best", "tick_0")

    def __init__(self) -> None:
        self.tick_0 = self._best = self._asked = -math.inf
        """Time of the world at time 0 of the local clock; `-inf`: unknown."""

    def learn(self, tick_0: float, now: float) -> None:
        """Takes a pong. A later pong gives a lower value, so the highest of a second is taken.

        A server that drops ticks falls behind, so each second is measured anew.
        """
        if now - self._asked >= PING_S:
            self._asked, self.tick_0, self._best = now, max(self._best, tick_0), -math.inf
        self._best = max(self._best, tick_0)


class Player:
    """A player with its connection to a path of the server."""

    __slots__ = (
        "acked", "buffer", "changed", "due", "move", "number", "open", "phase", "pinged", "received", "rng", "row",
        "said", "sent", "snapshots", "sock", "time",
    )  # fmt: skip

    def __init__(self, number: int, port: int, seed: int, path: str, time: WorldTime) -> None:
        self.number, self.time = number, time
        self.sock = socket.create_connection(("127.0.0.1", port))
        self.sock.setblocking(False)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.send(request(path))
        self.rng = random.Random(f"{seed} {number}")
        self.phase = self.rng.random()
        self.buffer = b""
        self.open = False
        self.acked = self.sent = -1
        self.changed = self.received = -1
        """Newest tick of a changed input, and newest tick of an input that the server has received."""
        self.said = self.due = -1
        """Newest tick of a message with inputs, and that of the next one if the input stays the same."""
        self.row = b""
        """Input of the newest tick."""
        self.pinged = -math.inf
        self.move = bytes(3)
        self.snapshots = 0
