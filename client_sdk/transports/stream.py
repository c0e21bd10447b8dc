"""One non-blocking TCP or TLS socket of a `connection.Connection`, which the program's loop polls."""

import contextlib
import errno
import math
import os
import select
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from typing import Any

from client_sdk.port import READ_BYTES
from client_sdk.transports.common import UNSENT_MAX
from client_sdk.transports.connection import Connection, insecure, stalled, unreachable

READS_MAX = 32
"""Limit of the reads per poll, together 2 MiB, so that one poll stays short after a long pause of the game."""
UNDER_WAY = (0, errno.EINPROGRESS, errno.EWOULDBLOCK)
"""Results of a non-blocking connect that has begun or succeeded; Windows returns EWOULDBLOCK."""
NOT_NOW = (BlockingIOError, InterruptedError, ssl.SSLWantReadError, ssl.SSLWantWriteError)
"""Exceptions of a non-blocking socket that cannot read or write at the moment."""

Place = tuple[socket.AddressFamily, tuple[object, ...]]
"""Address family and address of a server, for `socket.connect`."""


class Places:
    """The network addresses of the servers that a client knows, by host and port. Each is looked up once."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], Place] = {}
        self._asked: dict[tuple[str, int], _Lookup] = {}

    def learn(self, host: str, port: int, sock: socket.socket) -> None:
        """Takes the address to which a socket is connected."""
        self._known[host, port] = sock.family, sock.getpeername()

    def find(self, host: str, port: int) -> Place | None:
        """Returns the address of a server; None: it is not known yet. Never blocks.

        Raises:
            OSError: the host has no address.
        """
        place = self._known.get((host, port))
        if place is None:
            lookup = self._asked.setdefault((host, port), _Lookup(host, port))
            if lookup.done:
                del self._asked[host, port]
                place = self._known[host, port] = lookup.result()
        return place


class _Lookup:
    """A look-up of a name, in a thread of its own if it may take time."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self.done = False
        """Whether there is a result."""
        self._found: Place | OSError = OSError(f"{host}: no address")
        try:
            self._take(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST))
        except OSError:
            threading.Thread(target=self._look_up, daemon=True).start()

    def result(self) -> Place:
        """Returns the address. Raises an `OSError` if there is none."""
        if isinstance(self._found, OSError):
            raise self._found
        return self._found

    def _look_up(self) -> None:
        try:
            self._take(socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM))
        except OSError as error:
            self._found, self.done = error, True

    def _take(self, found: Sequence[tuple[Any, ...]]) -> None:
        family, _, _, _, address = found[0]
        self._found, self.done = (family, address), True


class PollingStream:
    """The socket of one connection.

    Args:
        connection: the WebSocket whose bytes are moved.
        timeout: longest time of a handshake with its TCP connect, in seconds.
        tls: certificates to trust for wss://; None: those that the system trusts.
        places: the network addresses that are known.
        sock: a connected socket; None: the stream connects by itself, while it is polled.
        now: the current time in seconds.
    """

    def __init__(
        self,
        connection: Connection,
        timeout: float,
        tls: ssl.SSLContext | None,
        places: Places,
        sock: socket.socket | None,
        now: float,
    ) -> None:
        self.connection = connection
        self._tls, self._places = tls, places
        self._buffer = memoryview(bytearray(READ_BYTES))
        self._unsent = bytearray()
        self._socket = sock
        self._dialing: socket.socket | None = None
        self._looking = sock is None
        self._until = math.inf if sock is not None else now + timeout

    @property
    def open(self) -> bool:
        """Whether there is a socket that is connected."""
        return self._socket is not None

    def poll(self, now: float) -> None:
        """Connects, reads what has arrived, and writes what waits; never blocks."""
        if self._looking:
            self._dial(now)
        elif self._dialing is not None:
            self._dial_on(self._dialing, now)
        if self._socket is None:
            return
        if now > self._until and not self.connection.opened:
            self.connection.broke("no answer in time", now)
        self._read(self._socket, now)
        self.connection.look(now)
        self.send(now)

    def send(self, now: float) -> None:
        """Writes what waits, as far as the socket takes it; never blocks."""
        sock = self._socket
        if sock is None:
            return
        data: bytes | bytearray = self.connection.data_to_send(now)
        if self._unsent:
            self._unsent += data
            data = self._unsent
        if data:
            self._write(sock, data, now)
        if self.connection.done(now):
            self.drop()

    def drop(self) -> None:
        """Closes the socket."""
        self._looking = False
        for sock in (self._socket, self._dialing):
            if sock is not None:
                sock.close()
        self._socket = self._dialing = None
        self._unsent.clear()

    def wait(self, deadline: float) -> bool:
        """Waits at most 0.1 s until the socket can read or write. Returns False after the deadline."""
        sock, left = self._socket, deadline - time.monotonic()
        if sock is None or left <= 0:
            return False
        select.select([sock], [sock] if self._unsent else [], [], min(left, 0.1))
        return True

    def _dial(self, now: float) -> None:
        """Begins to connect as soon as the network address of the server is known."""
        uri = self.connection.uri
        try:
            place = self._places.find(uri.host, uri.port)
            if place is None:
                if now > self._until:
                    raise TimeoutError("no answer in time")
                return
            self._looking = False
            family, address = place
            self._dialing = socket.socket(family, socket.SOCK_STREAM)
            self._dialing.setblocking(False)
            code = self._dialing.connect_ex(address)
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
                    if now > self._until:
                        raise TimeoutError("no answer in time")
                    return
                error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if error:
                    raise OSError(error, os.strerror(error))
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if self.connection.uri.secure:
                    tls, host = self._tls or ssl.create_default_context(), self.connection.uri.host
                    self._dialing = tls.wrap_socket(sock, server_hostname=host, do_handshake_on_connect=False)
                    return
            self._socket, self._dialing = sock, None
        except NOT_NOW:
            if now > self._until:
                self._give_up("no answer in time", now)
        except OSError as error:
            self._give_up(error.strerror or str(error), now)

    def _give_up(self, reason: str, now: float) -> None:
        self.drop()
        self.connection.broke(f"no connection ({reason})", now)

    def _read(self, sock: socket.socket, now: float) -> None:
        buffer, receive, connection = self._buffer, self.connection.receive, self.connection
        for _ in range(READS_MAX):
            room = connection.port.appetite
            if room < READ_BYTES:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)  # the rest waits at the server
                if not room:
                    return
            try:
                n = sock.recv_into(buffer, room)
            except NOT_NOW:
                return
            except OSError as error:
                connection.broke(f"the connection broke off ({error.strerror or error})", now)
                return
            if n == 0:
                connection.receive_eof(now)
                return
            receive(buffer[:n], now)

    def _write(self, sock: socket.socket, data: bytes | bytearray, now: float) -> None:
        try:
            sent = sock.send(data)
        except NOT_NOW:
            sent = 0
        except OSError as error:
            self.connection.broke(f"the connection broke off ({error.strerror or error})", now)
            return
        self._unsent = bytearray(memoryview(data)[sent:])
        if len(self._unsent) > UNSENT_MAX:
            stalled(self.connection, now)


def connected(connection: Connection, timeout: float, tls: ssl.SSLContext | None) -> socket.socket:
    """Returns a connected, non-blocking socket: TCP, with TLS for wss://. Blocks until it is connected.

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
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except ssl.SSLError as error:
            raise insecure(connection, error) from error
        except OSError as error:
            raise unreachable(connection, error) from error
        undo.pop_all()
    return sock
