"""Tests of clients that go on at another edge, over real sockets: planned without a pause, and after a crash."""

import asyncio
import threading
import time
from collections import Counter
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.events import Answered, Disconnected, Event, EventsDropped, HandedOver, Happened, Left, Resumed
from client_sdk.netsim.links import Link
from server.players.player import Player
from server.rules import Rules
from tests.patience import soon
from tests.server.cluster.conftest import Cluster

pytestmark = pytest.mark.e2e

SLOW = Link(delay_s=0.02)


class Echo(Rules):
    """Answers each command by a game event."""

    def on_command(self, player: Player, name: str, data: Any) -> bool:
        self.game.send("did", data, to=player)
        return True

    async def load_player(self, name: str, subject: str) -> Any:
        await asyncio.sleep(0)
        return {"level": len(name)}

    def on_join(self, player: Player) -> None:
        self.game.set(player.entity, "level", player.loaded["level"])


class Program:
    """A player that commands all the time: an `AsyncClient`, or a `Client` in a thread of its own."""

    def __init__(self, client: AsyncClient | Client) -> None:
        self.client = client
        self.events: list[Event] = []
        self.sent = 0
        self.commands, self.over = True, False
        self._next = 0.0
        self._thread = threading.Thread(target=self._poll) if isinstance(client, Client) else None
        if self._thread is not None:
            self._thread.start()
        else:
            self._task = asyncio.create_task(self._follow())

    def act(self) -> None:
        """Sends a command about ten times per second while there is a world."""
        if self.client.playing and self.commands and time.monotonic() > self._next:
            self._next = time.monotonic() + 0.1
            self.sent += 1
            self.client.command("go", self.sent)

    def has(self, kind: type[Event]) -> bool:
        return any(isinstance(event, kind) for event in self.events)

    async def close(self) -> None:
        self.over = True
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join)
        else:
            assert isinstance(self.client, AsyncClient)
            await self.client.close()
            await self._task

    def _poll(self) -> None:
        client = self.client
        assert isinstance(client, Client)
        with client:
            while not self.over:
                self.events += client.poll()
                client.set_input(1, 0)
                client.update()
                self.act()
                time.sleep(0.008)

    async def _follow(self) -> None:
        assert isinstance(self.client, AsyncClient)
        self.client.set_input(1, 0)
        client, self.client._before_update = self.client, lambda core: self.act()
        async for event in client:
            self.events.append(event)


async def program(cluster: Cluster, kind: str, url: str, link: Link | None) -> Program:
    if kind == "AsyncClient":
        return Program(await AsyncClient.connect(url, name="Ann", link=link))
    return Program(await asyncio.to_thread(lambda: Client.connect(url, name="Ann", link=link)))


def each_once(player: Program) -> None:
    """Checks that each command was answered once, and that its event has come once, in order."""
    answered = Counter(event.number for event in player.events if isinstance(event, Answered))
    assert len(answered) == player.sent
    assert set(answered.values()) <= {1}
    assert [event.data for event in player.events if isinstance(event, Happened)] == [*range(1, player.sent + 1)]
    assert not player.has(EventsDropped)


CLIENTS = [
    pytest.param("AsyncClient", None, id="asyncio"),
    pytest.param("Client", None, id="polling"),
    pytest.param("AsyncClient", SLOW, id="asyncio-link", marks=pytest.mark.slow),
    pytest.param("Client", SLOW, id="polling-link", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("kind", "link"), CLIENTS)
async def test_an_edge_that_drains_hands_its_clients_over_without_a_pause(
    cluster: Cluster, kind: str, link: Link | None
) -> None:
    cluster.use(Echo)
    cluster.sequencer()
    first, second = await cluster.edge(rules=Echo()), await cluster.edge(rules=Echo())
    player = await program(cluster, kind, cluster.urls[first], link)
    try:
        await soon(lambda: player.client.stats.inputs_used > 40)
        entity = player.client.entity
        first.drain()
        await soon(lambda: player.has(HandedOver))
        await soon(lambda: first.drained)
        assert first.others() == [cluster.urls[second]]
        assert second.others() == []
        goal = player.client.stats.inputs_used + 40
        await soon(lambda: player.client.stats.inputs_used >= goal)
        player.commands = False
        await soon(lambda: sum(isinstance(event, Answered) for event in player.events) == player.sent)
        cluster.kill(first)
        goal = player.client.stats.inputs_used + 20
        await soon(lambda: player.client.stats.inputs_used >= goal)
        each_once(player)
        assert player.client.entity == entity
        assert player.client.core.travel.server == cluster.urls[second]
        assert not any(map(player.has, (Disconnected, Resumed, Left)))
        assert len(second.players) == 1
    finally:
        await player.close()


@pytest.mark.parametrize(("kind", "link"), CLIENTS[:2])
async def test_a_client_goes_on_at_another_edge_after_a_crash(cluster: Cluster, kind: str, link: Link | None) -> None:
    cluster.use(Echo)
    cluster.sequencer()
    first, second = await cluster.edge(rules=Echo()), await cluster.edge(rules=Echo())
    player = await program(cluster, kind, cluster.urls[first], link)
    try:
        await soon(lambda: player.client.stats.inputs_used > 20 and bool(player.client.core.travel.edges))
        entity = player.client.entity
        cluster.kill(first)
        await soon(lambda: player.has(Resumed))
        goal = player.client.stats.inputs_used + 20
        await soon(lambda: player.client.stats.inputs_used >= goal)
        player.commands = False
        await soon(lambda: sum(isinstance(event, Answered) for event in player.events) == player.sent)
        assert (player.client.entity, player.client.core.travel.server) == (entity, cluster.urls[second])
        answered = Counter(event.number for event in player.events if isinstance(event, Answered))
        assert set(answered.values()) == {1}
        assert not player.has(Left)
    finally:
        await player.close()


async def test_an_edge_runs_load_player_and_asks_for_tokens(cluster: Cluster) -> None:
    def authenticate(token: str) -> str:
        if token != "secret":
            raise ValueError("no such token")
        return "ann"

    cluster.use(Echo)
    cluster.sequencer()
    edge = await cluster.edge(authenticate=authenticate, rules=Echo())
    await cluster.edge(authenticate=authenticate, rules=Echo())
    stranger = await AsyncClient.connect(cluster.urls[edge], name="Eve")
    left = [event async for event in stranger if isinstance(event, Left)]
    assert left[0].reason.startswith("no such token")
    ann = Program(await AsyncClient.connect(cluster.urls[edge], name="Ann", token="secret"))
    try:
        await soon(lambda: ann.client.stats.inputs_used > 20)
        (player,) = edge.players.values()
        assert player.subject == "ann"
        edge.drain()
        await soon(lambda: ann.has(HandedOver))
    finally:
        await ann.close()
