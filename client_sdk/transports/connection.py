"""A core joined to a WebSocket: bytes of the TCP or TLS stream in, bytes of the stream out, no socket.

    connecting   the request of the handshake is sent
    open         the core sends and receives
    ending       a close frame was sent or received, or the stream broke off; the core is notified, and the stream may
                 stay open for a little longer
    done         the transport has to close the stream

The library websockets does the framing (its Sans-I/O `ClientProtocol`). This module has all that the transports have
in common, so that each of them adds only a socket. Nothing is compressed: the client offers no extension.
"""

import ssl
from dataclasses import replace
from urllib.parse import urlsplit, urlunsplit

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus, InvalidURI
from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import CLOSED, OPEN
from websockets.uri import WebSocketURI, parse_uri

from client_sdk.advice import TLS_ALERT, untrusted
from client_sdk.core import Core
from client_sdk.port import Port
from client_sdk.transports.common import ADDRESS_HINT, CLOSE_S, UNSENT_MAX, ConnectError, Silence, sendable, silence_s
from shared.checks import shown
from shared.fields import MESSAGE_MAX, REASON_MAX
from shared.messages import TEXT, TOO_SLOW

REFUSALS = (400, 403, 404, 409, 429, 503)
"""HTTP statuses with which a server refuses a client and sends the reason as text."""


class Connection:
    """One WebSocket connection of a core, to the server and the path that the core names.

    Args:
        url: address of the server, like ws://host:8765. Its path is the first one of the core.
        core: the state machine whose messages are sent and received.
        second: the port of the core's second connection, if this is that one.

    Raises:
        ConnectError: `url` is not the address of a server.
    """

    def __init__(self, url: str, core: Core, second: Port | None = None) -> None:
        self.address = url
        """The address that the program gave; the next connection begins with it."""
        self.uri = parsed(url)
        core.travel.path = core.travel.path or self.uri.resource_name
        server = core.handover.address if second is not None and core.handover is not None else core.travel.server
        if server:
            parts = urlsplit(server)
            scheme = "wss" if self.uri.secure else parts.scheme  # an address cannot switch TLS off
            url = urlunsplit(urlsplit(url)._replace(scheme=scheme, netloc=parts.netloc))
            self.uri = parsed(url)
        if self.uri.resource_name != core.travel.path:
            path, _, query = core.travel.path.partition("?")
            self.uri = replace(self.uri, path=path, query=query)
            url = urlunsplit(urlsplit(url)._replace(path=path, query=query))
        self.url = url
        self.core = core
        self._second, self._handover = second, core.handover if second is not None else None
        self.refused: ConnectError | None = None
        """The error with which the handshake failed; None while it may still succeed, and after it has succeeded."""
        self._protocol = ClientProtocol(self.uri, max_size=MESSAGE_MAX)
        self._protocol.send_request(self._protocol.connect())
        self._began = b""  # the first bytes of the server's answer, at most two
        self._fragments = bytearray()
        self._ending_since: float | None = None
        self._silence = Silence()

    @property
    def port(self) -> Port:
        """The side of the core that this connection talks to."""
        return self.core.port if self._second is None else self._second

    @property
    def second(self) -> bool:
        """Whether this is a second connection that has not taken the place of the first."""
        return self._second is not None

    @property
    def complete(self) -> bool:
        """Whether this is a second connection that has to take the place of the first."""
        return self._handover is not None and self._handover.complete

    def take_place(self) -> None:
        """Makes this the first connection of the core, because the hand-over to it is complete."""
        self._second = None

    @property
    def opened(self) -> bool:
        """Whether the handshake has succeeded; stays true when the connection ends."""
        return self._protocol.handshake_exc is None and self._protocol.state.value >= OPEN.value

    def done(self, now: float) -> bool:
        """Whether the transport has to close the stream now."""
        if self._ending_since is None:
            return False
        return self._protocol.state is CLOSED or now - self._ending_since > CLOSE_S

    def receive(self, data: bytes | bytearray | memoryview, now: float) -> None:
        """Takes bytes that have arrived on the stream. Call `data_to_send` afterwards."""
        protocol = self._protocol
        self._silence.heard()
        if protocol.reader.eof:
            return
        self._began = self._began or bytes(data[:2])
        protocol.receive_data(data)  # type: ignore[arg-type]  # it copies the bytes, so a memoryview works, too
        for event in protocol.events_received():
            if isinstance(event, Frame):
                self._take(event, now)
            elif protocol.handshake_exc is None:
                self.port.open(now)
        self._check(now)

    def look(self, now: float) -> None:
        """Gives the connection up if the server was silent for too long.

        Call it at least once per second, after all bytes that have arrived were passed to `receive`.
        """
        limit_s = silence_s(self.core.travel)
        silent = self._silence.look(now, limit_s)
        if self.port.appetite == 0 or not self.opened or self._ending_since is not None:
            self._silence.heard()
        elif silent:
            self.broke(f"nothing received for {limit_s:g} s", now)

    def receive_eof(self, now: float) -> None:
        """Takes the end of the stream: the server has closed it."""
        self._protocol.receive_eof()
        self._check(now)

    def broke(self, reason: str, now: float, code: int = CloseCode.ABNORMAL_CLOSURE) -> None:
        """Ends the connection because the stream is unusable; nothing more is read from it or written to it.

        Args:
            reason: the cause, for the player.
            now: time in seconds.
            code: close code that the core gets.
        """
        self._protocol.receive_eof()
        self.refused = self.refused or (None if self.opened else self._refusal(reason))
        self.port.lost(code, reason, now)
        self._check(now)

    def data_to_send(self, now: float) -> bytes:
        """Returns the bytes to write to the stream."""
        protocol = self._protocol
        if protocol.state is OPEN:
            for message in self.port.outgoing():
                protocol.send_binary(message)
            if self._second is None and self.core.close_request is not None:
                code, reason = self.core.close_request
                protocol.send_close(code, sendable(reason))
                self._check(now)
        writes = protocol.data_to_send()
        return b"".join(writes) if writes else b""

    def _take(self, frame: Frame, now: float) -> None:
        opcode = frame.opcode
        if opcode is Opcode.BINARY and frame.fin:
            self.port.receive(bytes(frame.data), now)
        elif opcode is Opcode.BINARY or (opcode is Opcode.CONT and self._fragments):
            self._fragments += frame.data
            if frame.fin:
                message = bytes(self._fragments)
                self._fragments.clear()
                self.port.receive(message, now)
        elif opcode is Opcode.TEXT or opcode is Opcode.CONT:
            self._protocol.fail(TEXT, "text message; only binary messages are allowed")
            self.port.lost(TEXT, f"{self.url} is not a Sovereign Netcode server: it sends text", now)

    def _refusal(self, reason: str = "") -> ConnectError | None:
        """Returns the error for a handshake without an HTTP answer; None if there was such an answer."""
        if not self.uri.secure and self._began in (b"", TLS_ALERT):
            reason = f"{reason or 'no answer, the connection was closed'}; if the server speaks TLS, use wss://"
        return ConnectError(f"{self.url}: {reason}") if reason else None

    def _check(self, now: float) -> None:
        """Notifies the core once when the connection ends, and sets `refused` if the handshake failed."""
        protocol = self._protocol
        if protocol.handshake_exc is not None and self.refused is None:
            self.refused = self._refusal() or _refusal(self.url, protocol.handshake_exc)
        if self._ending_since is not None or not (protocol.close_expected() or protocol.state is CLOSED):
            return
        self._ending_since = now
        if self.refused is not None:
            self.port.lost(CloseCode.ABNORMAL_CLOSURE, str(self.refused), now)
        elif protocol.close_rcvd is not None:
            close = protocol.close_rcvd
            self.port.lost(close.code, close.reason or "the server closed the connection", now)
        elif protocol.close_sent is not None:
            close = protocol.close_sent
            self.port.lost(close.code, f"the server broke the WebSocket protocol: {close.reason}", now)
        else:
            self.port.lost(CloseCode.ABNORMAL_CLOSURE, "the connection broke off", now)


