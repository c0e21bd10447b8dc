"""The transport of a client in a browser: the browser's own WebSocket. Nothing blocks, and there is no thread.

    opening   the browser connects; what the core sends waits
    open      messages go both ways
    (none)    the core decides when to connect again

A page cannot read why a server refused a connection, and it cannot let bytes wait in the socket: messages that the core
does not want yet (`Port.appetite`) wait here.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol
from urllib.parse import urlsplit, urlunsplit

from client_sdk.core import Core
from client_sdk.handover import Handover
from client_sdk.port import Port
from client_sdk.transports.common import (
    ADDRESS_HINT,
    BROKE_OFF,
    UNSENT_MAX,
    ConnectError,
    Silence,
    sendable,
    silence_s,
    timeout_s,
)
from shared.checks import shown
from shared.messages import TEXT, TOO_SLOW

CLOSED_BY_US = 1000
"""Close code that a page may send, besides 3000 to 4999."""
OWN_CODES = range(3000, 5000)
"""Further close codes that a page may send."""


class Socket(Protocol):
    """A WebSocket of the browser, or of Node.js."""

    @property
    def bufferedAmount(self) -> int:  # noqa: N802 - the browser's name
        """The bytes that wait to be sent."""
        ...

    def send(self, data: Any) -> None:
        """Sends a binary message."""

    def close(self, code: int, reason: str) -> None:
        """Closes the connection."""


class Listener(Protocol):
    """The target of a socket's events."""

    def opened(self) -> None:
        """Takes the end of the handshake."""

    def received(self, data: bytes | str) -> None:
        """Takes a message."""

    def closed(self, code: int, reason: str) -> None:
        """Takes the end of the connection, or the failure of the handshake."""


OpenSocket = Callable[[str, Listener], Socket]
"""A function that opens a socket to an address. It raises an `OSError` if the browser does not allow it."""


