"""WebSockets to calls of the game and back; the only file of the server that knows websockets.

websockets parses (its Sans-I/O `ServerProtocol`; only plain messages are cut out here), asyncio moves bytes, and there
is no task and no await per connection but for its TLS handshake: what arrives is handed to the game in the call that
brings it, what the game sends is written in the call that sends it. Nothing here waits for a client. asyncio's flow
control (`pause_writing`) has no effect: the game looks at `outstanding()` before it sends. What the game does not get,
and so cannot count (pings, fragments, whatever comes after the end), is bounded here: who sends too much of it is
aborted.

The life of a connection: handshake (or an HTTP page) -> `game.open` -> `game.receive` ... -> `game.lost`, exactly
once, as soon as the peer has closed, broken the protocol or gone. A stage that has a peer to wait for has a limit.
"""

import asyncio
import logging
import socket
import ssl
import sys
import time
from http import HTTPStatus
from typing import Any, Protocol, cast

from websockets.datastructures import Headers
from websockets.exceptions import InvalidMessage
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.protocol import CONNECTING, OPEN
from websockets.server import ServerProtocol

from server.net.addresses import listeners
from server.net.admission import Door, Request
from server.net.tls_accept import Guest, Handshakes
from server.observability.errors import Faults
from server.observability.pages import Page
from shared.messages import CLIENT_MESSAGE_MAX

try:
    from websockets.speedups import apply_mask
except ImportError:  # the same, plain
    from websockets.utils import apply_mask
if sys.platform == "linux":
    import fcntl
    from termios import TIOCOUTQ as SIOCOUTQ

CLOSE_S = 2.0
"""A peer that does not finish closing by then is aborted."""
EXTRAS_PER_S = 256
"""So are one that sends more pings, pongs and fragments, of 6 us each,"""
DEAF_BYTES_MAX = 64 * 1024
"""and one that sends more than this after its connection has been closed."""
OPCODES = frozenset(Opcode)
FINAL_BINARY = 0x82
MASKED = 0x80
"""First byte of the only frame that clients have a reason to send; bit of the second that it must have."""
REASON_BYTES_MAX = 123
"""A close frame has room for no more."""
ACCEPT_BACKLOG = 1024

logger = logging.getLogger(__name__)
_quiet = logging.getLogger(f"{__name__}.websockets")
_quiet.setLevel(logging.WARNING)  # two lines per connection otherwise


def _frame_head(size: int) -> bytes:
    """What goes before an unmasked binary message of so many bytes."""
    if size < 126:
        return bytes((FINAL_BINARY, size))
    if size < 1 << 16:
        return b"\x82\x7e" + size.to_bytes(2, "big")
    return b"\x82\x7f" + size.to_bytes(8, "big")


def _response(page: Page) -> Response:
    status = HTTPStatus(page.status)
    fixed = (("Connection", "close"), ("Content-Length", str(len(page.body))), ("Content-Type", page.content_type))
    return Response(status.value, status.phrase, Headers(fixed + page.headers), page.body)


class Events(Protocol):
    """What the gateway tells the game."""

    def open(self, link: "Connection", now: float) -> Any:
        """A WebSocket is open; what is returned (not None) stands for it from here on."""

    def receive(self, session: Any, data: bytes, now: float) -> None:
        """One binary message."""

    def lost(self, session: Any, now: float) -> None:
        """The WebSocket is no more; once per session."""


