"""The client for asyncio: no task per connection, one timer, and one call per chunk of bytes.

    client = await AsyncClient.connect("ws://localhost:8765", name="Ann")
    async for event in client:
        ...

Time is `time.monotonic()`: an event loop's own clock may be as coarse as a millisecond.
"""

import asyncio
import socket
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any

from client_sdk import addresses
from client_sdk.base import BaseClient, set_link
from client_sdk.events import Event
from client_sdk.pending_events import PendingEvents
from client_sdk.port import READ_BYTES
from client_sdk.transports.common import CLOSE_S, TIMEOUT_S, UNSENT_MAX, ConnectError, timeout_s
from client_sdk.transports.listing import WorldEntry, list_worlds
from client_sdk.view import View
from shared.checks import duration

if TYPE_CHECKING:
    import ssl

    from client_sdk.core import Core
    from client_sdk.netsim.links import Link
    from client_sdk.transports.async_streams import SecondStream
    from shared.behaviours import Behaviour
    from shared.scene import Scene


NUMERIC = socket.NI_NUMERICHOST | socket.NI_NUMERICSERV
"""Flags for the text of an IP address, with the scope of a link-local one."""
WAIT_S_MIN = 0.001
"""Shortest time to the next update, in seconds: timers are no finer."""
WAIT_S_MAX = 1.0
"""Longest time to the next update, in seconds: `Connection.look` has to be called about once per second."""


