"""Honest players that use the wire protocol without the SDK: they walk, build, lose connections, return and leave.

No other player edits the blocks of a player, so the answers to a player determine what its blocks may be.
"""

import asyncio
import contextlib
import math
import random
from collections import Counter
from typing import Any

import msgpack

from client_sdk.prediction.confirmed import Confirmed
from client_sdk.replica import check_scene
from scripts.loadgen.player import REQUEST, frame
from scripts.soak_test.cells import Cell, Cells
from scripts.soak_test.progress import Progress
from shared import edits, fields, messages
from shared.messages import Bye, Command, Hello, Inputs, Ping, Snapshot, Welcome, decode_from_server, encode
from shared.snapshot import VERDICT

LEAD_TICKS = 2
CONNECT_S = 5.0
AWAY_S = 13.0
"""Longest time, in seconds, for which a disconnected player surely keeps its entity. The server keeps it for 15 s."""


class Link(asyncio.Protocol):
    """A connection that passes whole messages to its player."""

    def __init__(self, player: "Honest") -> None:
        self.player = player
        self.transport: asyncio.Transport | None = None
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.answer = b""
        self._open = False
        self._rest = b""

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        transport.write(REQUEST)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        if not self.ended.done():
            self.ended.set_result(None)

    def send(self, *said: messages.Message) -> None:
        if self.transport is not None:
            self.transport.write(b"".join(frame(encode(message)) for message in said))

    def data_received(self, data: bytes) -> None:
        data = self._rest + data
        at = 0
        if not self._open:
            end = data.find(b"\r\n\r\n")
            if end < 0:
                self._rest = data
                return
            self._open, at, self.answer = True, end + 4, data[:end]
            self.player.hello(self)
        while len(data) - at >= 2 and self.transport is not None:
            length, start = data[at + 1], at + 2
            if length == 126:
                length, start = int.from_bytes(data[at + 2 : at + 4], "big"), at + 4
            elif length == 127:
                length, start = int.from_bytes(data[at + 2 : at + 10], "big"), at + 10
            if start + length > len(data):
                break
            if data[at] != 0x82:  # the server closes
                self.transport.abort()
                break
            self.player.take(self, data[start : start + length])
            at = start + length
        self._rest = data[at:]


