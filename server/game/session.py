"""A session: one connection of a client, from the handshake to its end."""

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, cast

from server.players.input_queue import InputQueue
from server.players.player import SETTLED_MAX, Player
from server.replication.client_stream import ClientStream, Framed, Transport
from server.replication.flow_control import FlowControl
from shared.checks import Cell
from shared.messages import Hello

if TYPE_CHECKING:
    from server.game.fast_path import FastPath
    from server.worlds.seats import Seat


NO_INPUTS = InputQueue()
"""Input queue of a session without a player. It stays empty."""


class Session:
    """One connection, from the handshake to its end.

    While a session is on the fast path (`server.game.fast_path`), a part of its state is in a row there. Reading
    `stream` or `inputs` takes it off the fast path first; reading `received_at` and `allowance` does not.

    Args:
        link: the connection.
        now: the time in seconds at which it opened.
    """

    def __init__(self, link: Transport, now: float) -> None:
        self.link = link
        self.framed = cast("Framed", link) if hasattr(link, "inlet") else None
        """The connection, if it takes and gives whole frames."""
        self.number = 0
        """Number of the connection, in the order in which the connections of the game opened."""
        self.row = -1
        """Number of its row on the fast path; -1: it is not on it."""
        self.fast_path: FastPath | None = None
        """The fast path that it is or was on."""
        self.plain, self.patience, self.enrolled = 0, 0, -1
        """Ticks in a row that needed nothing special; how many of them lead to the fast path (0: not known yet); the
        tick in which it came to the fast path."""
        self._stream = ClientStream(link, now)
        self.player: Player | None = None
        self.entity = 0
        """Number of the player's entity; 0 before the client has joined."""
        self._inputs = NO_INPUTS
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
        self.beginning = b""
        """Message that follows the welcome; empty: none."""
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

    @property
    def stream(self) -> ClientStream:
        """State of sending."""
        self.recall()
        return self._stream

    @property
    def flow(self) -> FlowControl:
        """Flow control. On the fast path, it lacks what is in the row."""
        return self._stream.flow

    @property
    def sees(self) -> Collection[Cell]:
        """Segments of the client view. They do not change on the fast path."""
        return self._stream.view.sees

    @property
    def inputs(self) -> InputQueue:
        """Input queue of the player."""
        self.recall()
        return self._inputs

    @property
    def acknowledged(self) -> bool:
        """Whether the client has acknowledged a snapshot."""
        return self.row >= 0 or self._stream.acked >= 0

    def recall(self) -> None:
        """Takes the session off the fast path, if it is on it."""
        if self.row >= 0:
            assert self.fast_path is not None
            self.fast_path.recall(self)

    def seat(self, player: Player) -> None:
        """Makes this the connection of a player."""
        self.player, self.entity, self._inputs = player, player.entity, player.inputs
        player.session, player.reconnect_until = self, math.inf
        del player.verdicts[:-SETTLED_MAX]  # bounds them for a client that reconnects again and again without reading
        self.hello = None

    def vacate(self) -> None:
        """Undoes `seat`."""
        self.recall()
        if self.player is not None:
            self.player.session = None
        self.player, self.entity, self._inputs = None, 0, NO_INPUTS

    def send(self, message: bytes) -> None:
        """Hands a message to the link. A session on the fast path stays there."""
        if self.row >= 0:
            assert self.fast_path is not None
            self.fast_path.sent(self.row, len(message))
            self.link.send(message)
        else:
            self._stream.send(message)

    def close(self, code: int, reason: str) -> None:
        """Closes the connection. Later messages in both directions are ignored."""
        if not self.closed:
            self.recall()
            self.closed = True
            self.link.close(code, reason)
