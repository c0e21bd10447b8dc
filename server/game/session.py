"""A session: one connection of a client, from the handshake to its end."""

import math
from typing import TYPE_CHECKING, Any

from server.players.input_queue import InputQueue
from server.players.player import SETTLED_MAX, Player
from server.replication.client_stream import ClientStream, Transport
from shared.messages import Hello

if TYPE_CHECKING:
    from server.worlds.seats import Seat


class Session:
    """One connection, from the handshake to its end.

    Args:
        link: the connection.
        now: the time in seconds at which it opened.
    """

    def __init__(self, link: Transport, now: float) -> None:
        self.link = link
        self.stream = ClientStream(link, now)
        self.player: Player | None = None
        self.entity = 0
        """Number of the player's entity; 0 before the client has joined."""
        self.inputs = InputQueue()
        """Input queue of the player."""
        self.loading = False
        """Whether `Rules.load_player` runs for the client."""
        self.loaded: Any = None
        """Result of `Rules.load_player`."""
        self.reserved: Seat | None = None
        """Seat on which the client comes to one of many worlds (`server.worlds`); None: without one."""
        self.hello: Hello | None = None
        """Hello of a client that waits to join."""
        self.greeting: tuple[int, bytes] | None = None
        """Tick that must be durable before the welcome is sent, because of its resume token; and the welcome."""
        self.subject = ""
        self.opened = self.received_at = now
        """Times in seconds: when the connection opened, and when the latest message arrived."""
        self.allowance = 0.0
        """Number of messages that the client may send besides a full burst. Negative: the used part of the burst."""
        self.beside = False
        """Whether this is the second connection of a client that plays over another one (`server.scale`)."""
        self.closed = False
        self.resynced_at = now
        """Time in seconds of the client's latest request to get everything anew."""
        self.corrections = -1
        """Number of corrections that the client has reported; -1: none yet."""

    def seat(self, player: Player) -> None:
        """Makes this the connection of a player."""
        self.player, self.entity, self.inputs = player, player.entity, player.inputs
        player.session, player.reconnect_until = self, math.inf
        del player.verdicts[:-SETTLED_MAX]  # bounds them for a client that reconnects again and again without reading
        self.hello = None

    def vacate(self) -> None:
        """Undoes `seat`."""
        if self.player is not None:
            self.player.session = None
        self.player, self.entity, self.inputs = None, 0, InputQueue()

    def send(self, message: bytes) -> None:
        """Hands a message to the link."""
        self.stream.send(message)

    def close(self, code: int, reason: str) -> None:
        """Closes the connection. Later messages in both directions are ignored."""
        if not self.closed:
            self.closed = True
            self.link.close(code, reason)
