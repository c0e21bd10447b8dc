"""A TCP proxy on loopback that delays data like a link of `client_sdk.netsim.links`, in real time.

Theory of operation. Each direction of a connection is a line. A read of at most `PACKET_BYTES` is a packet. It occupies
the line for some time (`rate`) and then travels (delay, jitter, link events); packets stay in order. While the line is
busy, nothing is read, and data waits in the buffers of the kernels. The proxy's receive buffers are as small as
possible, so all but `HIDDEN_BYTES` waits at the sender, where SIOCOUTQ counts it, as on a real link. There is one
difference: data counts as acknowledged when it is read, not a round trip later. A proxy cannot lose a packet, so a lost
packet is delivered late: after the time to detect the loss and to send it again.
"""

import asyncio
import random
import socket
import struct
import time
from types import TracebackType

from client_sdk.netsim.links import HEADER_BYTES, TIMER_S, Link, LinkEvents

PACKET_BYTES = 536
"""Bytes of a packet: the minimum that every IPv4 path carries (MSS)."""
READ_BYTES = 4096
"""Bytes of one read: more than the receive buffer holds. It empties the buffer, so the sender does not have to probe
for a window."""
HIDDEN_BYTES = 2 * 1152
"""Bytes that may wait for the line without being counted at the sender: those just read, and those in the receive
buffer."""
FLIGHT_PACKETS_MAX = 256
"""Maximum number of packets on the way. When it is reached, nothing is read."""
STEP_S = 0.005
"""Seconds between two checks of a link that lets nothing through."""


class Proxy:
    """Forwards every connection to `target`. Use it with `async with`.

    Args:
        target: host and port.
        path: the link that both directions of each connection simulate. Its time begins when the proxy starts.
        seed: seed of all random numbers.
    """

    def __init__(self, target: tuple[str, int], path: Link, seed: int = 1) -> None:
        self.path = path
        self._target = target
        self._rng = random.Random(seed)
        self._lives: set[asyncio.Task[None]] = set()
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._started = time.monotonic()

    @property
    def url(self) -> str:
        """The URL for clients."""
        return f"ws://127.0.0.1:{self._listener.getsockname()[1]}"

    @property
    def now(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._started

    def stall(self) -> None:
        """Stops reading and delivering until `flow` is called."""
        self._flowing.clear()

    def flow(self) -> None:
        """Ends a stall; the waiting data is delivered."""
        self._flowing.set()

    async def cut(self) -> None:
        """Resets all connections in both directions, without a closing handshake."""
        for life in self._lives:
            life.cancel()
        await asyncio.gather(*self._lives, return_exceptions=True)

    async def __aenter__(self) -> "Proxy":
        self._listener = _small()
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen()
        self._started = time.monotonic()
        self._accepting = asyncio.create_task(self._accept())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._accepting.cancel()
        await asyncio.gather(self._accepting, return_exceptions=True)
        await self.cut()
        self._listener.close()

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            client, _ = await loop.sock_accept(self._listener)
            life = asyncio.create_task(self._join(client))
            self._lives.add(life)
            life.add_done_callback(self._lives.discard)

    async def _join(self, client: socket.socket) -> None:
        """Serves one connection until both directions have ended or one has failed."""
        link_events = LinkEvents(self.path, self._rng.randrange(1 << 30))
        with client, _small() as server:
            client.setblocking(False)
            in_order = False
            try:
                await asyncio.get_running_loop().sock_connect(server, self._target)
                async with asyncio.TaskGroup() as group:
                    for source, sink in ((client, server), (server, client)):
                        source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        line = _Line(self, link_events, self._rng.randrange(1 << 30), source, sink)
                        group.create_task(line.read())
                        group.create_task(line.write())
                in_order = True
            except* OSError:
                pass
            finally:
                if not in_order:  # an unordered end resets both ends
                    for sock in (client, server):
                        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    async def flowing(self) -> None:
        await self._flowing.wait()


class _Line:
    """One direction of one connection."""

    def __init__(
        self, proxy: Proxy, link_events: LinkEvents, seed: int, source: socket.socket, sink: socket.socket
    ) -> None:
        self._proxy, self._link_events, self._path = proxy, link_events, link_events.path
        self._source, self._sink = source, sink
        self._rng = random.Random(seed)
        self._flight: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(FLIGHT_PACKETS_MAX)
        self._free = 0.0  # time at which the line is free
        self._last = 0.0  # time at which the newest packet arrives

    async def read(self) -> None:
        """Reads packets as fast as the line allows. The last packet is empty."""
        loop = asyncio.get_running_loop()
        data = b"?"
        while data:
            await self._proxy.flowing()
            data = await loop.sock_recv(self._source, READ_BYTES)
            for at in range(0, max(1, len(data)), PACKET_BYTES):
                await self._send(data[at : at + PACKET_BYTES])
            await asyncio.sleep(max(0.0, self._free - self._proxy.now))

    async def _send(self, packet: bytes) -> None:
        now = self._proxy.now
        bits = 8 * (len(packet) + HEADER_BYTES)
        self._free = max(now, self._free) + bits / self._link_events.rate(now)
        self._last = max(self._last, self._arrival(self._free))
        await self._flight.put((self._last, packet))

    async def write(self) -> None:
        """Delivers each packet at its time of arrival."""
        loop = asyncio.get_running_loop()
        while True:
            due, data = await self._flight.get()
            await asyncio.sleep(max(0.0, due - self._proxy.now))
            await self._proxy.flowing()
            if not data:
                self._sink.shutdown(socket.SHUT_WR)
                return
            await loop.sock_sendall(self._sink, data)

    def _arrival(self, gone: float) -> float:
        """Returns the time at which a packet that left the line at `gone` arrives, with all its losses."""
        path, sent = self._path, gone
        while self._link_events.out(sent):
            sent += STEP_S
        lost = sent > gone
        while lost or self._rng.random() < path.loss:
            sent += 1.25 * path.rtt_s + TIMER_S
            lost = False
        return sent + path.delay_s + self._rng.random() * path.jitter_s + self._link_events.extra(gone)


def _small() -> socket.socket:
    """Returns a socket with the smallest possible receive buffer. Sockets that it accepts have it, too."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    sock.setblocking(False)
    return sock
