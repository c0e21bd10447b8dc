"""What a game developer holds: one object in the game's own loop, without a thread and without an event loop.

with Client.connect("ws://localhost:8765", name="Ann") as client:
    while not client.closed:
        for event in client.poll():
            print(event)
        client.set_input(1, 0, jump=pressed("space"))
        client.update()
        draw(client.view())
"""

import ssl
import time
from types import TracebackType
from typing import Any, Protocol

from client_sdk.base import BaseClient
from client_sdk.compiling import COMPILER
from client_sdk.events import Event
from client_sdk.linked import LinkedCore
from client_sdk.links import Path
from client_sdk.picture import View
from client_sdk.transports.connection import Connection, checked_tls
from client_sdk.transports.polling import PollingTransport
from shared.checks import duration, finite
from shared.scene import Scene

PATIENCE_S = 30.0
"""A server that is started anew is back by then."""


class Transport(Protocol):
    """What carries a client's messages. None of these block, but for `close`."""

    def poll(self, now: float) -> None:
        """Hands what has arrived to the core, and sends."""

    def send(self, now: float) -> None:
        """Sends what the core wants sent."""

    def close(self, timeout: float) -> None:
        """Sends, and ends within so many seconds."""


class Client(BaseClient):
    """A player on a server.

    Call `poll`, `set_input`, `update` and `view` once per frame, at any frame rate. Times are float seconds of
    `time.monotonic()`, unless every call is given another clock's; left out, it is now.

    Args:
        core: the client's state; read it for whatever is not offered here.
        transport: what carries its messages.
    """

    def __init__(self, core: LinkedCore, transport: Transport) -> None:
        super().__init__(core)
        self._transport = transport

    @classmethod
    def connect(
        cls,
        url: str,
        *,
        name: str = "",
        scene: Scene | None = None,
        token: str = "",
        patience_s: float = PATIENCE_S,
        timeout: float = 5.0,
        tls: ssl.SSLContext | None = None,
        link: str | Path | None = None,
    ) -> "Client":
        """Connects to a server, and returns once it has answered; joining goes on in `poll` and `update`.

        Args:
            url: where the server is, like ws://localhost:8765.
            name: shown to others, up to 32 characters.
            scene: the scene this program was built for; another one on the server ends in `Left`. None: take its.
            token: proves who this is, where the server asks for one.
            patience_s: after a lost connection, it tries to come back for so long; 0: not at all.
            timeout: the longest that this may block, in seconds.
            tls: whom to trust for wss://; None: whom the system trusts.
            link: see `link`.

        Raises:
            ValueError: there is no such link; or the name or the token is no text that UTF-8 can hold.
            ConnectError: there is no connection; the text says why and what to do.
        """
        COMPILER.begin()
        core = LinkedCore(name, scene, token=token, patience_s=patience_s)
        core.link = link
        return cls(core, PollingTransport(Connection(url, core), duration(timeout, "timeout"), checked_tls(tls)))

    def poll(self, now: float | None = None) -> list[Event]:
        """What has happened since the last call, in order: `Joined`, `Corrected`, `Left`, ... Never blocks."""
        self._transport.poll(_time(now))
        return self.core.events()

    def edit(self, x: int, y: int, z: int, kind: int) -> int:
        """Places (`kind` 1 to 255) or removes (0) the block (x, y, z) with the next tick, at once in the own picture.

        The server's word comes as an `Answered` event with the number that is returned here; where it says no (out of
        reach, somebody is in the way, too many), the picture goes back by itself.

        Raises:
            RuntimeError: the client has not joined.
            TypeError: something is not a whole number.
            ValueError: it is out of range.
        """
        return self.core.edit(x, y, z, kind)

    def command(self, name: str, data: Any = None) -> int:
        """Asks the game's rules for something: what `name` and `data` mean is theirs.

        Their word comes as an `Answered` event with the number that is returned here.

        Raises:
            RuntimeError: the client has not joined.
            ValueError: the name or the data are too long (32 characters, 1,024 bytes), or no MessagePack.
        """
        return self.core.command(name, data)

    def update(self, now: float | None = None) -> None:
        """Predicts up to now and sends the inputs of the ticks that have come."""
        now = _time(now)
        self.core.update(now)
        self._transport.send(now)

    def view(self, now: float | None = None) -> View:
        """What to draw now; positions in blocks."""
        return self.core.view(_time(now))

    def close(self, timeout: float = 1.0) -> None:
        """Says goodbye, and waits for the server to do so for at most `timeout` seconds. Again: does nothing."""
        self.core.close()
        self._transport.close(timeout)

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _time(now: float | None) -> float:
    """The time of a call: the one that was handed in, or else that of the clock."""
    return time.monotonic() if now is None else finite(now, "now")