def stalled(connection: Connection, now: float) -> None:
    """Gives up a connection whose server has stopped reading, so that unsent bytes do not pile up."""
    connection.broke(f"the server has stopped reading ({UNSENT_MAX >> 10} KiB wait for it)", now, TOO_SLOW)


def unreachable(connection: Connection, error: OSError) -> ConnectError:
    """Returns the error for a stream that could not be opened."""
    uri = connection.uri
    if isinstance(error, ConnectionRefusedError):
        why = f"no server there (connection refused); start one with: sovereign-server --port {uri.port}"
    elif isinstance(error, TimeoutError):
        why = "no answer in time; is the address right, and the port open in the firewall?"
    else:
        why = f"cannot be reached ({error.strerror or error}); is the address right?"
    return ConnectError(f"{connection.url}: {why}")


def insecure(connection: Connection, error: ssl.SSLError) -> ConnectError:
    """Returns the error for a TLS handshake that failed."""
    why = getattr(error, "verify_message", "")
    return ConnectError(untrusted(connection.url, error.reason or str(error), why))


def checked_tls(tls: object) -> ssl.SSLContext | None:
    """Returns the argument `tls` of a program, which is an `ssl.SSLContext`, or None for the system's certificates.

    Raises:
        ValueError: it is something else.
    """
    if tls is not None and not isinstance(tls, ssl.SSLContext):
        raise ValueError(f"tls = {shown(tls)}: must be an ssl.SSLContext, or None for the system's certificates")
    return tls


def parsed(url: object) -> WebSocketURI:
    if not isinstance(url, str):
        raise ConnectError(f"url = {shown(url)}: must be a text; {ADDRESS_HINT}")
    try:
        uri = parse_uri(url)
        urlsplit(url).port  # noqa: B018  # raises ValueError for an invalid port
    except InvalidURI as error:
        raise ConnectError(f"{url!r}: {error.msg}; {ADDRESS_HINT}") from error
    except ValueError as error:
        raise ConnectError(f"{url!r}: {error}; {ADDRESS_HINT}") from error
    return uri


def _refusal(url: str, error: Exception) -> ConnectError:
    """Returns the error for a failed handshake: the reason that our server sent, or that it is another server."""
    answer = str(error)
    if isinstance(error, InvalidStatus):
        response = error.response
        answer = f"HTTP status {response.status_code}"
        kind, retry = (" ".join(response.headers.get_all(name)) for name in ("Content-Type", "Retry-After"))
        if response.status_code in REFUSALS and response.body and kind.startswith("text/plain"):
            text = response.body.decode(errors="replace").strip()[:REASON_MAX]
            wait = float(retry) if retry.isdecimal() and retry.isascii() else -1.0
            return ConnectError(f"{url}: {text}" + (f"; try again in {wait:g} s" if wait >= 0 else ""), wait)
    what = f"something is there, but it is not a Sovereign Netcode server ({answer})"
    return ConnectError(f"{url}: {what}; are host, port and path right?")
