"""Parts of a world in one event loop, joined by a bus within the process."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, TypeVar

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.core import Core
from server.cluster.edge import EdgePart
from server.cluster.local_bus import LocalBus, LocalHub
from server.cluster.part import Part, PartError
from server.cluster.sequencer import SequencerPart
from server.journal.recorded_world import RecordedWorld
from server.net.gateway import Gateway
from server.rules import Rules, prepared
from server.runtime.event_loop import loop_factory
from shared.inputs import make_input
from shared.scene import Scene, load_scene
from tests.patience import PATIENCE_S


def pytest_asyncio_loop_factories(
    config: pytest.Config, item: pytest.Item
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"best": loop_factory()}


P = TypeVar("P", bound=Part)


class Cluster:
    """The parts of one world, with a gateway for each edge.

    Args:
        make_bus: makes the bus of each part.
        rules: makes the rules for each sequencer.
        scene: name of the scene.
    """

    def __init__(
        self,
        make_bus: Callable[[], Any] | None = None,
        rules: Callable[[], Rules] = Rules,
        scene: str = "meadow",
    ) -> None:
        self.hub = LocalHub()
        self._make_bus = make_bus or (lambda: LocalBus(self.hub))
        self._scene = scene
        self.use(rules)
        self.tasks: dict[Part, asyncio.Task[None]] = {}
        self.gateways: dict[Part, Gateway] = {}
        self.urls: dict[Part, str] = {}
        self.clients: list[AsyncClient] = []
        self._names = 0

    def use(self, rules: Callable[[], Rules]) -> None:
        """Sets the rules of the sequencers that are started from now on."""
        self._rules = rules
        self.scene: Scene = prepared(rules(), load_scene(self._scene))

    def fresh(self) -> RecordedWorld:
        """Returns a new world with its terrain."""
        world = RecordedWorld(self.scene)
        world.load_terrain()
        return world

    def sequencer(self, *, begins: bool = True, **more: Any) -> SequencerPart:
        """Starts a sequencer or a standby."""
        rules = self._rules()
        prepared(rules, self.scene)
        bus = self._make_bus()
        return self._start(
            SequencerPart(bus, self.fresh(), name=self._name("sequencer"), rules=rules, begins=begins, **more)
        )

    async def edge(self, **more: Any) -> EdgePart:
        """Starts an edge that listens, and waits until it serves."""
        gateway = Gateway(game=None)  # type: ignore[arg-type] # set once the edge is ready
        _, port = await gateway.listen("127.0.0.1", 0)
        url = f"ws://127.0.0.1:{port}"
        part = self._start(EdgePart(self._make_bus(), self.fresh(), name=self._name("edge"), url=url, **more))
        gateway.game = part
        await asyncio.wait_for(part.ready.wait(), PATIENCE_S)
        self.gateways[part], self.urls[part] = gateway, url
        return part

    async def join(self, edge: EdgePart, name: str, before: Callable[[Core], None] | None = None) -> AsyncClient:
        """Connects a client that walks ahead."""
        walk = before or (lambda core: core.set_input(make_input(1.0, 0.0)))
        client = await AsyncClient.connect(self.urls[edge], name=name, before_update=walk)
        self.clients.append(client)
        return client

    def kill(self, part: Part) -> None:
        """Ends a part at once, and with it the connections of its clients."""
        self.tasks[part].cancel()
        part.stop()
        if part in self.gateways:
            for connection in list(self.gateways[part].connections):
                connection.abort()
            self.gateways[part].stop_listening()

    async def close(self) -> None:
        """Ends all clients and parts."""
        for client in self.clients:
            await client.close()
        for part, task in self.tasks.items():
            if not task.done():
                self.kill(part)
            with contextlib.suppress(asyncio.CancelledError, PartError):
                await task

    def _start(self, part: P) -> P:
        self.tasks[part] = asyncio.create_task(part.run())
        return part

    def _name(self, kind: str) -> str:
        self._names += 1
        return f"{kind}-{self._names}"


@pytest.fixture
async def cluster() -> AsyncIterator[Cluster]:
    """A cluster without parts yet."""
    made = Cluster()
    try:
        yield made
    finally:
        await made.close()
