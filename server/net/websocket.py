"""The WebSocket of one client, which passes its messages to the game, and the game's messages to the client.

Theory of operation. websockets parses the protocol (with its Sans-I/O `ServerProtocol`); plain messages are parsed
here, or left in their frames to the game's fast path (`inlet`). asyncio moves the bytes. Except for the TLS handshake
there is no task and no await per connection: a message is passed to the game in the callback that brings it, and what
the game sends is written in the call that sends it. Nothing here waits for a client. asyncio's flow control
(`pause_writing`) has no effect, because the game checks `outstanding()` before it sends. Frames that the game does not
get and so cannot count (pings, fragments, frames after the close) are limited here; a peer that exceeds these limits is
aborted.

A connection goes through these stages: handshake (or an HTTP page), `game.open`, `game.receive` for each message, and
exactly once `game.lost`, as soon as the peer has closed, violated the protocol or disconnected. Every stage that waits
for the peer has a time limit.
"""

import asyncio
import logging
import socket
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import CONNECTING, OPEN
from websockets.server import ServerProtocol

from server.net.http import answer_request
from server.net.tls_accept import AcceptedSocket
from server.observability.pages import BROKEN, Page
from shared.fields import CLIENT_MESSAGE_MAX

try:
    from websockets.speedups import apply_mask
except ImportError:  # the same function in Python
    from websockets.utils import apply_mask
if sys.platform == "linux":
    import fcntl
    from termios import TIOCOUTQ as SIOCOUTQ
if TYPE_CHECKING:
    from server.net.gateway import Events, Gateway

CLOSE_S = 2.0
"""Seconds in which a peer must finish closing before it is aborted."""
SLOWEST_BYTES_PER_S = 32 * 1024
"""Bytes per second at which a peer must read a page; it gets the time for it on top of `CLOSE_S`."""
EXTRAS_PER_S = 256
"""Pings, pongs and fragments per second, at 6 us each, beyond which a peer is aborted."""
DEAF_BYTES_MAX = 64 * 1024
"""Bytes that a peer may send after its connection was closed before it is aborted."""
OPCODES = frozenset(Opcode)
"""All valid opcodes."""
FINAL_BINARY = 0x82
"""First byte of an unfragmented binary message, the only frame that clients need."""
MASKED = 0x80
"""Bit of the second byte of a frame that every client must set."""
REASON_BYTES_MAX = 123
"""Maximum bytes of the reason in a close frame."""
_quiet = logging.getLogger(f"{__name__}.websockets")
_quiet.setLevel(logging.WARNING)  # otherwise websockets logs two lines per connection


def _frame_head(size: int) -> bytes:
    """Returns the header of an unmasked binary message of `size` bytes."""
    if size < 126:
        return bytes((FINAL_BINARY, size))
    if size < 1 << 16:
        return b"\x82\x7e" + size.to_bytes(2, "big")
    return b"\x82\x7f" + size.to_bytes(8, "big")