class Gateway:
    """Listens, and keeps the set of connections.

    Args:
        game: told of every event.
        door: decides who comes in, and has the pages.
        faults: told of exceptions that the game raised.
    """

    def __init__(self, game: Events, door: Door | None = None, faults: Faults | None = None) -> None:
        self.game = game
        self.door = door or Door()
        self.faults = faults or Faults()
        self.connections: set[Connection] = set()
        self._servers: list[asyncio.Server | Handshakes] = []
        self._fewer: asyncio.Event = asyncio.Event()
        self._closing = False

    async def listen(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> tuple[str, int]:
        """Starts to accept on every address of a host, in TLS if there is a context for it.

        Returns:
            The first of the host's addresses, and the port (with port 0, the one that the system picked).

        Raises:
            OSError: see `listeners`.
        """
        loop = asyncio.get_running_loop()
        sockets = await listeners(host, port, ACCEPT_BACKLOG)
        address: tuple[str, int] = sockets[0].getsockname()[:2]
        if tls is not None:
            handshakes = Handshakes(lambda: Connection(self, loop), tls, self.door.limits.handshake_s)
            handshakes.listen(sockets)
            self._servers = [handshakes]
            return address
        for listener in sockets:
            server = await loop.create_server(lambda: Connection(self, loop), sock=listener, backlog=ACCEPT_BACKLOG)
            self._servers.append(server)
        return address

    def stop_listening(self) -> None:
        """No new connection, and an end to those that have not become WebSockets."""
        self._closing = True
        for server in self._servers:
            server.close()
        for connection in list(self.connections):
            if not connection.opened:
                connection.abort()

    async def drained(self) -> None:
        """Returns when no WebSocket is left."""
        while any(connection.opened for connection in self.connections):
            self._fewer.clear()
            await self._fewer.wait()

    def made(self, connection: "Connection") -> None:
        self.connections.add(connection)
        if self._closing:
            connection.abort()

    def gone(self, connection: "Connection") -> None:
        self.connections.discard(connection)
        self._fewer.set()


class Connection(Guest):
    """One accepted socket; to the game it is a `server.game.session.Link`."""

    def __init__(self, gateway: Gateway, loop: asyncio.AbstractEventLoop) -> None:
        self.opened = False
        self._gateway = gateway
        self._loop = loop
        self._protocol = ServerProtocol(max_size=CLIENT_MESSAGE_MAX, logger=_quiet)
        self._transport: asyncio.Transport | None = None
        self._address: str | None = None  # None: it has not been let in
        self._fd = -1
        self._unacknowledged = bytearray(4)  # a C int that the kernel fills in
        self._timer: asyncio.TimerHandle | None = None
        self._timer_is_last = False
        self._session: Any = None
        self._live = False  # whether the protocol's state is OPEN: looking that up took 1 us of a client's tick
        self._deaf = False  # set when this side closes: what still comes is not the game's business
        self._unheard = 0  # bytes that have come since then
        self._extras, self._extras_since = 0, 0.0  # frames that are no plain message, in a second that began then
        self._plain = True  # false from the first frame on that only websockets may judge
        self._tail = b""  # of a plain stream: the beginning of a frame
        self._fragments = bytearray()
        self._fragmented = False

    # -- the link, as the game sees it ---------------------------------------------------------------------

    def send(self, message: bytes) -> None:
        """Queues one binary message; nothing happens if the WebSocket is not open any more."""
        if self._live and self._transport is not None:
            self._transport.write(_frame_head(len(message)) + message)

    def outstanding(self) -> int | None:
        """Bytes that the peer's kernel has not acknowledged (not on Linux: that ours has not taken, and None for 0)."""
        if self._transport is None:
            return 0
        waiting = self._transport.get_write_buffer_size()
        if sys.platform != "linux":
            return waiting or None
        fcntl.ioctl(self._fd, SIOCOUTQ, self._unacknowledged)
        return waiting + int.from_bytes(self._unacknowledged, sys.byteorder)

    def close(self, code: int, reason: str) -> None:
        """Closes once what was sent has gone out, with an abort if the peer does not finish within `CLOSE_S`."""
        self._deaf = True
        if self._live:
            self._protocol.send_close(code, reason.encode()[:REASON_BYTES_MAX].decode(errors="ignore"))
            self._flush()

    # -- what asyncio calls --------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._gateway.made(self)
        peer = transport.get_extra_info("peername")
        if self._address is None and not self.enter(str(peer[0]) if peer else ""):
            self.abort()
            return
        self._abort_in(self._gateway.door.limits.handshake_s)
        sock = transport.get_extra_info("socket")
        self._fd = sock.fileno()
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError:  # some systems refuse it for a connection that the peer has reset
            self.abort()

    def data_received(self, data: bytes) -> None:
        if not self._live and self._protocol.state is CONNECTING and not self._protocol.eof_sent:
            data = self._shake_hands(data)
            if not data:
                return
        if self._deaf:
            self._unheard += len(data)
            if self._unheard > DEAF_BYTES_MAX:
                self.abort()
                return
        if self._plain:
            self._cut(data)
        else:
            self._parse(data)
        if not self._live:
            self._lose()

    def eof_received(self) -> None:
        self._protocol.receive_eof()
        self._flush()
        self._last_limit()  # asyncio closes the socket once everything is written, which may be never
        self._lose()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._transport = None
        self.leave()
        self._gateway.gone(self)
        self._lose()

    # -- inside --------------------------------------------------------------------------------------------

    def enter(self, address: str) -> bool:
        """See `Guest`."""
        if self._gateway.door.arrive(address):
            self._address = address
        return self._address is not None

    def leave(self) -> None:
        """See `Guest`."""
        if self._address is not None:
            self._gateway.door.leave(self._address)
            self._address = None

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    def _shake_hands(self, data: bytes) -> bytes:
        """Handles the request, and returns what came after it (clients that do not wait for the answer may speak).

        Line by line, for websockets would parse what follows the request before the request is answered.
        """
        protocol, start = self._protocol, 0
        while start < len(data):
            end = data.find(b"\n", start) + 1 or len(data)
            protocol.receive_data(data[start:end])
            start = end
            events = protocol.events_received()
            if events:
                self._answer(cast("HttpRequest", events[0]))
                break
            if isinstance(protocol.handshake_exc, InvalidMessage):  # of itself websockets only hangs up
                response = protocol.reject(HTTPStatus.BAD_REQUEST, "this is not an HTTP request\n")
                protocol.writes.insert(0, response.serialize())
            if protocol.eof_sent:
                break
        self._flush()
        if not self._live:
            return b""
        self._open()
        return data[start:]

    def _answer(self, request: HttpRequest) -> None:
        protocol, headers = self._protocol, request.headers
        upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
        origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
        asked = Request(request.method, request.path, " ".join(hosts), " ".join(origins) if origins else None, upgrade)
        page = self._gateway.door.answer(asked, self._address or "", time.monotonic())
        protocol.send_response(protocol.accept(request) if page is None else _response(page))

    def _open(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self.opened = True
        try:
            self._session = self._gateway.game.open(self, time.monotonic())
        except Exception:
            self._gateway.faults.report("open")
            self.close(CloseCode.INTERNAL_ERROR, "internal error")

    def _cut(self, data: bytes) -> None:
        """Delivers whole plain messages at once (0.7 us instead of 3.4 by way of websockets) and has it parse the rest.

        It gets pings, fragments and the like frame by frame, and everything from the first oddity on: then it decides.
        """
        if self._tail:
            data, self._tail = self._tail + data, b""
        at, size = 0, len(data)
        while size - at >= 2:
            first, second = data[at], data[at + 1]
            length, mask = second & 127, at + 2
            if length == 126 and size - at >= 4:
                length, mask = data[at + 2] << 8 | data[at + 3], at + 4
            elif length == 127 and size - at >= 10:
                length, mask = int.from_bytes(data[at + 2 : at + 10], "big"), at + 10
            odd = second < MASKED or length > CLIENT_MESSAGE_MAX
            if odd or (first != FINAL_BINARY and first & 15 not in OPCODES):
                self._plain = False
                self._parse(data[at:])
                return
            start, end = mask + 4, mask + 4 + length
            if end > size:
                break
            if first == FINAL_BINARY and not self._fragmented:
                if not self._deaf:
                    self._deliver(apply_mask(data[start:end], data[mask:start]))
            elif self._floods():
                self.abort()
                return
            else:
                self._parse(data[at:end])
                if self._protocol.eof_sent:  # from here on it throws away what comes
                    self._plain = False
                    self._parse(data[end:])
                    return
            at = end
        self._tail = data[at:]

    def _floods(self) -> bool:
        """Counts a frame that is no plain message; whether that is one too many."""
        now = time.monotonic()
        if now - self._extras_since >= 1:
            self._extras, self._extras_since = 0, now
        self._extras += 1
        return self._extras > EXTRAS_PER_S

    def _parse(self, data: bytes) -> None:
        """Has websockets parse: it answers pings and closes where it must, and the game gets the messages."""
        self._protocol.receive_data(data)
        self._flush()
        for event in self._protocol.events_received():
            self._take(cast("Frame", event))

    def _take(self, frame: Frame) -> None:
        """One frame that websockets found in order; it has answered pings and the peer's closing by then."""
        if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            return
        was, self._fragmented = self._fragmented, not frame.fin
        if self._deaf:
            return
        if frame.opcode is Opcode.TEXT:
            self.close(CloseCode.UNSUPPORTED_DATA, "text message: binary ones only")
        elif frame.fin and not was:
            self._deliver(bytes(frame.data))
        else:
            self._fragments += frame.data
            if frame.fin:
                message = bytes(self._fragments)
                self._fragments.clear()
                self._deliver(message)

    def _deliver(self, message: bytes) -> None:
        try:
            self._gateway.game.receive(self._session, message, time.monotonic())
        except Exception:
            self._gateway.faults.report("receive")
            self.close(CloseCode.INTERNAL_ERROR, "internal error")

    def _flush(self) -> None:
        """Writes what websockets wants written."""
        transport = self._transport
        writes = self._protocol.data_to_send()
        self._live = self._protocol.state is OPEN
        if transport is None or not writes:
            return
        for data in writes:
            if data:
                transport.write(data)
            elif transport.can_write_eof():
                transport.write_eof()
            else:
                transport.close()
        if self._protocol.close_expected():
            self._last_limit()

    def _lose(self) -> None:
        """Tells the game, once, that the session is over."""
        session, self._session = self._session, None
        if session is None:
            return
        try:
            self._gateway.game.lost(session, time.monotonic())
        except Exception:
            self._gateway.faults.report("lost")

    def _last_limit(self) -> None:
        """The end has begun: from now on the peer has `CLOSE_S`, whatever else it does."""
        if not self._timer_is_last:
            self._timer_is_last = True
            self._abort_in(CLOSE_S)

    def _abort_in(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(seconds, self.abort)
