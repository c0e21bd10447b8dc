"""The transport of `Client`: one non-blocking socket, which the game's loop polls. No thread, no event loop."""

import contextlib
import errno
import math
import os
import select
import socket
import ssl
import time

from client_sdk.port import READ_BYTES
from client_sdk.transports.common import UNSENT_MAX
from client_sdk.transports.connection import Connection, insecure, stalled, unreachable

READS_MAX = 32
"""Limit of the reads per poll, together 2 MiB, so that one poll stays short after a long pause of the game."""
UNDER_WAY = (0, errno.EINPROGRESS, errno.EWOULDBLOCK)
"""Results of a non-blocking connect that has begun or succeeded; Windows returns EWOULDBLOCK."""
NOT_NOW = (BlockingIOError, InterruptedError, ssl.SSLWantReadError, ssl.SSLWantWriteError)
"""Exceptions of a non-blocking socket that cannot read or write at the moment."""


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
        self._connection = connection
        self._buffer = memoryview(bytearray(READ_BYTES))
        self._unsent = bytearray()
        self._timeout, self._tls = timeout, tls
        deadline = time.monotonic() + timeout
        self._dialing: socket.socket | None = None
        self._dial_until = math.inf
        self._socket: socket.socket | None = _connected(connection, timeout, tls)
        try:
            self._address, self._family = self._socket.getpeername(), self._socket.family
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._handshake(deadline)
        except BaseException:
            self._drop()
            raise

    def poll(self, now: float) -> None:
        """Reads what has arrived, writes what waits, and connects anew if it is time to; never blocks."""
        core = self._connection.core
        if core.dials(now):
            self._dial(now)
        elif self._dialing is not None and core.state != "closed":
            self._dial_on(self._dialing, now)
        if self._socket is None:
            return
        if now > self._dial_until and not self._connection.opened:
            self._connection.broke("no answer in time", now)
        self._read(self._socket, now)
        self._connection.look(now)
        self.send(now)

    def send(self, now: float) -> None:
        """Writes what waits, as far as the socket takes it; never blocks."""
        sock = self._socket
        if sock is None:
            return
        data: bytes | bytearray = self._connection.data_to_send(now)
        if self._unsent:
            self._unsent += data
            data = self._unsent
        if data:
            self._write(sock, data, now)
        if self._connection.done(now):
            self._drop()

    def close(self, timeout: float) -> None:
        """Writes what waits, then waits at most `timeout` seconds until the server closes the connection, too."""
        deadline = time.monotonic() + timeout
        try:
            while self._socket is not None and self._wait(deadline):
                self.poll(time.monotonic())
        finally:
            self._drop()

    def _dial(self, now: float) -> None:
        """Begins another connection, to the IP address of the first one."""
        self._drop()
        self._connection = Connection(self._connection.address, self._connection.core)
        self._connection.core.reconnect.trying()
        self._dial_until = now + self._timeout
        try:
            self._dialing = socket.socket(self._family, socket.SOCK_STREAM)
            self._dialing.setblocking(False)
            code = self._dialing.connect_ex(self._address)
            if code not in UNDER_WAY:
                raise OSError(code, os.strerror(code))
        except OSError as error:  # no network, no descriptor left
            self._give_up(error.strerror or str(error), now)

    def _dial_on(self, sock: socket.socket, now: float) -> None:
        """Continues to connect: checks the TCP connect, then the TLS handshake, and gives up when time is over."""
        try:
            if isinstance(sock, ssl.SSLSocket):
                sock.do_handshake()
            else:
                if not any(select.select([], [sock], [sock], 0)):  # Windows reports a failure in the third list
                    if now > self._dial_until:
                        raise TimeoutError("no answer in time")
                    return
                error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if error:
                    raise OSError(error, os.strerror(error))
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if self._connection.uri.secure:
                    tls, host = self._tls or ssl.create_default_context(), self._connection.uri.host
                    self._dialing = tls.wrap_socket(sock, server_hostname=host, do_handshake_on_connect=False)
                    return
            self._socket, self._dialing = sock, None
        except NOT_NOW:
            if now > self._dial_until:
                self._give_up("no answer in time", now)
        except OSError as error:
            self._give_up(error.strerror or str(error), now)

    def _give_up(self, reason: str, now: float) -> None:
        self._drop()
        self._connection.broke(f"no connection ({reason})", now)

    def _handshake(self, deadline: float) -> None:
        connection = self._connection
        while True:
            self.poll(time.monotonic())
            if connection.opened:
                return
            if connection.refused is not None:
                raise connection.refused
            if not self._wait(deadline):
                raise unreachable(connection, TimeoutError())

    def _wait(self, deadline: float) -> bool:
        """Waits at most 0.1 s until the socket can read or write. Returns False after the deadline."""
        sock, left = self._socket, deadline - time.monotonic()
        if sock is None or left <= 0:
            return False
        select.select([sock], [sock] if self._unsent else [], [], min(left, 0.1))
        return True

    def _read(self, sock: socket.socket, now: float) -> None:
        buffer, receive, core = self._buffer, self._connection.receive, self._connection.core
        for _ in range(READS_MAX):
            room = core.port.appetite
            if room < READ_BYTES:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)  # the rest waits at the server
                if not room:
                    return
            try:
                n = sock.recv_into(buffer, room)
            except NOT_NOW:
                return
            except OSError as error:
                self._connection.broke(f"the connection broke off ({error.strerror or error})", now)
                return
            if n == 0:
                self._connection.receive_eof(now)
                return
            receive(buffer[:n], now)

    def _write(self, sock: socket.socket, data: bytes | bytearray, now: float) -> None:
        try:
            sent = sock.send(data)
        except NOT_NOW:
            sent = 0
        except OSError as error:
            self._connection.broke(f"the connection broke off ({error.strerror or error})", now)
            return
        self._unsent = bytearray(memoryview(data)[sent:])
        if len(self._unsent) > UNSENT_MAX:
            stalled(self._connection, now)

    def _drop(self) -> None:
        for sock in (self._socket, self._dialing):
            if sock is not None:
                sock.close()
        self._socket = self._dialing = None
        self._unsent.clear()


def _connected(connection: Connection, timeout: float, tls: ssl.SSLContext | None) -> socket.socket:
    """Returns a connected socket: TCP, with TLS for wss://.

    Raises:
        ConnectError: the connection or the TLS handshake failed.
    """
    uri = connection.uri
    with contextlib.ExitStack() as undo:
        try:
            sock = undo.enter_context(socket.create_connection((uri.host, uri.port), timeout))
            if uri.secure:
                tls = tls or ssl.create_default_context()
                sock = undo.enter_context(tls.wrap_socket(sock, server_hostname=uri.host))
        except ssl.SSLError as error:
            raise insecure(connection, error) from error
        except OSError as error:
            raise unreachable(connection, error) from error
        undo.pop_all()
    return sock
