"""The transport of `Client`: non-blocking sockets, which the game's loop polls. No thread, no event loop.

Only the look-up of a server's name that is new to the client has a thread of its own.
"""

import socket
import ssl
import time

from client_sdk.transports.common import timeout_s
from client_sdk.transports.connection import Connection, unreachable
from client_sdk.transports.stream import Places, PollingStream, connected


class PollingTransport:
    """A connection over one non-blocking TCP socket (TLS for wss://), and over new ones when the core needs them.

    The constructor blocks until the handshake is done.

    Args:
        connection: the WebSocket whose bytes are moved.
        timeout: longest time of a handshake with its TCP connect, in seconds.
        tls: certificates to trust for wss://; None: those that the system trusts.

    Raises:
        ConnectError: there is no connection; the text says why.
    """

    def __init__(self, connection: Connection, timeout: float, tls: ssl.SSLContext | None = None) -> None:
        self._core, self._address = connection.core, connection.address
        self._timeout, self._tls = timeout, tls
        self._places = Places()
        deadline = time.monotonic() + timeout
        sock = connected(connection, timeout, tls)
        self._places.learn(connection.uri.host, connection.uri.port, sock)
        self._first = self._stream(connection, sock, time.monotonic())
        self._second: PollingStream | None = None
        try:
            self._handshake(deadline)
        except BaseException:
            self._first.drop()
            raise

    def poll(self, now: float) -> None:
        """Reads what has arrived, writes what waits, and connects anew if it is time to; never blocks."""
        core = self._core
        if core.dials(now):
            self._first.drop()
            core.reconnect.trying()
            self._first = self._stream(Connection(self._address, core), None, now)
        if self._first.open or core.state != "closed":
            self._first.poll(now)
        self._change(now)

    def send(self, now: float) -> None:
        """Writes what waits, as far as the socket takes it; never blocks."""
        self._first.send(now)
        if self._second is not None:
            self._second.send(now)

    def close(self, timeout: float) -> None:
        """Writes what waits, then waits at most `timeout` seconds until the server closes the connection, too."""
        deadline = time.monotonic() + timeout
        try:
            while self._first.wait(deadline):
                self.poll(time.monotonic())
        finally:
            self._first.drop()
            if self._second is not None:
                self._second.drop()

    def _stream(self, connection: Connection, sock: socket.socket | None, now: float) -> PollingStream:
        timeout = timeout_s(self._core.travel, self._timeout)
        return PollingStream(connection, timeout, self._tls, self._places, sock, now)

    def _change(self, now: float) -> None:
        """Opens a second connection, and makes it the first or closes it, as the core says."""
        core, second = self._core, self._second
        if second is None and core.second is not None:
            second = self._second = self._stream(Connection(self._address, core, core.second), None, now)
        if second is None:
            return
        second.poll(now)
        if core.second is second.connection.port:
            return
        self._second = None
        if second.connection.complete:
            self._first.drop()
            second.connection.take_place()
            self._first = second
            second.send(now)
        else:
            second.drop()

    def _handshake(self, deadline: float) -> None:
        connection = self._first.connection
        while True:
            self.poll(time.monotonic())
            if connection.opened:
                return
            if connection.refused is not None:
                raise connection.refused
            if not self._first.wait(deadline):
                raise unreachable(connection, TimeoutError())
