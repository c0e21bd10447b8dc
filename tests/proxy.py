"""A TCP proxy on loopback that is as bad as a path of `client_sdk.netsim.links`, in real time.

Theory of operation. Each direction of each connection is a line: what it reads is a packet, which takes its time on
the line (`rate`), then flies (`delay`, jitter, the link_events), in order. While the line is busy nothing is read: what
waits for the line waits in the kernels' buffers. This side of them is made as small as it gets, so that all but
`HIDDEN_BYTES` stands at the sender, where SIOCOUTQ counts it, as on a real path; only that what is read counts as
acknowledged at once, and not a round trip later. A lost packet, which no proxy can lose, comes late instead: after
what it takes to find it missing and send it again.
"""

import asyncio
import random
import socket
import struct
import time
from types import TracebackType

from client_sdk.netsim.links import HEADER_BYTES, TIMER_S, Link, LinkEvents

PACKET_BYTES = 536
"""The least that every path carries."""
READ_BYTES = 4096
"""More than a kernel has: after a read its window is wide open, and the sender's kernel need not probe for that."""
HIDDEN_BYTES = 2 * 1152
"""So much may wait for the line without its sender knowing: what was read at once, and what the kernel has."""
FLIGHT_PACKETS_MAX = 256
"""More are not read, however long the delay."""
STEP_S = 0.005
"""Seconds between two looks at the link while it lets nothing through."""


class Proxy:
    """Forwards every connection to `target`; use it with `async with`.

    Args:
        target: host and port.
        path: what each connection's two directions are like, from the moment when the proxy starts.
        seed: everything random comes from it.
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
        """Where a client connects to."""
        return f"ws://127.0.0.1:{self._listener.getsockname()[1]}"

    @property
    def now(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._started

    def stall(self) -> None:
        """From now on nothing is read and nothing arrives."""
        self._flowing.clear()

    def flow(self) -> None:
        """Ends a stall: what has waited goes on."""
        self._flowing.set()

    async def cut(self) -> None:
        """Breaks all connections off, in both directions, without a goodbye."""
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
        """One connection, until both directions have ended or one has broken."""
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
                if not in_order:  # both ends get a reset
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
        self._free = 0.0  # when the line is
        self._last = 0.0  # when the newest packet arrives

    async def read(self) -> None:
        """Takes in what has come as fast as the line allows; the last packet is empty."""
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
        """Hands over each packet when its time has come."""
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
        """When a packet that left the line at `gone` has flown, as often as it takes."""
        path, sent = self._path, gone
        while self._link_events.out(sent):
            sent += STEP_S
        lost = sent > gone
        while lost or self._rng.random() < path.loss:
            sent += 1.25 * path.rtt_s + TIMER_S
            lost = False
        return sent + path.delay_s + self._rng.random() * path.jitter_s + self._link_events.extra(gone)


def _small() -> socket.socket:
    """A socket whose kernel takes in as little ahead of its reader as it can be told to; so do those it accepts."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    sock.setblocking(False)
    return sock
