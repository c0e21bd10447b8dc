"""A session: one connection of a client, from the handshake to its end."""

import math

from server.players.input_queue import InputQueue
from server.players.player import SETTLED_MAX, Player
from server.replication.client_stream import ClientStream, Link
from shared.messages import Hello


class Session:
    """One connection, from the handshake to its end."""

    def __init__(self, link: Link, now: float) -> None:
        self.link = link
        self.stream = ClientStream(link, now)
        self.player: Player | None = None
        self.entity = 0
        """The player's entity; 0 before the client has joined."""
        self.inputs = InputQueue()
        """The player's."""
        self.hello: Hello | None = None
        """With which it waits to join."""
        self.greeting: tuple[int, bytes] | None = None
        """Its welcome, and the tick from which on it may be sent: when the token in it is on disk."""
        self.subject = ""
        self.opened = self.heard = now
        self.allowance = 0.0
        self.closed = False
        self.resynced_at = now
        self.corrections = -1
        """As the client has reported them; -1: not yet."""

    def seat(self, player: Player) -> None:
        """This connection is the player's from now on."""
        self.player, self.entity, self.inputs = player, player.entity, player.inputs
        player.session, player.away_until = self, math.inf
        del player.verdicts[:-SETTLED_MAX]  # who comes back time and again without reading must not pile them up
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
        """Ends the connection; nothing is taken from it or sent to it any more."""
        if not self.closed:
            self.closed = True
            self.link.close(code, reason)
