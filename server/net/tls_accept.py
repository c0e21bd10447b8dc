"""Accepting of TLS connections, which are counted from the moment they are accepted.

asyncio's own servers report a connection only when its TLS handshake is over. A peer that never finishes the handshake
would hold a file descriptor and up to 0.3 MB that no limit counts. Therefore connections are accepted here, and
admission is asked before the handshake.
"""

import asyncio
import socket
import ssl
from abc import abstractmethod
from collections.abc import Callable

AGAIN_S = 1.0
"""Seconds until the next attempt after nothing could be accepted, for example because no file descriptor was free."""


class AcceptedSocket(asyncio.Protocol):
    """The protocol of one accepted socket. It gets its transport when the handshake is over."""

    @abstractmethod
    def enter(self, address: str) -> bool:
        """Counts the connection. Returns False if it is to be dropped."""

    @abstractmethod
    def leave(self) -> None:
        """Counts the end of the connection. Further calls do nothing."""


class Handshakes:
    """Accepts connections and runs their TLS handshakes.

    Args:
        make_protocol: makes the protocol of a connection.
        context: the TLS context of the server.
        limit_s: maximum time of one handshake, in seconds.
    """

    def __init__(self, make_protocol: Callable[[], AcceptedSocket], context: ssl.SSLContext, limit_s: float) -> None:
        self._make_protocol, self._context, self._limit_s = make_protocol, context, limit_s
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        """Tasks that accept, and those of handshakes that have begun. A task that is cancelled before it begins would
        not clean up, so it is not in the set."""
        self._closed = False
        self.sockets: list[socket.socket] = []
        """Listening sockets."""

    def listen(self, sockets: list[socket.socket]) -> None:
        """Starts to accept connections. The sockets must be listening and non-blocking."""
        self.sockets = sockets
        for listener in sockets:
            self._keep(self._loop.create_task(self._accept(listener)))

    def close(self) -> None:
        """Stops accepting, and ends the handshakes that are under way."""
        self._closed = True
        for task in self._tasks:
            task.cancel()
        for listener in self.sockets:
            listener.close()

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                sock, peer = await self._loop.sock_accept(listener)
            except ConnectionError:  # the peer has disconnected already
                await asyncio.sleep(0)
                continue
            except OSError as error:
                self._loop.call_exception_handler({"message": "cannot accept a connection", "exception": error})
                await asyncio.sleep(AGAIN_S)
                continue
            accepted = self._make_protocol()
            if accepted.enter(str(peer[0])):
                self._loop.create_task(self._shake(sock, accepted))  # the task adds itself to `_tasks` when it begins
            else:
                sock.close()
            await asyncio.sleep(0)  # `sock_accept` does not yield if a connection waits, so let other tasks run

    async def _shake(self, sock: socket.socket, accepted: AcceptedSocket) -> None:
        if self._closed:
            sock.close()
            accepted.leave()
            return
        self._keep(asyncio.current_task())
        try:
            await self._loop.connect_accepted_socket(
                lambda: accepted, sock, ssl=self._context, ssl_handshake_timeout=self._limit_s
            )
        except BaseException as error:
            accepted.leave()  # asyncio closes the socket
            if not isinstance(error, OSError):  # TLS errors and timeouts are OSErrors, too, and the peer's fault
                raise

    def _keep(self, task: asyncio.Task[None] | None) -> None:
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