class Honest:
    """A player, from its first join until the task is cancelled.

    Args:
        number: number of the player, which is part of its name and seed.
        port: port of the server.
        seed: seed of the whole soak test.
        cells: the edited blocks of all players.
        lossy: whether the connection is cut every few seconds.
    """

    def __init__(self, number: int, port: int, seed: int, cells: Cells, *, lossy: bool) -> None:
        self.number, self.port, self.cells, self.lossy = number, port, cells, lossy
        self.rng = random.Random(f"{seed} {number}")
        self.entity, self.resume = 0, b""
        self.unexplained: list[str] = []
        self.counts: Counter[str] = Counter()
        self.got = self.due = 0
        """Snapshots received, and snapshots made by the server, between the first and last of each connection."""
        self.playing = False
        self.progress = Progress(walks=False)
        self.used = 0
        """Number of inputs that the server has used."""
        self._waiting: dict[int, tuple[Cell, int, Command]] = {}
        self._copy: Confirmed | None = None
        """Copy of the world, without terrain."""
        self._asked = 0
        self._tick = self._sent = -1
        self._row = bytes(3)
        self._lost_at = -math.inf

    async def play(self) -> None:
        """Plays, and connects again after each connection."""
        loop, failed = asyncio.get_running_loop(), 0
        while True:
            try:
                async with asyncio.timeout(CONNECT_S):
                    _, link = await loop.create_connection(lambda: Link(self), "127.0.0.1", self.port)
            except (OSError, TimeoutError):
                self.counts["connects failed"] += 1
                failed += 1
                await asyncio.sleep(min(0.25 * 2**failed, 2.0) * self.rng.uniform(0.5, 1.0))
                continue
            failed = 0
            await self._connected(link)
            await asyncio.sleep(self.rng.uniform(0.1, 2.0))

    async def _connected(self, link: Link) -> None:
        """Waits until the server ends the connection, or ends it after a random time."""
        stay = self.rng.uniform(4, 15) if self.lossy else self.rng.uniform(20, 90)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(stay):
                await asyncio.shield(link.ended)
        self.playing, self._tick = False, -1
        self._lost_at = asyncio.get_running_loop().time()
        if link.transport is None:
            self.counts["lost"] += 1
            status = link.answer.partition(b"\r\n")[0]
            if status and b" 101 " not in status:
                self.unexplained.append(f"refused: {status!r}")
        elif self.lossy or self.rng.random() < 0.5:
            self.counts["cut off"] += 1
            link.transport.abort()
        else:
            self.counts["left"] += 1
            link.send(Bye(1000, "", -1.0))
            self.entity, self.resume, self._waiting = 0, b"", {}
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CONNECT_S):
                    await asyncio.shield(link.ended)
            if link.transport is not None:
                link.transport.abort()

    def hello(self, link: Link) -> None:
        """Sends the hello once the WebSocket is open."""
        link.send(Hello(messages.VERSION, {}, f"honest {self.number}", resume=self.resume))

    def take(self, link: Link, data: bytes) -> None:
        """Takes a message of the server."""
        message = decode_from_server(data)
        if isinstance(message, Snapshot):
            self._snapshot(link, message)
        elif isinstance(message, Welcome):
            self._welcome(link, message)
        elif isinstance(message, Bye) and message.code != messages.GOING_AWAY:
            self.unexplained.append(f"told to go: {message.code} {message.reason}")

    def _welcome(self, link: Link, welcome: Welcome) -> None:
        away_s = asyncio.get_running_loop().time() - self._lost_at
        if self.resume and welcome.entity == self.entity:
            self.counts["came back"] += 1
            link.send(*[command for _, _, command in self._waiting.values()])  # each is done once, and answered
        else:
            if self.resume and away_s < AWAY_S:
                self.unexplained.append(f"another entity after {away_s:.1f} s")
            self.counts["joined"] += 1
            self._waiting = {}
        self.entity, self.resume, self._sent = welcome.entity, welcome.resume, -1
        self.progress.away()
        self._copy = Confirmed(check_scene(welcome.scene), welcome.entity)
        self.playing = True

    def _snapshot(self, link: Link, snapshot: Snapshot) -> None:
        tick, rng = snapshot.tick, self.rng
        if self._tick >= 0:
            self.got += 1
            self.due += tick - self._tick
        self._tick = tick
        self.used += snapshot.statuses.count(messages.USED)
        self.progress.see(asyncio.get_running_loop().time(), self.used)
        if self._copy is not None and (wrong := self._copy.apply(snapshot)):
            self.unexplained.append(wrong)
        for number, verdict in VERDICT.iter_unpack(snapshot.verdicts):
            asked = self._waiting.pop(number, None)
            if asked is not None:
                self.cells.answered(asked[0], asked[1], verdict)
        if rng.random() < 1 / 32:
            angle = rng.random() * math.tau
            self._row = bytes((int(127 * math.cos(angle)) & 255, int(127 * math.sin(angle)) & 255, rng.random() < 0.1))
            link.send(Ping(0.0))
        due = tick + LEAD_TICKS
        n = min(due - self._sent, fields.INPUT_ROWS_MAX) if self._sent >= 0 else 1
        if n > 0:
            self._sent = due
            link.send(Inputs(due - n + 1, tick, self._row * n))
        if rng.random() < 1 / 32:
            self._edit(link, snapshot)

    def _edit(self, link: Link, snapshot: Snapshot) -> None:
        """Requests an edit of a block near the player."""
        if self._copy is None or self.entity not in self._copy.world:
            return
        x, y, z = (int(part // 1) + self.rng.randint(-3, 3) for part in self._copy.world.position(self.entity))
        cell = (x, y, z + 2)
        kind = self.cells.ask(self.number, cell, self.rng)
        if kind is not None:
            self._asked += 1
            payload = msgpack.packb((*cell, kind))
            command = Command(self._asked, snapshot.tick + 1, float(snapshot.tick), edits.NAME, payload)
            self._waiting[self._asked] = (cell, kind, command)
            link.send(command)