class BrowserTransport:
    """The connections of one core.

    Args:
        core: the client's state machine.
        url: address of the server, like ws://host:8765; its path is the first one of the core.
        open_socket: opens a socket.
        timeout: longest time of a handshake, in seconds.
        clock: returns the time of events, on the clock of the calls' `now`.

    Raises:
        ConnectError: `url` is not the address of a server.
    """

    def __init__(
        self,
        core: Core,
        url: str,
        open_socket: OpenSocket,
        timeout: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._core, self._open_socket, self._timeout, self._clock = core, open_socket, timeout, clock
        self._address = checked_address(url)
        parts = urlsplit(url)
        first = urlunsplit(("", "", parts.path or "/", parts.query, ""))
        core.travel.path = core.travel.path or first
        self._line: _Line | None = None
        self._second: _Line | None = None
        self._dial(clock())

    def poll(self, now: float) -> None:
        """Passes on what waits, and connects anew if it is time to."""
        core, line = self._core, self._line
        if core.dials(now):
            core.reconnect.trying()
            self._dial(now)
        elif line is not None:
            self._look(line, now)
        self.send(now)

    def send(self, now: float) -> None:
        """Sends the messages that wait in the core."""
        self._change(now)
        core, line = self._core, self._line
        if line is None or not line.open:
            if line is not None and core.state == "closed":
                self._dropped(line, CLOSED_BY_US, "")
            return
        for message in core.port.outgoing():
            line.socket.send(message)
        if core.close_request is not None:
            code, reason = core.close_request
            self._dropped(line, code, reason)
            core.port.lost(code, reason, now)
        elif line.socket.bufferedAmount > UNSENT_MAX:
            text = f"the server has stopped reading ({UNSENT_MAX >> 10} KiB wait for it)"
            self._ended(line, TOO_SLOW, text, now)

    def close(self, timeout: float) -> None:
        """Sends what waits and closes the connection. The browser finishes it."""
        self.send(self._clock())

    def _dial(self, now: float) -> None:
        if self._line is not None:
            self._dropped(self._line, CLOSED_BY_US, "")
        until = now + timeout_s(self._core.travel, self._timeout)
        line = _Line(self, self._core, self._clock, until)
        if self._open(line, self._core.travel.server, now):
            self._line = line

    def _open(self, line: "_Line", server: str, now: float) -> bool:
        """Opens the socket of a line. Returns whether there is one.

        Args:
            line: the line.
            server: address of the server; empty: the one that the program has named.
            now: local time in seconds.
        """
        if server and self._address.startswith("wss:"):
            server = "wss:" + server.partition(":")[2]  # an address cannot switch TLS off
        line.url = f"{server or self._address}{self._core.travel.path}"
        try:
            line.socket = self._open_socket(line.url, line)
        except OSError as error:
            line.port.lost(BROKE_OFF, f"{line.url}: {error}", now)
            return False
        return True

    def _look(self, line: "_Line", now: float) -> None:
        """Reads what waits, and gives a server up that does not answer."""
        if not line.open and now > line.until:
            self._ended(line, BROKE_OFF, f"{line.url}: no answer in time", now)
            return
        line.read(now)
        limit_s = silence_s(self._core.travel)
        silent = line.silence.look(now, limit_s)
        if line.port.appetite == 0 or not line.open:
            line.silence.heard()
        elif silent:
            self._ended(line, BROKE_OFF, f"nothing received for {limit_s:g} s", now)

    def _change(self, now: float) -> None:
        """Opens a second connection, and makes it the first or closes it, as the core says."""
        core, second = self._core, self._second
        handover = core.handover
        if second is None and core.second is not None and handover is not None:
            second = _Line(self, core, self._clock, now + self._timeout, core.second, handover)
            if self._open(second, handover.address, now):
                self._second = second
        if second is None or self._second is None:
            return
        if core.second is second.port:
            self._look(second, now)
        if core.second is second.port and second.open:
            for message in second.port.outgoing():
                second.socket.send(message)
        elif core.second is not second.port:
            self._second = None
            if second.handover is not None and second.handover.complete:
                if self._line is not None:
                    self._dropped(self._line, CLOSED_BY_US, "")
                second.second, self._line = None, second
            else:
                self._dropped(second, CLOSED_BY_US, "")

    def _ended(self, line: "_Line", code: int, reason: str, now: float) -> None:
        """Takes the end of a connection, which the core is notified of."""
        if line in (self._line, self._second):
            port = line.port
            self._dropped(line, code, reason)
            port.lost(code, reason, now)

    def _dropped(self, line: "_Line", code: int, reason: str) -> None:
        """Closes a socket and ignores it from then on."""
        if line is self._line:
            self._line = None
        if line is self._second:
            self._second = None
        line.over = True
        allowed = code == CLOSED_BY_US or code in OWN_CODES
        line.socket.close(code if allowed else CLOSED_BY_US, sendable(reason))


class _Line:
    """One socket and its messages."""

    socket: Socket
    url: str

    def __init__(
        self,
        transport: BrowserTransport,
        core: Core,
        clock: Callable[[], float],
        until: float,
        second: Port | None = None,
        handover: Handover | None = None,
    ) -> None:
        self._transport, self._core, self._clock = transport, core, clock
        self.second, self.handover = second, handover
        self.until = until
        """Local time at which the handshake has failed, in seconds."""
        self.open = self.over = False
        self.silence = Silence()
        self._inbox: deque[bytes] = deque()

    @property
    def port(self) -> Port:
        """The side of the core that this connection talks to."""
        return self._core.port if self.second is None else self.second

    def opened(self) -> None:
        if self.over:
            return
        now = self._clock()
        self.open = True
        self.port.open(now)
        self._transport.send(now)

    def received(self, data: bytes | str) -> None:
        if self.over:
            return
        now = self._clock()
        if isinstance(data, str):
            url = self.url
            self._transport._ended(self, TEXT, f"{url} is not a Sovereign Netcode server: it sends text", now)
            return
        self.silence.heard()
        self._inbox.append(data)
        self.read(now)
        self._transport.send(now)

    def closed(self, code: int, reason: str) -> None:
        if self.over:
            return
        now = self._clock()
        while self._inbox and not self.over:
            self.port.receive(self._inbox.popleft(), now)
        if not self.open:
            url = self.url
            reason = f"{url}: no connection; is the address right, is a server there, and does it allow this page?"
        self._transport._ended(self, code, reason or "the connection broke off", now)

    def read(self, now: float) -> None:
        """Passes on the messages that the core wants now."""
        while self._inbox and not self.over and self.port.appetite:
            self.port.receive(self._inbox.popleft(), now)


def checked_address(url: object) -> str:
    """Returns scheme, host and port of a server's address.

    Raises:
        ConnectError: it is no address.
    """
    try:
        parts = urlsplit(url if isinstance(url, str) else "")
        if parts.scheme in ("ws", "wss") and parts.hostname and parts.port != 0:
            return f"{parts.scheme}://{parts.netloc}"
    except ValueError:
        pass
    raise ConnectError(f"url = {shown(url)}: must be an address; {ADDRESS_HINT}")


def browser_socket(url: str, listener: Listener) -> Socket:
    """Opens a WebSocket of the browser, from Python in Pyodide.

    Raises:
        OSError: the browser does not allow this address.
    """
    import js  # type: ignore[import-not-found]
    from pyodide.ffi import JsException, create_proxy, to_js  # type: ignore[import-not-found]

    try:
        socket = js.WebSocket.new(url)
    except JsException as error:
        raise OSError(str(error)) from error
    socket.binaryType = "arraybuffer"

    def message(event: Any) -> None:
        data = event.data
        listener.received(data if isinstance(data, str) else data.to_bytes())

    def close(event: Any) -> None:
        listener.closed(int(event.code), str(event.reason))
        for proxy in proxies:
            proxy.destroy()

    handlers = {"open": lambda _: listener.opened(), "message": message, "close": close}
    proxies = []
    for name, handler in handlers.items():
        proxy = create_proxy(handler)
        proxies.append(proxy)
        setattr(socket, f"on{name}", proxy)
    return _JsSocket(socket, to_js)


OPEN = 1
"""Value of `readyState` while a WebSocket is connected."""


class _JsSocket:
    """A JavaScript WebSocket as `Socket`."""

    def __init__(self, socket: Any, to_js: Callable[[Any], Any]) -> None:
        self._socket, self._to_js = socket, to_js

    @property
    def bufferedAmount(self) -> int:  # noqa: N802 - the browser's name
        return int(self._socket.bufferedAmount)

    def send(self, data: bytes) -> None:
        """Sends a binary message; the browser copies it. It is lost if the connection has just broken off."""
        if self._socket.readyState == OPEN:
            self._socket.send(self._to_js(data))

    def close(self, code: int, reason: str) -> None:
        """Closes the connection."""
        self._socket.close(code, reason)
