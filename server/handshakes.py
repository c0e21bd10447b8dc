"""TLS in front of a gateway: a connection is counted from the moment it is accepted.

asyncio's own servers tell of a connection once its handshake is over. Who never finishes one is nobody's until then:
it has a descriptor, and up to 0.3 MB, that no limit counts. So connections are accepted here, and whoever counts them
is asked first.
"""

import asyncio
import socket
import ssl
from abc import abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any

AGAIN_S = 1.0
"""Where nothing can be accepted (no descriptor is left, for one), the next try is so much later."""


class Guest(asyncio.Protocol):
    """The protocol of one connection, which hears of its transport once the handshake is over."""

    @abstractmethod
    def enter(self, address: str) -> bool:
        """Counts the connection; False: it is to be dropped."""

    @abstractmethod
    def leave(self) -> None:
        """The connection is gone; after the first time, nothing happens."""


class Handshakes:
    """Accepts connections and has them shake hands.

    Args:
        guest: makes the protocol of a connection.
        context: the server's TLS.
        limit_s: for one handshake.
    """

    def __init__(self, guest: Callable[[], Guest], context: ssl.SSLContext, limit_s: float) -> None:
        self._guest, self._context, self._limit_s = guest, context, limit_s
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self.sockets: list[socket.socket] = []
        """Those that listen."""

    async def listen(self, host: str, port: int, backlog: int) -> None:
        """Begins, on all addresses of the host.

        Raises:
            OSError: one of them cannot be used.
        """
        found = await self._loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        try:
            for family, _, _, _, address in dict.fromkeys(found):
                self.sockets.append(socket.create_server(address, family=family, backlog=backlog))
                self.sockets[-1].setblocking(False)
        except OSError:
            self.close()
            raise
        for listener in self.sockets:
            self._go(self._accept(listener))

    def close(self) -> None:
        """No further connection; handshakes under way are cut off."""
        for task in self._tasks:
            task.cancel()
        for listener in self.sockets:
            listener.close()

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                sock, peer = await self._loop.sock_accept(listener)
            except ConnectionError:  # gone already
                continue
            except OSError as error:
                self._loop.call_exception_handler({"message": "cannot accept a connection", "exception": error})
                await asyncio.sleep(AGAIN_S)
                continue
            guest = self._guest()
            if guest.enter(str(peer[0])):
                self._go(self._shake(sock, guest))
            else:
                sock.close()

    async def _shake(self, sock: socket.socket, guest: Guest) -> None:
        try:
            await self._loop.connect_accepted_socket(
                lambda: guest, sock, ssl=self._context, ssl_handshake_timeout=self._limit_s
            )
        except BaseException as error:
            guest.leave()  # asyncio closes the socket
            if not isinstance(error, OSError):  # of TLS and of time, too: the peer's affair
                raise

    def _go(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
