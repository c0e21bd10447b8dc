"""Clients find worlds of a real server, take seats in them, and reconnect to them."""

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from client_sdk import AsyncClient, Client, ConnectError, Event, Joined, Left, Matched, Resumed, list_worlds
from client_sdk.netsim.links import Link
from tests.client_sdk.servers import real_server
from tests.e2e.processes import running, stats
from tests.e2e.test_loadtest import loadtest
from tests.patience import PATIENCE_S
from tests.proxy import Proxy

pytestmark = pytest.mark.e2e

SETTINGS = """
scene = "flat"

[worlds.arena]
game = "sovereign_netcode.examples.tag:Tag"
scene = "flat"
players_max = 3
empty_s = 30
"""
BETWEEN_FRAMES_S = 0.004


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "worlds.toml"
    path.write_text(SETTINGS, "utf-8")
    return path


@pytest.fixture
def url(settings: Path) -> Iterator[str]:
    with real_server("--config", str(settings)) as url:
        yield url


def frames(until: Callable[[], bool], *clients: Client) -> dict[Client, list[Event]]:
    """Calls clients once per frame until a condition holds. Returns their events."""
    events: dict[Client, list[Event]] = {client: [] for client in clients}
    end = time.monotonic() + PATIENCE_S
    while not until():
        assert time.monotonic() < end, events
        for client in clients:
            events[client] += client.poll()
            client.update()
        time.sleep(BETWEEN_FRAMES_S)
    return {client: [*before, *client.poll()] for client, before in events.items()}


def test_a_match_with_a_friend_a_private_world_and_the_list(url: str) -> None:
    assert list_worlds(url) == []
    with Client.match(url, "arena", mode="2v2", seats=2, name="Ann") as ann:
        events = frames(lambda: ann.playing, ann)[ann]
        assert [type(event) for event in events if isinstance(event, Matched | Joined)] == [Matched, Joined]
        assert ann.world == "arena-1"
        (seat,) = ann.seats
        with Client.join(url, seat=seat, name="Bob") as bob, Client.create(url, "arena", private=True) as host:
            frames(lambda: bob.playing and host.playing, ann, bob, host)
            assert (bob.world, host.world, len(host.code)) == ("arena-1", "arena-2", 6)
            with Client.join(url, code=host.code) as guest:
                frames(lambda: guest.playing, ann, bob, host, guest)
                assert (guest.world, guest.code) == ("arena-2", host.code)
            (entry,) = list_worlds(url, "arena")
            assert (entry.name, entry.players, entry.full, entry.properties) == ("arena-1", 2, False, {"mode": "2v2"})
            assert list_worlds(url, "race") == []
            assert ann.stats.divergences == bob.stats.divergences == 0
    with pytest.raises(ConnectError, match="there is no world 'arena-7'"):
        Client.join(url, world="arena-7")
    with Client.match(url, "race") as lost:
        (left,) = frames(lambda: lost.closed, lost)[lost]
        assert isinstance(left, Left)
        assert "there is no such kind" in left.reason


async def test_an_asyncio_client_reconnects_to_its_world(settings: Path) -> None:
    with running("--port", "0", "--host", "127.0.0.1", "--config", str(settings)) as server:
        address = server.address()
        async with (
            asyncio.timeout(PATIENCE_S),
            Proxy(address, Link()) as proxy,
            await AsyncClient.match(proxy.url, "arena", patience_s=10.0) as client,
        ):
            async for event in client:
                match event:
                    case Joined():
                        await proxy.cut()
                    case Resumed():
                        break
            assert client.world == "arena-1"
            assert [each.players for each in await AsyncClient.list_worlds(proxy.url)] == [1]


def test_each_bot_of_a_load_test_finds_a_world(url: str, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    done = loadtest("--url", f"{url}/match?kind=arena", "--clients", "6", "--seconds", "1", "--json", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    assert (figures["clients"], figures["disconnects"], figures["malformed"]) == (6, 0, 0)
    host, _, port = url.removeprefix("ws://").partition(":")
    assert stats((host, int(port)))["worlds_counts"]["created"] == 2
