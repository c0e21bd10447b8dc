"""Clients that come and go through the matchmaking of a real server by a seeded schedule, with `kill -9` in between.

The clients are bytes over real sockets, without prediction, so that hundreds of them fit into one process.
"""

import asyncio
import json
import random
import signal
import time
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from shared import messages
from shared.messages import Bye, Go, Hello, Inputs, Ping, Snapshot, Welcome, decode_from_server, encode
from tests.e2e.processes import running
from tests.lengths import long

pytestmark = pytest.mark.e2e
SETTINGS = """
scene = "flat"
[limits]
creations_per_s = 500
[worlds.arena]
scene = "topdown"
players_max = 4
empty_s = 1.0
"""
PATIENCE_S = 60.0
REFUSED = (OSError, InvalidHandshake, ConnectionClosed, TimeoutError)


class Visitor:
    """A client that asks for a match, plays, loses its connection at times, leaves, and comes again.

    Args:
        number: its number.
        url: address of the server.
        seed: source of its chance.
    """

    def __init__(self, number: int, url: str, seed: int) -> None:
        self.name, self.url, self.chance = f"visitor {number}", url, random.Random(f"{seed} {number}")
        self.counts = Counter[str]()
        self._links: list[ClientConnection] = []

    def _break_off(self) -> None:
        """Breaks off all connections."""
        while self._links:
            self._links.pop().transport.abort()

    async def visit(self) -> None:
        """Plays in one match."""
        path, welcome = await self._matched()
        link: ClientConnection | None = None
        left = self.chance.randrange(1, 4)  # times that it plays, each but the first after a lost connection
        while True:
            try:
                if link is None:
                    link, welcome = await self._back(path, welcome)
                if not left:
                    await link.send(encode(Bye(messages.GOING_AWAY, "", -1.0)))
                    await link.close()
                    self.counts["left"] += 1
                    return
                await self._plays(link, self.chance.uniform(0.1, 0.6))
            except REFUSED:  # the server has been killed
                self._break_off()
                link = None
                self.counts["cut off"] += 1
                continue
            left -= 1
            if self.chance.random() < 0.5:
                self._break_off()
                link = None
                self.counts["lost"] += 1

    async def _matched(self) -> tuple[str, Welcome]:
        """Asks for a match until the client is in one. Returns the world's path and the welcome."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            mode = self.chance.choice(("", "&mode=a", "&mode=b"))
            try:
                go = await self._until(Go, await self._hello(f"/match?kind=arena{mode}", b""))
                link = await self._hello(go.path, b"")
                welcome = await self._until(Welcome, link)
                await self._plays(link, 0.1)
                self._break_off()
            except REFUSED:  # the server has been killed, or the seat has gone with it
                self._break_off()
                self.counts["again"] += 1
                await asyncio.sleep(0.2)
                continue
            self.counts["matched"] += 1
            return go.path.partition("?")[0], welcome
        raise AssertionError(f"{self.name} found no match: {self.counts}")

    async def _back(self, path: str, welcome: Welcome) -> tuple[ClientConnection, Welcome]:
        """Reconnects to a world. The entity must be the same."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            try:
                link = await self._hello(path, welcome.resume)
                again = await self._until(Welcome, link)
                await self._plays(link, 0.1)
            except REFUSED:
                self._break_off()
                self.counts["again"] += 1
                await asyncio.sleep(0.2)
                continue
            assert again.entity == welcome.entity, f"{self.name} was lost in {path}"
            self.counts["resumed"] += 1
            return link, again
        raise AssertionError(f"{self.name} does not get back to {path}: {self.counts}")

    async def _hello(self, path: str, resume: bytes) -> ClientConnection:
        link = await connect(self.url + path, compression=None, ping_interval=None, close_timeout=1.0, max_size=None)
        self._links.append(link)
        await link.send(encode(Hello(messages.VERSION, {}, self.name, "", resume)))
        return link

    async def _until(self, kind: type[Any], link: ClientConnection) -> Any:
        """Returns the next message of a kind."""
        async with asyncio.timeout(10):
            while True:
                data = await link.recv()
                assert isinstance(data, bytes)
                message = decode_from_server(data)
                if isinstance(message, kind):
                    return message
                if isinstance(message, Bye):
                    raise ConnectionResetError(message.reason)

    async def _plays(self, link: ClientConnection, seconds: float) -> None:
        """Plays for some time, and acknowledges at least one snapshot."""
        deadline = time.monotonic() + seconds
        while True:
            snapshot = await self._until(Snapshot, link)
            await link.send(encode(Inputs(snapshot.tick + 2, snapshot.tick, bytes(3))))
            await link.send(encode(Ping(0.0)))
            if time.monotonic() >= deadline:
                return


async def visits(visitor: Visitor, rounds: int, joins: asyncio.Semaphore, over: asyncio.Event) -> Counter[str]:
    """Lets a client come several times, and again until `over` is set."""
    while visitor.counts["left"] < rounds or not over.is_set():
        async with joins:
            await visitor.visit()
        await asyncio.sleep(visitor.chance.uniform(0, 0.3))
    return visitor.counts


def entries(url: str) -> list[dict[str, Any]]:
    """Returns the list of the worlds."""
    with urllib.request.urlopen(url.replace("ws", "http", 1) + "/worlds", timeout=PATIENCE_S) as answer:
        return list(json.load(answer)["worlds"])


@pytest.mark.longest
@pytest.mark.parametrize(("clients", "at_once", "kills", "data"), long((400, 130, 0, False), (150, 50, 3, True)))
async def test_nobody_is_lost_in_matchmaking(
    clients: int, at_once: int, kills: int, data: bool, tmp_path: Path
) -> None:
    (config := tmp_path / "server.toml").write_text(SETTINGS, "utf-8")
    flags = ["--config", str(config), *(["--data", str(tmp_path / "data"), "--durability", "process"] if data else ())]
    chance, joins, port = random.Random(clients), asyncio.Semaphore(at_once), "0"
    over = asyncio.Event()
    playing: asyncio.Future[list[Counter[str]]] | None = None
    rounds = 2 if kills else 1
    for life in range(kills + 1):
        with running(*flags, "--port", port) as server:
            host, number = server.address()
            url, port = f"ws://{host}:{number}", str(number)
            if playing is None:
                visitors = [Visitor(k, url, 7) for k in range(clients)]
                playing = asyncio.gather(*(visits(visitor, rounds, joins, over) for visitor in visitors))
            if life < kills:
                await asyncio.sleep(chance.uniform(1.0, 2.5))
                server.process.kill()
                server.process.wait()
                continue
            over.set()
            while not playing.done():
                for entry in await asyncio.to_thread(entries, url):
                    assert entry["players"] <= 4, entry
                await asyncio.sleep(0.25)
            counts = sum(playing.result(), Counter[str]())
            assert rounds * clients <= counts["left"] == counts["matched"]
            assert counts["resumed"] >= counts["lost"]
            deadline = time.monotonic() + PATIENCE_S
            while left := await asyncio.to_thread(entries, url):
                assert time.monotonic() < deadline, left
                await asyncio.sleep(0.25)
            assert await asyncio.to_thread(server.end, signal.SIGTERM) == 0
            assert not [entry for entry in server.log() if entry["level"] != "info"]
