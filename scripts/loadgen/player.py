"""A simple player of the load generator, and the WebSocket frames that all generators of load send."""

import math
import random
import socket

from websockets.speedups import apply_mask

MASK = b"\x5a\x13\xc7\x2e"
REQUEST = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def frame(message: bytes) -> bytes:
    """Returns a message as a masked binary frame."""
    n = len(message)
    head = bytes((0x82, 0x80 | n)) if n < 126 else b"\x82\xfe" + n.to_bytes(2, "big")
    return head + MASK + bytes(apply_mask(message, MASK))


class Player:
    """A player with its connection."""

    __slots__ = ("acked", "buffer", "move", "number", "open", "phase", "pinged", "rng", "sent", "snapshots", "sock")

    def __init__(self, number: int, port: int, seed: int) -> None:
        self.number = number
        self.sock = socket.create_connection(("127.0.0.1", port))
        self.sock.setblocking(False)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.send(REQUEST)
        self.rng = random.Random(f"{seed} {number}")
        self.phase = self.rng.random()
        self.buffer = b""
        self.open = False
        self.acked = self.sent = -1
        self.pinged = -math.inf
        self.move = bytes(3)
        self.snapshots = 0
