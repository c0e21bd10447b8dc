"""The asyncio protocols of the connections of an `AsyncClient`."""

import asyncio
import ssl
import time
from typing import TYPE_CHECKING, cast

from client_sdk.transports.common import TIMEOUT_S, UNSENT_MAX
from client_sdk.transports.connection import Connection

if TYPE_CHECKING:
    from client_sdk.async_client import AsyncClient


class Stream(asyncio.Protocol):
    """The asyncio protocol of one connection of a client. It ignores calls after the client has reconnected."""

    def __init__(self, client: "AsyncClient", connection: Connection) -> None:
        self._client, self._connection = client, connection

    @property
    def _current(self) -> bool:
        return self._client._connection is self._connection

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._client._made(cast("asyncio.Transport", transport))  # a transport of uvloop is not a subclass of it

    def data_received(self, data: bytes) -> None:
        if self._current:
            self._client._received(data)

    def connection_lost(self, error: Exception | None) -> None:
        if self._current:
            self._client._ended(error)

    def pause_writing(self) -> None:
        if self._current:
            self._client._stalled()


class SecondStream(Stream):
    """The asyncio protocol of a second connection. Once it has taken the place of the first, it is one like that.

    Args:
        client: the client.
        connection: the WebSocket.
        host: IP address or name of the server.
        tls: as for `AsyncClient`.
        loop: the event loop.
    """

    def __init__(
        self,
        client: "AsyncClient",
        connection: Connection,
        host: str,
        tls: ssl.SSLContext | None,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        super().__init__(client, connection)
        self.connection = connection
        self.transport: asyncio.Transport | None = None
        self._dialing = loop.create_task(self._dial(host, tls, loop))

    def pump(self, now: float) -> None:
        """Writes what waits."""
        if self.transport is not None:
            self.connection.look(now)
            data = self.connection.data_to_send(now)
            if data:
                self.transport.write(data)

    def drop(self) -> None:
        """Closes the connection."""
        self._dialing.cancel()
        if self.transport is not None:
            self.transport.abort()

    async def _dial(self, host: str, tls: ssl.SSLContext | None, loop: asyncio.AbstractEventLoop) -> None:
        uri = self.connection.uri
        try:
            async with asyncio.timeout(TIMEOUT_S):
                await loop.create_connection(
                    lambda: self,
                    host,
                    uri.port,
                    ssl=(tls or True) if uri.secure else None,
                    server_hostname=uri.host if uri.secure else None,
                )
        except OSError as error:  # includes SSLError and TimeoutError
            self._broke(f"no connection ({str(error) or 'no answer in time'})")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self.transport.set_write_buffer_limits(UNSENT_MAX)
        self.pump(time.monotonic())

    def data_received(self, data: bytes) -> None:
        if not self.connection.second:
            super().data_received(data)
        else:
            now = time.monotonic()
            self.connection.receive(data, now)
            self._client._change(now)

    def connection_lost(self, error: Exception | None) -> None:
        self.transport = None
        if not self.connection.second:
            super().connection_lost(error)
        else:
            self._broke("the connection broke off")

    def pause_writing(self) -> None:
        if not self.connection.second:
            super().pause_writing()
        else:
            self._broke("the server has stopped reading")

    def _broke(self, reason: str) -> None:
        now = time.monotonic()
        self.connection.broke(reason, now)
        self._client._change(now)
