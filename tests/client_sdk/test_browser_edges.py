"""The client for a page, handed over between two edges of one world, in simulated time."""

from typing import Any

from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.scale.edge import EdgeServer
from server.scale.replica import Replica
from server.scale.sequencer import WorldSequencer, begin_record
from server.scale.wire import Record, record_of
from shared.scene import load_scene
from tests.client_sdk.test_browser import Page

LEAD_S = 0.01


class TwoEdges:
    """A sequencer and two edges, which step together; a `LocalWorlds` for a page."""

    def __init__(self) -> None:
        self.world = RecordedWorld(load_scene("flat"))
        self.world.load_terrain()
        replica = Replica(self.world, PersistedState())
        self.edges = [EdgeServer(name, replica.copy(), address=f"ws://{name}:8765") for name in ("one", "two")]
        self._follow(record_of(begin_record(replica)[1]), 0.0)
        self.core = WorldSequencer(self.world)
        self._due: float | None = None

    def advance(self, now: float) -> None:
        """Runs the ticks that are due."""
        self._due = now if self._due is None else self._due
        while self._due <= now:
            for edge in self.edges:
                batch = edge.collect(self._due - LEAD_S, self._due)
                if batch is not None:
                    self.core.receive(batch, self._due)
            self._follow(record_of(self.core.tick(self._due)), self._due)
            self._due += 1 / self.world.scene.tick_rate

    def route(self, place: str, now: float) -> Any:
        """Returns the edge at an address; the first one at the page's own address."""
        return self.edges[1 if place.startswith("ws://two:8765/") else 0]

    def _follow(self, record: Record, now: float) -> None:
        for edge in self.edges:
            edge.follow(record, now)


def test_a_page_is_handed_over_without_a_pause_and_finds_another_edge_after_a_loss() -> None:
    worlds = TwoEdges()
    page: Any = Page(worlds, name="Ann", patience_s=30.0)  # type: ignore[arg-type]
    page.run(2)
    entity = page.client.entity
    first, second = worlds.edges
    first.drain()
    page.run(4)
    assert page.types() == ["Joined", "HandedOver"]
    assert (first.drained, second.drained) == (True, False)
    assert [socket.url for socket in page.sockets] == ["ws://two:8765/"]
    assert page.head("corrections") == page.head("divergences") == 0
    first.moves.draining = False
    page.run(1)
    page.sockets[0].over = 1006, ""
    page.run(3)
    assert page.types()[2:] == ["Disconnected", "Resumed"]
    assert [socket.url for socket in page.sockets] == ["ws://one:8765/"]
    assert (page.state, page.client.entity) == ("playing", entity)
