"""The client for a game's own loop: one object, without a thread and without an event loop.

with Client.connect("ws://localhost:8765", name="Ann") as client:
    while not client.closed:
        for event in client.poll():
            print(event)
        client.set_input(1, 0, jump=pressed("space"))
        client.update()
        draw(client.view())
"""

import time
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

from client_sdk import addresses
from client_sdk.base import BaseClient, set_link
from client_sdk.events import Event
from client_sdk.view import View
from shared.checks import duration, finite

if TYPE_CHECKING:
    import ssl

    from client_sdk.core import Core
    from client_sdk.netsim.links import Link
    from shared.behaviours import Behaviour
    from shared.scene import Scene


PATIENCE_S = 30.0
"""Time for which a client tries to reconnect, in seconds: enough for a server to restart."""


class Transport(Protocol):
    """The code that moves a client's messages. Only `close` may block."""

    def poll(self, now: float) -> None:
        """Hands the messages that have arrived to the core, then sends the core's messages."""

    def send(self, now: float) -> None:
        """Sends the messages that wait in the core."""

    def close(self, timeout: float) -> None:
        """Sends the messages that wait, and closes the connection within `timeout` seconds."""


class Client(BaseClient):
    """A player on a server.

    Call `poll`, `set_input`, `update` and `view` once per frame, at any frame rate. `playing` becomes true only if both
    `poll` and `update` are called: `poll` receives the world, `update` measures the server's time and starts the play.

    `now` is a time in float seconds; left out, it is `time.monotonic()`. A program may use another clock, if it passes
    `now` to every call.

    Args:
        core: the client's state machine; read it for what this class does not offer.
        transport: moves the client's messages.
    """

    def __init__(self, core: "Core", transport: Transport) -> None:
        super().__init__(core)
        self._transport = transport

    @classmethod
    def connect(
        cls,
        url: str,
        *,
        name: str = "",
        scene: "Scene | None" = None,
        token: str = "",
        patience_s: float = PATIENCE_S,
        timeout: float = 5.0,
        tls: "ssl.SSLContext | None" = None,
        link: "str | Link | None" = None,
        behaviours: "Iterable[type[Behaviour]]" = (),
    ) -> "Client":
        """Connects to a server. Returns as soon as the server has answered; `poll` and `update` then join the game.

        Args:
            url: address of the server, like ws://localhost:8765.
            name: the player's name, shown to others, up to 32 characters.
            scene: the scene that this program was built for. If the server plays another one, the client gets `Left`.
                None: the client accepts the server's scene.
            token: proves the client's identity, if the server asks for it.
            patience_s: the client tries to reconnect for this long after a lost connection, in seconds; 0: it does not
                reconnect.
            timeout: the longest time that this call may block, in seconds.
            tls: certificates to trust for wss://; None: those that the system trusts.
            link: a simulated link: the name of a preset, or a `Link`; None: none. `Client.link` changes it later.
            behaviours: the classes of the game's behaviours, which the client predicts (`shared.behaviours`). If one is
                missing or differs from the server's, the client gets `Left` with its name.

        Raises:
            ValueError: an argument is not valid: no preset has the name in `link`, or UTF-8 cannot hold the name or the
                token, or a duration is negative, for example.
            ConnectError: there is no connection; the text says why, and what to do.
        """
        from client_sdk.compiling import COMPILER  # here, so that an import of this class loads little
        from client_sdk.core import Core
        from client_sdk.transports.connection import Connection, checked_tls
        from client_sdk.transports.polling import PollingTransport

        COMPILER.begin()
        core = Core(name, scene, token=token, patience_s=patience_s, behaviours=behaviours)
        set_link(core, link)
        return cls(core, PollingTransport(Connection(url, core), duration(timeout, "timeout"), checked_tls(tls)))

    @classmethod
    def match(cls, url: str, kind: str, *, seats: int = 1, **options: Any) -> "Client":
        """Joins a world of a kind, one that has the given properties or a new one, and waits for it if need be.

        Returns as soon as the server has answered. The events are `Waiting` as long as there is no world, `Matched`,
        and `Joined`.

        Args:
            url: address of the server, like ws://localhost:8765.
            kind: the kind of world.
            seats: number of seats to reserve; `client.seats` has those beyond the first.
            options: the arguments of `connect`. All others are properties of the world: texts, whole numbers, or truth
                values, as in mode="2v2".

        Raises:
            ValueError: an argument is not valid.
            ConnectError: there is no connection; the text says why, and what to do.
        """
        own = addresses.options_of(cls.connect, options)
        return cls.connect(addresses.at(url, addresses.matching(kind, seats, options)), **own)

    @classmethod
    def create(cls, url: str, kind: str, *, private: bool = False, **options: Any) -> "Client":
        """Makes a world of a kind and joins it, with the events `Matched` and `Joined`.

        Args:
            url: address of the server, like ws://localhost:8765.
            kind: the kind of world.
            private: whether only those with the world's code (`client.code`) may join.
            options: the arguments of `connect`. All others are properties of the world, as for `match`.

        Raises:
            ValueError: an argument is not valid.
            ConnectError: there is no connection; the text says why, and what to do.
        """
        own = addresses.options_of(cls.connect, options)
        return cls.connect(addresses.at(url, addresses.creating(kind, private, options)), **own)

    @classmethod
    def join(cls, url: str, *, code: str = "", seat: str = "", world: str = "", **options: Any) -> "Client":
        """Joins a world that exists already. Pass one of `code`, `seat` and `world`.

        Args:
            url: address of the server, like ws://localhost:8765.
            code: the code of a private world.
            seat: a reserved seat: one of a friend's `client.seats`.
            world: the name of a world.
            options: the arguments of `connect`.

        Raises:
            ValueError: an argument is not valid.
            TypeError: `connect` has no such argument.
            ConnectError: there is no connection; the text says why, and what to do.
        """
        return cls.connect(addresses.at(url, addresses.joining(code, seat, world)), **options)

    def poll(self, now: float | None = None) -> list[Event]:
        """Reads what has arrived. Returns the events since the last call, oldest first. Never blocks."""
        self._transport.poll(_time(now))
        return self.core.events()

    def update(self, now: float | None = None) -> None:
        """Predicts every tick that is due, and sends its input. Starts the play once the world has arrived.

        Raises:
            ValueError: before the scene was known, `set_input` was called with a button or an aim that it does not
                have. This is raised once.
        """
        now = _time(now)
        self.core.controls.resolve(self.core.scene)
        self.core.port.update(now)
        self._transport.send(now)

    def view(self, now: float | None = None) -> View:
        """Returns what to draw now; positions in blocks, velocities in blocks/s."""
        return self.core.view(_time(now))

    def close(self, timeout: float = 1.0) -> None:
        """Leaves the game, and waits at most `timeout` seconds until the server closes. A second call does nothing."""
        self.core.close()
        self._transport.close(timeout)

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _time(now: float | None) -> float:
    """Returns the time of a call in seconds: `now`, or `time.monotonic()` if it was left out."""
    return time.monotonic() if now is None else finite(now, "now")