class AsyncClient(BaseClient):
    """A player on a server, for an event loop: the client predicts and sends by itself.

    Create it with `AsyncClient.connect`. `async for event in client` returns its events and ends after `Left`. If more
    than 10,000 events wait, the oldest are dropped, and `EventsDropped` counts them.

    Args:
        core: the client's state machine.
        url: address of the server.
        before_update: called with the core before each update while the client plays, so that it can set the input.
        tls: certificates to trust for wss://; None: those that the system trusts.
    """

    def __init__(
        self,
        core: "Core",
        url: str,
        before_update: "Callable[[Core], None] | None" = None,
        tls: "ssl.SSLContext | None" = None,
    ) -> None:
        from client_sdk.transports.connection import Connection

        self._tls = tls
        self._redialing: asyncio.Task[None] | None = None
        super().__init__(core)
        self._connection = Connection(url, core)
        self._before_update = before_update
        self._loop = asyncio.get_running_loop()
        self._hosts: dict[str, str] = {}
        """IP addresses of the servers, by name: each is looked up once."""
        self._second: SecondStream | None = None
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0
        self._state = self.core.state
        self._events = PendingEvents()
        self._arrived = asyncio.Event()
        self._answered: asyncio.Future[None] = self._loop.create_future()
        self._gone: asyncio.Future[None] = self._loop.create_future()

    @classmethod
    async def connect(
        cls,
        url: str,
        *,
        name: str = "",
        scene: "Scene | None" = None,
        token: str = "",
        patience_s: float = 30.0,
        timeout: float = TIMEOUT_S,
        tls: "ssl.SSLContext | None" = None,
        link: "str | Link | None" = None,
        before_update: "Callable[[Core], None] | None" = None,
        behaviours: "Iterable[type[Behaviour]]" = (),
    ) -> "AsyncClient":
        """Connects to a server. Returns as soon as the server has answered; the client then joins by itself.

        Args:
            url: address of the server, like ws://localhost:8765.
            name: the player's name, shown to others, up to 32 characters.
            scene: the scene that this program was built for. If the server plays another one, the client gets `Left`.
                None: the client accepts the server's scene.
            token: proves the client's identity, if the server asks for it.
            patience_s: the client tries to reconnect for this long after a lost connection, in seconds; 0: it does not
                reconnect.
            timeout: the longest time to wait for the server's answer, in seconds.
            tls: certificates to trust for wss://; None: those that the system trusts.
            link: a simulated link: the name of a preset, or a `Link`; None: none.
            before_update: called with the core before each update while the client plays, so that it can set the input.
            behaviours: the classes of the game's behaviours, as for `Client.connect`.

        Raises:
            ValueError: an argument is not valid.
            ConnectError: there is no connection; the text says why, and what to do.
        """
        import ssl  # here and not above, so that an import of this class loads little

        from client_sdk.compiling import COMPILER
        from client_sdk.core import Core
        from client_sdk.transports.connection import checked_tls, insecure, unreachable

        COMPILER.begin()
        core = Core(name, scene, token=token, patience_s=patience_s, behaviours=behaviours)
        set_link(core, link)
        client = cls(core, url, before_update, checked_tls(tls))
        connection = client._connection
        try:
            await client._dial(duration(timeout, "timeout"))
        except BaseException as error:
            client._drop()
            if isinstance(error, ssl.SSLError):
                raise insecure(connection, error) from error
            if isinstance(error, OSError) and not isinstance(error, ConnectError):  # a TimeoutError is one
                raise unreachable(connection, error) from error
            raise
        return client

    @classmethod
    async def match(cls, url: str, kind: str, *, seats: int = 1, **options: Any) -> "AsyncClient":
        """Joins a world of a kind, one that has the given properties or a new one, and waits for it if need be.

        The arguments are those of `Client.match`.
        """
        own = addresses.options_of(cls.connect, options)
        return await cls.connect(addresses.at(url, addresses.matching(kind, seats, options)), **own)

    @classmethod
    async def create(cls, url: str, kind: str, *, private: bool = False, **options: Any) -> "AsyncClient":
        """Makes a world of a kind and joins it, with the events `Matched` and `Joined`.

        The arguments are those of `Client.create`.
        """
        own = addresses.options_of(cls.connect, options)
        return await cls.connect(addresses.at(url, addresses.creating(kind, private, options)), **own)

    @classmethod
    async def join(cls, url: str, *, code: str = "", seat: str = "", world: str = "", **options: Any) -> "AsyncClient":
        """Joins a world that exists already. Pass one of `code`, `seat` and `world`.

        The arguments are those of `Client.join`.
        """
        return await cls.connect(addresses.at(url, addresses.joining(code, seat, world)), **options)

    @staticmethod
    async def list_worlds(
        url: str, kind: str | None = None, timeout: float = TIMEOUT_S, *, tls: "ssl.SSLContext | None" = None
    ) -> list[WorldEntry]:
        """Returns the public worlds of a server, as `client_sdk.list_worlds` does, in a thread of its own."""
        return await asyncio.to_thread(list_worlds, url, kind, timeout, tls=tls)

    def view(self) -> View:
        """Returns what to draw now; positions in blocks, velocities in blocks/s."""
        return self.core.view(time.monotonic())

    async def close(self, timeout: float = 1.0) -> None:
        """Leaves the game, and waits at most `timeout` seconds until the server closes. A second call does nothing."""
        self.core.close()
        if self._redialing is not None:
            self._redialing.cancel()
        self._pump(time.monotonic())
        if self._transport is not None:
            await asyncio.wait((self._gone,), timeout=timeout)
        self._drop()

    def __aiter__(self) -> "AsyncClient":
        return self

    async def __anext__(self) -> Event:
        while not self._events:
            if self.core.state == "closed":
                raise StopAsyncIteration
            self._arrived.clear()
            await self._arrived.wait()
        return self._events.next()

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    # -- called by the stream and the timer ------------------------------------------------------------------

    def _made(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        uri = self._connection.uri
        if uri.host not in self._hosts:
            self._hosts[uri.host] = socket.getnameinfo(transport.get_extra_info("peername"), NUMERIC)[0]
        transport.set_write_buffer_limits(UNSENT_MAX)
        if self.core.port.appetite < READ_BYTES:  # with a slow simulated link, unread bytes wait at the server
            transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
        self._pump(time.monotonic())

    def _received(self, data: bytes) -> None:
        now = time.monotonic()
        self._connection.receive(data, now)
        self._read_on()
        self._pump(now)
        if self.core.port.next_update(now) < self._due - WAIT_S_MIN:
            self._schedule(now)

    def _read_on(self) -> None:
        """Pauses reading while the core's `appetite` is 0, and resumes it afterwards."""
        transport, hungry = self._transport, self.core.port.appetite > 0
        if transport is None or hungry == transport.is_reading():
            return
        if hungry:
            transport.resume_reading()
        else:
            transport.pause_reading()

    async def _dial(self, timeout: float) -> None:
        """Connects, and waits at most `timeout` seconds until the server has answered.

        All connections to one server go to the IP address of the first one.
        """
        from client_sdk.transports.async_streams import Stream

        connection, uri = self._connection, self._connection.uri
        async with asyncio.timeout(timeout):
            await self._loop.create_connection(
                lambda: Stream(self, connection),
                self._hosts.get(uri.host, uri.host),
                uri.port,
                ssl=(self._tls or True) if uri.secure else None,
                server_hostname=uri.host if uri.secure else None,
            )
            await self._answered

    async def _redial(self) -> None:
        """Connects anew, once. After a failure, the core decides when to try again."""
        from client_sdk.transports.connection import Connection

        connection = self._connection = Connection(self._connection.address, self.core)
        self._answered, self._gone = self._loop.create_future(), self._loop.create_future()
        try:
            await self._dial(timeout_s(self.core.travel, TIMEOUT_S))
        except OSError as error:  # includes ConnectError, SSLError and TimeoutError
            if connection.refused is None:
                connection.broke(f"no connection ({str(error) or 'no answer in time'})", time.monotonic())
            self._answered.cancel()  # nobody waits for it: an exception in it would be logged as never retrieved
            self._drop()
            self._pump(time.monotonic())
            self._schedule(time.monotonic())

    def _filed(self) -> None:
        self._pump(time.monotonic())

    def _ended(self, error: Exception | None) -> None:
        now = time.monotonic()
        if error is None:
            self._connection.receive_eof(now)
        else:
            self._connection.broke(f"the connection broke off ({error})", now)
        self._transport = None
        self._pump(now)
        self._gone.set_result(None)
        self._schedule(now)

    def _stalled(self) -> None:
        from client_sdk.transports.connection import stalled

        now = time.monotonic()
        stalled(self._connection, now)
        self._drop()
        self._pump(now)

    def _update(self) -> None:
        now = time.monotonic()
        core = self.core
        try:
            core.controls.resolve(core.scene)
            if self._before_update is not None and core.state == "playing":
                self._before_update(core)
        finally:  # asyncio reports an exception of `before_update` or a wrong button; the client goes on
            self._advance(now)

    def _advance(self, now: float) -> None:
        core = self.core
        if self._transport is not None:
            self._connection.look(now)
        core.port.update(now)
        self._change(now)
        self._read_on()
        if core.dials(now):
            self._drop()
            core.reconnect.trying()
            self._redialing = self._loop.create_task(self._redial())
        self._pump(now)
        self._schedule(now)

    def _change(self, now: float) -> None:
        """Opens a second connection, and makes it the first or closes it, as the core says."""
        core, second = self.core, self._second
        if second is None and core.second is not None:
            from client_sdk.transports.async_streams import SecondStream
            from client_sdk.transports.connection import Connection

            connection = Connection(self._connection.address, core, core.second)
            host = self._hosts.get(connection.uri.host, connection.uri.host)
            second = self._second = SecondStream(self, connection, host, self._tls, self._loop)
        if second is None:
            return
        second.pump(now)
        if core.second is second.connection.port:
            return
        self._second = None
        if not second.connection.complete:
            second.drop()
            return
        if self._transport is not None:
            self._transport.abort()
        second.connection.take_place()
        self._connection, self._transport = second.connection, second.transport
        self._gone = self._loop.create_future()
        self._pump(now)

    def _schedule(self, now: float) -> None:
        """Sets the timer for the next update."""
        if self._state != "closed":
            self._due = now + min(max(self.core.port.next_update(now) - now, WAIT_S_MIN), WAIT_S_MAX)
            self._set_timer(self._due - now, self._update)

    def _pump(self, now: float) -> None:
        """Writes what waits, passes events on, and acts on a change of state."""
        connection, core = self._connection, self.core
        if self._transport is not None:  # while it is dialled, the request of the handshake waits
            data = connection.data_to_send(now)
            if data:
                self._transport.write(data)
        for event in core.events():
            self._events.append(event)
            self._arrived.set()
        if not self._answered.done():
            if connection.refused is not None:
                self._answered.set_exception(connection.refused)
            elif connection.opened:
                self._answered.set_result(None)
                self._schedule(now)
        if core.state != self._state:
            self._state = core.state
            if core.state == "closed":
                self._set_timer(CLOSE_S, self._drop)
        if connection.done(now):
            self._drop()
        if self._second is not None:
            self._second.pump(now)

    def _set_timer(self, seconds: float, call: Callable[[], None]) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(seconds, call)

    def _drop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._transport is not None:
            self._transport.abort()
            self._transport = None
        if self._second is not None and self.core.second is None:
            self._second.drop()
            self._second = None
