"""Tests of the parts of a world in one event loop, with real sockets for the clients."""

import asyncio
from typing import Any

import pytest

from client_sdk.events import Answered, Disconnected, Event
from server.cluster import sequencer as sequencer_module
from server.cluster.bus import BusError
from server.cluster.edge import BEHIND
from server.cluster.identity import IdentityError, identity_of, join_world
from server.cluster.local_bus import LocalBus, LocalHub
from server.cluster.part import PartError
from server.cluster.sequencer import SequencerPart
from server.journal.recorded_world import RecordedWorld
from server.scale.wire import record_of
from server.scale.writer import UNACKNOWLEDGED_MAX, Entry
from shared.scene import load_scene
from tests.patience import PATIENCE_S, soon
from tests.server.cluster.conftest import Cluster

pytestmark = pytest.mark.e2e


class DeafBus(LocalBus):
    """A bus that does not answer while `deaf` is set."""

    deaf = False

    async def append(self, entry: Entry) -> int:
        if self.deaf:
            raise BusError("deaf")
        return await super().append(entry)

    async def end(self) -> tuple[int, str]:
        if self.deaf:
            raise BusError("deaf")
        return await super().end()


async def test_two_edges_serve_one_world(cluster: Cluster) -> None:
    cluster.sequencer()
    first, second = await cluster.edge(), await cluster.edge()
    ann, bob = await cluster.join(first, "Ann"), await cluster.join(second, "Bob")
    await soon(lambda: len(ann.view().others) == len(bob.view().others) == 1)
    await soon(lambda: ann.stats.inputs_used > 30 and bob.stats.inputs_used > 30)
    assert ann.entity != bob.entity
    assert set(first.players) == set(second.players) == {ann.entity, bob.entity}
    assert first.others() == [cluster.urls[second]]
    assert first.stats()["clients"] == 1


async def test_a_standby_takes_over_and_the_players_go_on(cluster: Cluster) -> None:
    sequencer, edge = cluster.sequencer(), await cluster.edge()
    standbys = [cluster.sequencer(begins=False) for _ in range(2)]
    ann = await cluster.join(edge, "Ann")
    await soon(lambda: ann.stats.inputs_used > 10)
    cluster.kill(sequencer)
    await soon(lambda: any(standby.core for standby in standbys))
    tick = edge.world.tick
    number = ann.edit(0, 0, 0, 1)
    await soon(lambda: edge.world.tick > tick + 20)
    events = await _up_to(ann, Answered)
    events += [event async for event in _so_far(ann)]
    assert [event.number for event in events if isinstance(event, Answered)] == [number]
    assert not any(isinstance(event, Disconnected) for event in events)
    assert sum(standby.core is not None for standby in standbys) == 1
    ticks = [record.tick for record in map(record_of, _records(cluster.hub)) if record.journal is not None]
    assert ticks == list(range(1, len(ticks) + 1))


async def test_a_deposed_sequencer_ends(cluster: Cluster) -> None:
    bus = DeafBus(cluster.hub)
    cluster._make_bus = lambda: bus
    old = cluster.sequencer()
    await asyncio.wait_for(old.leads.wait(), PATIENCE_S)
    cluster._make_bus = lambda: LocalBus(cluster.hub)
    new = cluster.sequencer(begins=False)
    await soon(lambda: new.following.seq > 3)
    bus.deaf = True
    await asyncio.wait_for(new.leads.wait(), PATIENCE_S)
    bus.deaf = False
    with pytest.raises(PartError, match="another sequencer"):
        await asyncio.wait_for(asyncio.shield(cluster.tasks[old]), PATIENCE_S)
    assert new.core is not None
    assert new.core.epoch == 2


