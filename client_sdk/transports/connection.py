"""A core and a WebSocket put together: bytes of the stream in, bytes of the stream out, no socket.

    connecting   the handshake's request is out
    open         the core sends and receives
    ending       a close frame is out or in, or the stream broke off; the core knows, the stream may last a little
    done         the stream is to be closed

websockets does the framing (its Sans-I/O `ClientProtocol`); this is all that both adapters have in common, so that
they are left with a socket each. Nothing is compressed: no extension is offered.
"""

import math
import ssl
from urllib.parse import urlsplit

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus, InvalidURI
from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import CLOSED, OPEN
from websockets.uri import WebSocketURI, parse_uri

from client_sdk.advice import TLS_ALERT, untrusted
from client_sdk.core import Core
from shared.checks import shown
from shared.messages import MESSAGE_MAX, REASON_MAX, TEXT, TOO_SLOW

UNSENT_MAX = 64 * 1024
"""Bytes that may wait for a server that does not read, some 90 s of 32 inputs each; more end the connection."""
SILENCE_S = 10.0
"""A server that is not heard for so long is gone, or the way to it is: TCP alone may take 15 minutes to say so."""
LOOK_S = 1.0
"""No more than this counts between two looks: a program that was busy or asleep has heard nothing, which is no sign."""
CLOSE_S = 2.0
"""A server that does not finish closing by then is left without its goodbye."""
REFUSALS = (403, 429, 503)
"""HTTP statuses with which a server refuses a client, in words."""
REASON_BYTES_MAX = 123
"""A close frame has room for no more."""


class ConnectError(ConnectionError):
    """There is no connection; the text says why, and what to do about it.

    `wait_s`: the server asks to try again in so many seconds; negative: it does not.
    """

    def __init__(self, text: str, wait_s: float = -1.0) -> None:
        super().__init__(text)
        self.wait_s = wait_s


class Connection:
    """One WebSocket connection of a core.

    Args:
        url: where the server is, like ws://host:8765.

    Raises:
        ConnectError: that is not the address of a server.
    """

    def __init__(self, url: str, core: Core) -> None:
        self.url = url
        self.uri = _parse(url)
        self.core = core
        self.refused: ConnectError | None = None
        """Why there will be no connection; None: there is one, or there may be one."""
        self._protocol = ClientProtocol(self.uri, max_size=MESSAGE_MAX)
        self._protocol.send_request(self._protocol.connect())
        self._began = b""  # how the answer begins
        self._fragments = bytearray()
        self._ending_since: float | None = None
        self._looked = math.inf
        self._silent_s = 0.0

    @property
    def opened(self) -> bool:
        """Whether the handshake has succeeded (however long ago)."""
        return self._protocol.handshake_exc is None and self._protocol.state.value >= OPEN.value

    def done(self, now: float) -> bool:
        """Whether the stream is to be closed."""
        if self._ending_since is None:
            return False
        return self._protocol.state is CLOSED or now - self._ending_since > CLOSE_S

    def receive(self, data: bytes | bytearray | memoryview, now: float) -> None:
        """What has come from the stream. Call `data_to_send` after it."""
        protocol = self._protocol
        self._silent_s = 0.0
        if protocol.reader.eof:
            return
        self._began = self._began or bytes(data[:2])
        protocol.receive_data(data)  # type: ignore[arg-type]  # it appends, so a view does as well
        for event in protocol.events_received():
            if isinstance(event, Frame):
                self._take(event, now)
            elif protocol.handshake_exc is None:
                self.core.open(now)
        self._check(now)

    def look(self, now: float) -> None:
        """Gives the connection up where the server has been silent for long. Call it every second or more often, when
        all that has come has been taken in."""
        self._silent_s += min(max(now - self._looked, 0.0), LOOK_S)
        self._looked = now
        if self.core.appetite == 0 or not self.opened or self._ending_since is not None:
            self._silent_s = 0.0
        elif self._silent_s > SILENCE_S:
            self.broke(f"nothing heard for {SILENCE_S:g} s", now)

    def receive_eof(self, now: float) -> None:
        """The stream has come to its end."""
        self._protocol.receive_eof()
        self._check(now)

    def broke(self, reason: str, now: float, code: int = CloseCode.ABNORMAL_CLOSURE) -> None:
        """The stream is unusable: nothing more will be read from it or written to it."""
        self._protocol.receive_eof()
        self.refused = self.refused or (None if self.opened else self._refusal(reason))
        self.core.lost(code, reason, now)
        self._check(now)

    def data_to_send(self, now: float) -> bytes:
        """What to write to the stream."""
        protocol = self._protocol
        if protocol.state is OPEN:
            for message in self.core.outgoing():
                protocol.send_binary(message)
            if self.core.close_request is not None:
                code, reason = self.core.close_request
                protocol.send_close(code, reason.encode()[:REASON_BYTES_MAX].decode(errors="ignore"))
                self._check(now)
        writes = protocol.data_to_send()
        return b"".join(writes) if writes else b""

    def _take(self, frame: Frame, now: float) -> None:
        opcode = frame.opcode
        if opcode is Opcode.BINARY and frame.fin:
            self.core.receive(bytes(frame.data), now)
        elif opcode is Opcode.BINARY or (opcode is Opcode.CONT and self._fragments):
            self._fragments += frame.data
            if frame.fin:
                message = bytes(self._fragments)
                self._fragments.clear()
                self.core.receive(message, now)
        elif opcode is Opcode.TEXT or opcode is Opcode.CONT:
            self._protocol.fail(TEXT, "text message: binary ones only")
            self.core.lost(TEXT, f"{self.url} is not a Sovereign Netcode server: it sends text", now)

    def _refusal(self, reason: str = "") -> ConnectError | None:
        """Why there was no answer, or none of HTTP; None: there was one."""
        if not self.uri.secure and self._began in (b"", TLS_ALERT):
            reason = f"{reason or 'no answer, the connection was closed'}; if the server speaks TLS, use wss://"
        return ConnectError(f"{self.url}: {reason}") if reason else None

    def _check(self, now: float) -> None:
        """Tells the core, at once, that it is over; and why there is no connection, if it never began."""
        protocol = self._protocol
        if protocol.handshake_exc is not None and self.refused is None:
            self.refused = self._refusal() or _refusal(self.url, protocol.handshake_exc)
        if self._ending_since is not None or not (protocol.close_expected() or protocol.state is CLOSED):
            return
        self._ending_since = now
        if self.refused is not None:
            self.core.lost(CloseCode.ABNORMAL_CLOSURE, str(self.refused), now)
        elif protocol.close_rcvd is not None:
            close = protocol.close_rcvd
            self.core.lost(close.code, close.reason or "the server closed the connection", now)
        elif protocol.close_sent is not None:
            close = protocol.close_sent
            self.core.lost(close.code, f"the server broke the WebSocket protocol: {close.reason}", now)
        else:
            self.core.lost(CloseCode.ABNORMAL_CLOSURE, "the connection broke off", now)