class Connection(AcceptedSocket):
    """One accepted socket, which the game uses as a `server.replication.client_stream.Link`."""

    def __init__(self, gateway: "Gateway", loop: asyncio.AbstractEventLoop) -> None:
        self.opened = False
        self.inlet: Callable[[bytes, float], bool] | None = None
        self._gateway = gateway
        self._events: Events = gateway.game  # what gets the events of this connection
        self._loop = loop
        self._protocol = ServerProtocol(max_size=CLIENT_MESSAGE_MAX, logger=_quiet)
        self._transport: asyncio.Transport | None = None
        self._address: str | None = None  # None: admission has not counted it
        self._fd = -1
        self._unacknowledged = bytearray(4)  # a C int that the kernel fills in
        self._timer: asyncio.TimerHandle | None = None
        self._timer_is_last = False
        self._session: Any = None
        self._live = False  # whether the protocol's state is OPEN; the look-up would take 1 us per client and tick
        self._deaf = False  # set when this side closes: later messages are not passed to the game
        self._unheard = 0  # bytes received since then
        self._extras, self._extras_since = 0, 0.0  # frames other than plain messages, and the start of their second
        self._plain = True  # False from the first unusual frame on: then websockets parses everything
        self._tail = b""  # the beginning of a frame that is not complete yet
        self._fragments = bytearray()
        self._fragmented = False

    # -- the link, as the game sees it ---------------------------------------------------------------------

    def send(self, message: bytes) -> None:
        """Queues one binary message. Does nothing if the WebSocket is no longer open."""
        if self._live and self._transport is not None:
            self._transport.write(_frame_head(len(message)) + message)

    def outlet(self) -> Callable[[bytes], None]:
        """Returns a function that queues one binary message in its frame, until the session has ended."""
        assert self._transport is not None
        return self._transport.write

    def outstanding(self) -> int | None:
        """Returns the bytes that the peer's kernel has not acknowledged.

        On other systems than Linux: the bytes that our kernel has not taken, or None (unknown) if there are none.
        """
        if self._transport is None:
            return 0
        waiting = self._transport.get_write_buffer_size()
        if sys.platform != "linux":
            return waiting or None
        fcntl.ioctl(self._fd, SIOCOUTQ, self._unacknowledged)
        return waiting + int.from_bytes(self._unacknowledged, sys.byteorder)

    def close(self, code: int, reason: str) -> None:
        """Closes the WebSocket after everything that was sent. Aborts if the peer does not finish within `CLOSE_S`."""
        self._deaf, self.inlet = True, None
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
        self._abort_in(self._gateway.admission.limits.handshake_s)
        sock = transport.get_extra_info("socket")
        self._fd = sock.fileno()
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError:  # some systems refuse it for a connection that the peer has reset
            self.abort()

    def data_received(self, data: bytes) -> None:
        inlet = self.inlet
        if inlet is not None and self._plain and not (self._tail or self._fragmented) and inlet(data, time.monotonic()):
            return
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
        self._last_limit()  # asyncio closes the socket only after everything is written, which may never happen
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
        """Counts the connection in admission. Returns False if it is to be dropped."""
        if self._gateway.admission.arrive(address):
            self._address = address
        return self._address is not None

    def leave(self) -> None:
        """Counts the end of the connection in admission, once."""
        if self._address is not None:
            self._gateway.admission.leave(self._address)
            self._address = None

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    def _shake_hands(self, data: bytes) -> bytes:
        """Handles the HTTP request. Returns the bytes after it, from clients that do not wait for the answer."""
        rest = answer_request(self._protocol, data, self._gateway.admission, self._address or "", self._find_events)
        self._flush()
        if not self._live:
            return b""
        self._open()
        return rest

    def _find_events(self, target: str) -> Page | None:
        """Finds what gets the events of this connection. Returns the page that refuses the request; None: it is good.

        Args:
            target: target of the request for a WebSocket: path and query.
        """
        if self._gateway.route is None:
            return None
        try:
            found = self._gateway.route(target, self._address or "")
        except Exception:
            self._gateway.faults.report("route")
            return BROKEN
        if isinstance(found, Page):
            self._gateway.admission.refused["path"] += 1
            return found
        self._events = found
        return None

    def _open(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self.opened = True
        try:
            self._session = self._events.open(self, time.monotonic())
        except Exception:
            self._gateway.faults.report("open")
            self.close(CloseCode.INTERNAL_ERROR, "internal error")

    def _cut(self, data: bytes) -> None:
        """Passes complete plain messages to the game directly, in 0.7 us each instead of 3.4 us through websockets.

        Pings, fragments and close frames go to websockets one by one. From the first unusual frame on, websockets
        parses everything and decides whether it is an error.
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
                if self._protocol.eof_sent:  # from here on websockets discards all data
                    self._plain = False
                    self._parse(data[end:])
                    return
            at = end
        self._tail = data[at:]

    def _floods(self) -> bool:
        """Counts a frame that is not a plain message. Returns whether there are too many of them."""
        now = time.monotonic()
        if now - self._extras_since >= 1:
            self._extras, self._extras_since = 0, now
        self._extras += 1
        return self._extras > EXTRAS_PER_S

    def _parse(self, data: bytes) -> None:
        """Parses data with websockets, which answers pings and closes. Passes the messages to the game."""
        self._protocol.receive_data(data)
        self._flush()
        for event in self._protocol.events_received():
            self._take(cast("Frame", event))

    def _take(self, frame: Frame) -> None:
        """Handles a valid frame. websockets has already answered pings and the peer's close frame."""
        if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            return
        was, self._fragmented = self._fragmented, not frame.fin
        if self._deaf:
            return
        if frame.opcode is Opcode.TEXT:
            self.close(CloseCode.UNSUPPORTED_DATA, "text message: only binary messages are allowed")
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
            self._events.receive(self._session, message, time.monotonic())
        except Exception:
            self._gateway.faults.report("receive")
            self.close(CloseCode.INTERNAL_ERROR, "internal error")

    def _flush(self) -> None:
        """Writes the data that websockets wants to send."""
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
        """Reports the end of the session to the game, once."""
        session, self._session = self._session, None
        if session is None:
            return
        try:
            self._events.lost(session, time.monotonic())
        except Exception:
            self._gateway.faults.report("lost")

    def _last_limit(self) -> None:
        """Aborts the connection in `CLOSE_S` seconds and the time for what waits, whatever the peer does meanwhile."""
        if not self._timer_is_last:
            self._timer_is_last = True
            waiting = 0 if self._transport is None else self._transport.get_write_buffer_size()
            self._abort_in(CLOSE_S + (0.0 if self.opened else waiting / SLOWEST_BYTES_PER_S))

    def _abort_in(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(seconds, self.abort)
