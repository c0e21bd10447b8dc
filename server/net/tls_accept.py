"""TLS in front of a gateway: a connection is counted from the moment it is accepted.

asyncio's own servers tell of a connection once its handshake is over. Who never finishes one is nobody's until then:
it has a descriptor, and up to 0.3 MB, that no limit counts. So connections are accepted here, and whoever counts them
is asked first.
"""

import asyncio
import socket
import ssl
from abc import abstractmethod
from collections.abc import Callable

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
        """What accepts, and every handshake that has begun: cancelled before, it would have no end of its own."""
        self._closed = False
        self.sockets: list[socket.socket] = []
        """Those that listen."""

    def listen(self, sockets: list[socket.socket]) -> None:
        """Begins to accept on sockets that listen already and do not block."""
        self.sockets = sockets
        for listener in sockets:
            self._keep(self._loop.create_task(self._accept(listener)))

    def close(self) -> None:
        """No further connection; handshakes under way are cut off."""
        self._closed = True
        for task in self._tasks:
            task.cancel()
        for listener in self.sockets:
            listener.close()

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                sock, peer = await self._loop.sock_accept(listener)
            except ConnectionError:  # gone already
                await asyncio.sleep(0)
                continue
            except OSError as error:
                self._loop.call_exception_handler({"message": "cannot accept a connection", "exception": error})
                await asyncio.sleep(AGAIN_S)
                continue
            guest = self._guest()
            if guest.enter(str(peer[0])):
                self._loop.create_task(self._shake(sock, guest))  # is kept once it has begun
            else:
                sock.close()
            await asyncio.sleep(0)  # asyncio's `sock_accept` does not wait while there is one: others have their turn

    async def _shake(self, sock: socket.socket, guest: Guest) -> None:
        if self._closed:
            sock.close()
            guest.leave()
            return
        self._keep(asyncio.current_task())
        try:
            await self._loop.connect_accepted_socket(
                lambda: guest, sock, ssl=self._context, ssl_handshake_timeout=self._limit_s
            )
        except BaseException as error:
            guest.leave()  # asyncio closes the socket
            if not isinstance(error, OSError):  # of TLS and of time, too: the peer's affair
                raise

    def _keep(self, task: asyncio.Task[None] | None) -> None:
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
