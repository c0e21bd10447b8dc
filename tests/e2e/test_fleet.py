"""A fleet of real processes on a real NATS server: matches from any front, `kill -9`, SIGSTOP and SIGTERM."""

import asyncio
import json
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from client_sdk import AsyncClient
from client_sdk.transports.listing import list_worlds
from scripts.scale_lab.cluster import PartProcess
from scripts.scale_lab.nats_server import NatsServer, binary

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.slow,
    pytest.mark.skipif(not binary(), reason="there is no nats-server here"),
]
PATIENCE_S = 60.0
SETTINGS = """
scene = "flat"
fleet = "test"
durability = "process"
[limits]
creations_per_s = 100
[worlds.arena]
scene = "topdown"
players_max = 4
empty_s = 2.0
[worlds.hall]
scene = "flat"
start = 1
"""


class Fleet:
    """A NATS server and processes of a fleet.

    Args:
        folder: an existing folder for all files.
        saved: whether the worlds are saved, in a directory of all processes.
    """

    def __init__(self, folder: Path, *, saved: bool = False) -> None:
        self.folder, self.saved = folder, saved
        (folder / "nats").mkdir()
        (folder / "server.toml").write_text(SETTINGS, "utf-8")
        self.nats = NatsServer(folder / "nats")
        self.processes: list[PartProcess] = []
        self.clients: dict[AsyncClient, str] = {}

    async def start(self, count: int) -> None:
        await self.nats.start()
        data = ("--data", str(self.folder / "data")) if self.saved else ()
        for number in range(count):
            arguments = ("--config", str(self.folder / "server.toml"), *data)
            process = PartProcess(self.folder, f"process{number}", arguments)
            process.start(self.nats.url)
            self.processes.append(process)
        for process in self.processes:
            await process.ready()

    async def owner(self, world: str) -> PartProcess | None:
        """Returns the process that runs a world."""
        for process in self.processes:
            if process.alive:
                status, body = await process.page(f"/{world}/stats")
                if status == 200 and json.loads(body)["world"] == world:
                    return process
        return None

    async def match(self) -> str:
        """Lets a client ask each process for a match. Returns the world of all of them."""
        for at, process in enumerate(self.processes):
            client = await AsyncClient.match(process.url, "arena", name=f"player {at}")
            self.clients[client] = process.url
        async with asyncio.timeout(PATIENCE_S):
            while not all(client.core.state == "playing" for client in self.clients):  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        (world,) = {client.world for client in self.clients}
        return world

    async def shows(self, process: PartProcess, path: str) -> None:
        """Waits until a process has a page."""
        async with asyncio.timeout(PATIENCE_S):
            status = 0
            while status != 200:
                status, _ = await process.page(path)

    async def play(self, world: str, *, but: PartProcess | None = None) -> PartProcess:
        """Waits until all clients play in a world. Returns its process, which is another one than `but`."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                owner = await self.owner(world)
                at = {client.core.travel.server or url for client, url in self.clients.items()}
                states = {client.core.state for client in self.clients}
                if owner is not None and owner is not but and (at, states) == ({owner.url}, {"playing"}):
                    return owner
                await asyncio.sleep(0.05)

    async def close(self) -> None:
        for client in self.clients:
            await client.close()
        for process in self.processes:
            process.send(signal.SIGCONT)
            process.kill()
        self.nats.kill()


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    made = Fleet(tmp_path)
    try:
        yield made
    finally:
        await made.close()


async def test_clients_come_back_to_their_match_after_the_death_of_its_process(fleet: Fleet) -> None:
    fleet.saved = True
    await fleet.start(3)
    world = await fleet.match()
    owner = await fleet.play(world)
    await asyncio.sleep(1.5)
    for process in fleet.processes:
        listed = await asyncio.to_thread(list_worlds, process.url)
        assert {entry.name: entry.players for entry in listed} == {world: 3, "hall": 0}
    entities = [client.entity for client in fleet.clients]
    owner.kill()
    other = await fleet.play(world, but=owner)
    assert [client.entity for client in fleet.clients] == entities, "the world has come back with its players"
    other.send(signal.SIGTERM)  # its worlds come up elsewhere without a copy
    assert await asyncio.to_thread(other.wait, 15.0) == 0
    await fleet.play(world, but=other)
    assert [client.entity for client in fleet.clients] == entities


async def test_a_suspended_process_leaves_its_worlds_when_it_wakes(fleet: Fleet) -> None:
    await fleet.start(2)
    world = await fleet.match()
    owner = await fleet.play(world)
    owner.send(signal.SIGSTOP)
    (other,) = [process for process in fleet.processes if process is not owner]
    await fleet.shows(other, f"/{world}/stats")
    owner.send(signal.SIGCONT)
    await fleet.play(world, but=owner)
    assert (await owner.page(f"/{world}/stats"))[0] == 404
    assert (await owner.page("/readyz"))[0] == 200
