"""The gateway between WebSockets and the game: the listening sockets, and the set of accepted connections."""

import asyncio
import ssl
from collections.abc import Callable
from typing import Any, Protocol

from server.net.addresses import listeners
from server.net.admission import Admission
from server.net.tls_accept import Handshakes
from server.net.websocket import Connection
from server.observability.errors import FaultReporter
from server.observability.pages import Page

ACCEPT_BACKLOG = 1024
"""Connections that may wait to be accepted."""


class Events(Protocol):
    """The functions of a game that the gateway calls. `now` is the current time in seconds."""

    def open(self, link: Connection, now: float) -> Any:
        """Handles an open WebSocket. Returns an object (not None) that identifies it in later calls."""

    def receive(self, session: Any, data: bytes, now: float) -> None:
        """Handles one binary message."""

    def lost(self, session: Any, now: float) -> None:
        """Handles the end of a WebSocket. Called once per session."""


class Gateway:
    """The listener and the set of its connections.

    Args:
        game: gets every event.
        admission: decides which connections are accepted, and answers requests for pages.
        faults: where exceptions of the game are reported.
        route: returns what gets the events of a WebSocket instead of `game`, from the target (path and query) of its
            request and the address of its client; or the page that answers the request instead. None: any target leads
            to `game`.
    """

    def __init__(
        self,
        game: Events,
        admission: Admission | None = None,
        faults: FaultReporter | None = None,
        route: Callable[[str, str], Events | Page] | None = None,
    ) -> None:
        self.game = game
        self.route = route
        self.admission = admission or Admission()
        self.faults = faults or FaultReporter()
        self.connections: set[Connection] = set()
        self._servers: list[asyncio.Server | Handshakes] = []
        self._fewer: asyncio.Event = asyncio.Event()
        self._closing = False

    async def listen(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> tuple[str, int]:
        """Starts to accept connections on every address of a host.

        Args:
            host: a host name or an address; empty: every interface.
            port: the port; 0: the system picks one.
            tls: the TLS context; None: no TLS.

        Returns:
            The first of the host's addresses, and the port.

        Raises:
            OSError: no address can be used, or one of them is in use.
        """
        loop = asyncio.get_running_loop()
        sockets = await listeners(host, port, ACCEPT_BACKLOG)
        address: tuple[str, int] = sockets[0].getsockname()[:2]
        if tls is not None:
            handshakes = Handshakes(lambda: Connection(self, loop), tls, self.admission.limits.handshake_s)
            handshakes.listen(sockets)
            self._servers = [handshakes]
            return address
        for listener in sockets:
            server = await loop.create_server(lambda: Connection(self, loop), sock=listener, backlog=ACCEPT_BACKLOG)
            self._servers.append(server)
        return address

    def stop_listening(self) -> None:
        """Stops accepting, and aborts the connections that have not become WebSockets."""
        self._closing = True
        for server in self._servers:
            server.close()
        for connection in list(self.connections):
            if not connection.opened:
                connection.abort()

    async def drained(self) -> None:
        """Waits until no WebSocket is left."""
        while any(connection.opened for connection in self.connections):
            self._fewer.clear()
            await self._fewer.wait()

    def made(self, connection: Connection) -> None:
        self.connections.add(connection)
        if self._closing:
            connection.abort()

    def gone(self, connection: Connection) -> None:
        self.connections.discard(connection)
        self._fewer.set()
