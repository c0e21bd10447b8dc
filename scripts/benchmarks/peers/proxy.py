"""The line of `bench.py peers`: a TCP proxy on loopback that delays both servers' data in the same way.

    python -m scripts.benchmarks.peers.proxy PORT SEED

Each read of a direction arrives after 50 ms, plus or minus 10 ms; one read in a hundred 200 ms later. A read never
overtakes one before it, as on TCP. A line that has healed has no late reads any more.

stdout  a JSON object per line: {"port"} when it listens, and the answer to each command
stdin   a command per line: "mark": report the counters; "heal": no late reads from now on. The end of the pipe: stop
"""

import asyncio
import json
import random
import sys
from collections import deque
from typing import Any, cast

from server.runtime import event_loop

DELAY_S, JITTER_S = 0.05, 0.01
LATE_SHARE, LATE_S = 0.01, 0.2
FLIGHT_BYTES_MAX = 1 << 20
"""Bytes on the way in one direction from which nothing more is read."""


class Line:
    """One direction of a connection: the times at which reads arrive. It knows no clock.

    Args:
        random: the source of all delays.
    """

    def __init__(self, random: random.Random) -> None:
        self._random = random
        self._last = 0.0
        self.healed = False
        self.late = 0
        """Number of reads that were late."""

    def arrival(self, now: float) -> float:
        """Returns the time at which the data that was read at `now` arrives."""
        delay = DELAY_S + JITTER_S * (2 * self._random.random() - 1)
        if self._random.random() < LATE_SHARE and not self.healed:
            delay += LATE_S
            self.late += 1
        self._last = max(self._last, now + delay)
        return self._last


class Lines:
    """All directions of all connections, and the bytes that went through."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._lines: list[Line] = []
        self.healed = False
        self.up = self.down = 0

    def add(self) -> Line:
        line = Line(random.Random(self._random.getrandbits(32)))
        line.healed = self.healed
        self._lines.append(line)
        return line

    def heal(self) -> None:
        self.healed = True
        for line in self._lines:
            line.healed = True

    def counters(self) -> dict[str, int]:
        return {"up": self.up, "down": self.down, "late": sum(line.late for line in self._lines)}


class End(asyncio.Protocol):
    """One end of a connection. What it reads arrives at the other end, `peer`, later.

    Args:
        lines: all directions.
        up: whether the client is at this end.
    """

    def __init__(self, lines: Lines, up: bool) -> None:
        self._lines, self._up = lines, up
        self._line = lines.add()
        self._loop = asyncio.get_running_loop()
        self._flight: deque[tuple[float, bytes]] = deque()  # an empty read is the end of the stream
        self._bytes = 0
        self._ended = self._done = False  # the end of what it reads: seen, and delivered
        self.peer: End | None = None
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        if self._up:
            self._lines.up += len(data)
        else:
            self._lines.down += len(data)
        self._bytes += len(data)
        if self._bytes > FLIGHT_BYTES_MAX and self.transport is not None:
            self.transport.pause_reading()
        self._fly(data)

    def eof_received(self) -> bool:
        self._ended = True
        self._fly(b"")
        return True  # the other direction goes on

    def connection_lost(self, error: Exception | None) -> None:
        self.transport = None
        if not self._ended:
            self._fly(b"")

    def start(self) -> None:
        """Begins to deliver, because the peer is there now."""
        if self._flight:
            self._loop.call_at(self._flight[0][0], self._deliver)

    def _fly(self, data: bytes) -> None:
        self._flight.append((self._line.arrival(self._loop.time()), data))
        if len(self._flight) == 1 and self.peer is not None:
            self._loop.call_at(self._flight[0][0], self._deliver)

    def _deliver(self) -> None:
        assert self.peer is not None
        now, to = self._loop.time(), self.peer.transport
        while self._flight and self._flight[0][0] <= now:
            _, data = self._flight.popleft()
            self._bytes -= len(data)
            self._done = not data
            if to is None or to.is_closing():
                continue
            if data:
                to.write(data)
            elif self.transport is None:
                to.close()
            elif self.peer._done:
                to.close()
                self.transport.close()
            else:
                to.write_eof()
        if self.transport is not None and self._bytes <= FLIGHT_BYTES_MAX and not self.transport.is_reading():
            self.transport.resume_reading()
        if self._flight:
            self._loop.call_at(self._flight[0][0], self._deliver)


class Front(End):
    """The end at the client. It connects to the server."""

    def __init__(self, lines: Lines, target: int) -> None:
        super().__init__(lines, up=True)
        self._target = target

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._connecting = self._loop.create_task(self._connect())

    async def _connect(self) -> None:
        back = End(self._lines, up=False)
        back.peer = self
        try:
            await self._loop.create_connection(lambda: back, "127.0.0.1", self._target)
        except OSError:
            if self.transport is not None:
                self.transport.abort()
            return
        self.peer = back
        self.start()


async def serve(target: int, lines: Lines) -> asyncio.Server:
    """Listens on a free port of loopback."""
    return await asyncio.get_running_loop().create_server(lambda: Front(lines, target), "127.0.0.1", 0)


async def run(target: int, seed: int) -> None:
    """Serves until stdin ends."""
    loop, lines = asyncio.get_running_loop(), Lines(seed)
    async with await serve(target, lines) as server:
        say({"port": server.sockets[0].getsockname()[1]})
        commands = asyncio.StreamReader()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
        while command := (await commands.readline()).decode().strip():
            if command == "heal":
                lines.heal()
            say(lines.counters())


def say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=event_loop.loop_factory()) as runner:
        runner.run(run(int(sys.argv[1]), int(sys.argv[2])))