async def test_time_stands_still_while_the_bus_does_not_answer(cluster: Cluster) -> None:
    bus = DeafBus(cluster.hub)
    cluster._make_bus = lambda: bus
    sequencer = cluster.sequencer()
    await asyncio.wait_for(sequencer.leads.wait(), PATIENCE_S)
    await soon(lambda: cluster.hub.newest.seq > 5)
    bus.deaf = True
    await soon(lambda: sequencer.still > 3)
    durable = record_of(cluster.hub.newest.data).tick
    assert sequencer.world.tick == durable + UNACKNOWLEDGED_MAX
    assert sequencer.unready() != ""
    bus.deaf = False
    await soon(lambda: record_of(cluster.hub.newest.data).tick > durable + 20)
    ticks = [record_of(data).tick for data in _records(cluster.hub)][1:]
    assert ticks == list(range(1, len(ticks) + 1))
    await soon(lambda: sequencer.unready() == "")


async def test_a_new_edge_begins_with_a_checkpoint(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequencer_module, "KEPT_S", 0.1)
    cluster.sequencer()
    first = await cluster.edge()
    standby = cluster.sequencer(begins=False, checkpoint_s=0.5)
    ann = await cluster.join(first, "Ann")
    await soon(lambda: standby.checkpoints > 1 and ann.stats.inputs_used > 10)
    assert 1 not in cluster.hub.log
    late = await cluster.edge()
    assert late.players[ann.entity].name == "Ann"
    bob = await cluster.join(late, "Bob")
    await soon(lambda: len(ann.view().others) == len(bob.view().others) == 1)


async def test_an_edge_that_is_behind_sends_its_clients_away(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster.sequencer()
    edge = await cluster.edge()
    ann = await cluster.join(edge, "Ann")
    await soon(lambda: ann.stats.inputs_used > 5)
    monkeypatch.setattr(edge, "_shed_at", 3)
    assert edge.core is not None
    await soon(lambda: edge.following.reader is not None and edge.following.reader.waiting == 0)
    edge._look_whether_behind(edge.core, 5)
    assert edge.shedding
    assert edge.unready().startswith("behind")
    await soon(lambda: not edge.shedding)
    events = await _up_to(ann, Disconnected)
    assert isinstance(events[-1], Disconnected)
    assert events[-1].reason == BEHIND
    assert edge.sheds >= 1  # a busy machine can make it fall behind once more


async def test_a_part_of_another_world_is_refused() -> None:
    bus = LocalBus(LocalHub())
    hills, flat = load_scene("hills"), load_scene("flat")
    mine = identity_of(hills, seed=1, game="", options={})
    await join_world(bus, "arena", mine)
    await join_world(bus, "arena", mine)
    with pytest.raises(IdentityError, match=r"'arena'.*seed: 2 here, 1 there"):
        await join_world(bus, "arena", identity_of(hills, seed=2, game="", options={}))
    with pytest.raises(IdentityError, match=r"scene\."):
        await join_world(bus, "arena", identity_of(flat, seed=1, game="", options={}))
    await join_world(bus, "other", identity_of(flat, seed=1, game="", options={}))


def _records(hub: LocalHub) -> list[bytes]:
    return [stored.data for stored in hub.log.values()]


async def _up_to(client: Any, kind: type[Event]) -> list[Event]:
    """Returns the events up to the next of a kind."""
    events: list[Event] = []
    async with asyncio.timeout(PATIENCE_S):
        while not (events and isinstance(events[-1], kind)):
            events.append(await anext(client))
    return events


async def _so_far(client: Any) -> Any:
    """Yields the events that have come so far."""
    while True:
        try:
            yield await asyncio.wait_for(anext(client), 0.05)
        except (TimeoutError, StopAsyncIteration):
            return


@pytest.mark.parametrize(("scene", "given", "waits"), [("flat", 1.5, 1.5), ("flat", 0.01, 3 / 32)])
async def test_a_standby_waits_as_long_as_it_is_told_and_for_some_ticks(scene: str, given: float, waits: float) -> None:
    world = RecordedWorld(load_scene(scene))
    part = SequencerPart(LocalBus(LocalHub()), world, name="a", takeover_s=given)
    waited: list[float] = []

    async def silent(wait_s: float) -> None:
        waited.append(wait_s)
        raise asyncio.CancelledError

    part.following.next = silent  # type: ignore[method-assign]
    with pytest.raises(asyncio.CancelledError):
        await part.run()
    assert waited == [pytest.approx(waits)]