def stalled(connection: Connection, now: float) -> None:
    """The server has stopped reading: gives the connection up rather than let what is unsent pile up."""
    connection.broke(f"the server has stopped reading ({UNSENT_MAX >> 10} KiB wait for it)", now, TOO_SLOW)


def unreachable(connection: Connection, error: OSError) -> ConnectError:
    """An error for a stream that could not be opened."""
    uri = connection.uri
    if isinstance(error, ConnectionRefusedError):
        why = f"no server there (connection refused); start one with: sovereign-server --port {uri.port}"
    elif isinstance(error, TimeoutError):
        why = "no answer in time; is the address right, and the port open in the firewall?"
    else:
        why = f"cannot be reached ({error.strerror or error}); is the address right?"
    return ConnectError(f"{connection.url}: {why}")


def insecure(connection: Connection, error: ssl.SSLError) -> ConnectError:
    """An error for a stream over which no TLS could be spoken."""
    why = getattr(error, "verify_message", "")
    return ConnectError(untrusted(connection.url, error.reason or str(error), why))


def checked_tls(tls: object) -> ssl.SSLContext | None:
    """The trust that a program has given, or None for the system's.

    Raises:
        ValueError: it is something else.
    """
    if tls is not None and not isinstance(tls, ssl.SSLContext):
        raise ValueError(f"tls = {shown(tls)}: must be an ssl.SSLContext, or None to trust whom the system trusts")
    return tls


def _parse(url: object) -> WebSocketURI:
    hint = "a server's address looks like ws://localhost:8765"
    if not isinstance(url, str):
        raise ConnectError(f"url = {shown(url)}: must be a text; {hint}")
    try:
        uri = parse_uri(url)
        urlsplit(url).port  # noqa: B018  # raises for a port that is none
    except InvalidURI as error:
        raise ConnectError(f"{url!r}: {error.msg}; {hint}") from error
    except ValueError as error:
        raise ConnectError(f"{url!r}: {error}; {hint}") from error
    return uri


def _refusal(url: str, error: Exception) -> ConnectError:
    """Why a handshake has failed: what a server of ours says, or that there is none."""
    answer = str(error)
    if isinstance(error, InvalidStatus):
        response = error.response
        answer = f"HTTP status {response.status_code}"
        kind, retry = (" ".join(response.headers.get_all(name)) for name in ("Content-Type", "Retry-After"))
        if response.status_code in REFUSALS and response.body and kind.startswith("text/plain"):
            said = response.body.decode(errors="replace").strip()[:REASON_MAX]
            wait = float(retry) if retry.isdecimal() and retry.isascii() else -1.0
            return ConnectError(f"{url}: {said}" + (f"; try again in {wait:g} s" if wait >= 0 else ""), wait)
    what = f"something is there, but it is not a Sovereign Netcode server ({answer})"
    return ConnectError(f"{url}: {what}; are host, port and path right?")
