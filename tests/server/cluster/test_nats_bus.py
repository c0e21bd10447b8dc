"""Tests of the bus on a real NATS server."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import nats
import pytest

from scripts.scale_lab.nats_server import NatsServer, binary
from server.cluster import nats_bus
from server.cluster.bus import Bus, BusError, ConflictError, PurgedError, RefusedError, Revised, Snapshot
from server.cluster.local_bus import LocalBus, LocalHub
from server.cluster.nats_bus import NatsBus
from server.scale.writer import EMPTY, Entry, LogWriter
from tests.patience import soon
from tests.server.cluster.conftest import Cluster

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(not binary(), reason="there is no nats-server here")]


@pytest.fixture
async def server(tmp_path: Path) -> AsyncIterator[NatsServer]:
    """A NATS server of its own."""
    made = NatsServer(tmp_path)
    await made.start()
    try:
        yield made
    finally:
        made.kill()


@contextlib.asynccontextmanager
async def connected(server: NatsServer, world: str = "arena") -> AsyncIterator[NatsBus]:
    """Connects to a server for the length of the context."""
    bus = await NatsBus.connect(server.url, world)
    try:
        yield bus
    finally:
        await bus.close()


async def test_the_log_accepts_a_record_behind_its_newest_only(server: NatsServer) -> None:
    async with connected(server) as bus, connected(server) as other:
        assert await bus.end() == (0, EMPTY)
        writer = LogWriter("a", EMPTY)
        first, second = writer.add(1, 0, b"zero"), writer.add(1, 1, b"one")
        assert [await bus.append(first), await bus.append(first)] == [1, 1]
        with pytest.raises(RefusedError) as refusal:
            await other.append(Entry("1:0:b", EMPTY, b""))
        assert refusal.value.last == first.id
        assert await bus.append(second) == 2
        third = writer.add(1, 2, b"two")
        for entry in (Entry("1:2:b", first.id, b""), Entry("1:1:b", "1:0:b", b"")):
            with pytest.raises(RefusedError) as refusal:
                await other.append(entry)
            assert refusal.value.last == second.id
        appended = await asyncio.gather(bus.append(third), bus.append(writer.add(1, 3, b"three")))
        assert list(appended) == [3, 4]
        assert await other.end() == (4, "1:3:a")


async def test_a_reader_gets_what_it_has_missed_and_nothing_that_was_refused(server: NatsServer) -> None:
    async with connected(server) as bus, connected(server) as other:
        writer = LogWriter("a", EMPTY)
        entries = [writer.add(1, tick, b"%d" % tick) for tick in range(40)]
        for entry in entries[:20]:
            await bus.append(entry)
        reader = await other.follow(11)
        with contextlib.suppress(RefusedError):
            await other.append(Entry("1:9:b", "1:8:a", b"refused"))
        for entry in entries[20:]:
            await bus.append(entry)
        got = [await reader.take(2.0) for _ in range(30)]
        assert [(each.seq, each.id) for each in got if each] == [(at + 1, entries[at].id) for at in range(10, 40)]
        assert reader.waiting == 0
        assert await reader.take(0.05) is None


async def test_a_server_that_was_killed_goes_on(server: NatsServer) -> None:
    async with connected(server) as bus, connected(server) as other:
        writer, reader = LogWriter("a", EMPTY), await other.follow(1)
        entries = [writer.add(1, tick, b"") for tick in range(8)]
        for entry in entries[:4]:
            await bus.append(entry)
        server.kill()
        with pytest.raises(BusError):
            await bus.append(entries[4])
        with pytest.raises(BusError):
            await other.end()
        await server.start()
        seq = 0
        while seq < 8:  # as the writer does
            try:
                seq = await bus.append(entries[max(seq, 4)])
            except BusError:
                await asyncio.sleep(0.02)
        with pytest.raises(RefusedError):
            await other.append(Entry("1:4:b", entries[3].id, b""))
        assert [each.seq for _ in range(8) if (each := await reader.take(5.0))] == [*range(1, 9)]


async def test_a_checkpoint_replaces_the_one_before_and_the_log_up_to_it(server: NatsServer) -> None:
    async with connected(server) as bus, connected(server) as other:
        assert await bus.checkpoint() is None
        writer = LogWriter("a", EMPTY)
        for tick in range(20):
            await bus.append(writer.add(1, tick, b""))
        big = bytes(range(256)) * 2000
        await bus.put_checkpoint(Snapshot(8, big), 2)
        assert await other.checkpoint() == Snapshot(8, big)
        await other.put_checkpoint(Snapshot(15, b"new"), 5)
        await bus.put_checkpoint(Snapshot(12, b"old"), 5)
        assert await bus.checkpoint() == Snapshot(15, b"new")
        reader = await bus.follow(10)
        assert await reader.take(2.0) is not None
        with pytest.raises(PurgedError):
            await (await bus.follow(9)).take(2.0)


@pytest.mark.slow
@pytest.mark.parametrize("step", ["put a key", "put an object", "delete", "purge"])
@pytest.mark.parametrize("done", [False, True])
async def test_a_part_that_is_killed_while_it_saves_a_checkpoint(
    server: NatsServer, monkeypatch: pytest.MonkeyPatch, step: str, done: bool
) -> None:
    """A checkpoint and the records after it are there at every time. The next checkpoint removes what is left over."""
    async with connected(server) as bus, connected(server) as other:
        writer = LogWriter("a", EMPTY)
        for tick in range(30):
            await bus.append(writer.add(1, tick, b""))
        old, new = Snapshot(8, bytes(300_000)), Snapshot(15, bytes(range(256)) * 2000)
        await bus.put_checkpoint(old, 2)
        at, name = {
            "put an object": (bus._store, "put"),
            "put a key": (bus, "put"),
            "delete": (bus._store, "delete"),
            "purge": (bus._js, "purge_stream"),
        }[step]
        plain = getattr(at, name)

        async def killed(*arguments: object, **named: object) -> None:
            inside = step == "purge" and arguments[0] != bus._stream  # of the removal of an object
            if done or inside:
                await plain(*arguments, **named)
            if not inside:
                raise asyncio.CancelledError

        with monkeypatch.context() as patch:
            patch.setattr(at, name, killed)
            with pytest.raises(asyncio.CancelledError):
                await bus.put_checkpoint(new, 2)
        found = await other.checkpoint()
        assert found == (new if step in ("delete", "purge") else old)
        reader = await other.follow(found.seq + 1)
        rest = range(found.seq + 1, 31)
        assert [each.seq for _ in rest if (each := await reader.take(5.0))] == [*rest]
        await other.put_checkpoint(Snapshot(25, b"newest"), 2)
        assert await other.checkpoint() == Snapshot(25, b"newest")
        state = (await other._js.stream_info(f"OBJ_{other._store._name}", subjects_filter="$O.>")).state
        chunks = [subject for subject in state.subjects or () if ".C." in subject]
        assert len(chunks) == 1, "no other checkpoint is left"


async def test_keys(server: NatsServer) -> None:
    async with connected(server) as bus, connected(server, "other") as other:
        seen: list[tuple[str, Revised | None]] = []

        async def watch() -> None:
            async for change in other.watch("arena.edge."):
                seen.append(change)  # noqa: PERF401 - the list grows while it is read

        revision = await bus.put("arena.edge.one", b"1", 0)
        with pytest.raises(ConflictError):
            await other.put("arena.edge.one", b"2", 0)
        watching = asyncio.create_task(watch())
        await soon(lambda: seen == [("arena.edge.one", Revised(b"1", revision))])
        revision = await other.put("arena.edge.one", b"2", revision)
        await bus.put("arena.identity", b"x")
        third = await bus.put("arena.edge.two", b"3")
        with pytest.raises(ConflictError):
            await bus.put("arena.edge.one", b"4", revision - 1)
        await soon(lambda: len(seen) == 3)
        await bus.delete("arena.edge.two")
        await soon(lambda: len(seen) == 4)
        assert seen[1:] == [
            ("arena.edge.one", Revised(b"2", revision)),
            ("arena.edge.two", Revised(b"3", third)),
            ("arena.edge.two", None),
        ]
        assert await bus.get("arena.edge.one") == Revised(b"2", revision)
        assert await bus.get("arena.edge.two") is None
        await bus.put("arena.edge.two", b"5", 0)
        watching.cancel()


async def test_keys_are_read_after_a_change_is_stored(server: NatsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_bus, "LIST_S", 600.0)
    async with connected(server) as bus, connected(server, "other") as other:
        read: list[str] = []
        get, seen = other.get, list[bytes]()

        async def counted(key: str) -> Revised | None:
            read.append(key)
            if read.count(key) == 2:
                raise BusError("no answer")
            return await get(key)

        async def watch() -> None:
            async for _, found in other.watch("arena."):
                seen.append(found.value if found else b"")

        monkeypatch.setattr(other, "get", counted)
        await bus.put("arena.key", b"0")
        watching = asyncio.create_task(watch())
        await soon(lambda: seen == [b"0"])
        with pytest.raises(ConflictError):
            await bus.put("arena.key", b"refused", 77)
        await bus.put("arenas.key", b"of another prefix")
        for number in range(1, 20):
            await bus.put("arena.key", b"%d" % number)
            await soon(lambda number=number: seen[-1] == b"%d" % number)  # type: ignore[misc]
        assert read == ["arena.key"] * 21, "one reading per stored change, and one again after an error"
        watching.cancel()


async def test_a_bucket_of_an_earlier_version(server: NatsServer) -> None:
    client = await nats.connect(server.url)
    await client.jetstream().create_key_value(bucket=nats_bus.BUCKET)
    await client.close()
    async with connected(server) as bus, connected(server, "other") as other:
        changes = other.watch("arena.")
        first = asyncio.ensure_future(anext(changes))
        await soon(lambda: other._client.stats["out_msgs"] > 0 and not first.done())
        revision = await bus.put("arena.key", b"1")
        assert await first == ("arena.key", Revised(b"1", revision))
        revision = await bus.put("arena.key", b"2")
        assert await anext(changes) == ("arena.key", Revised(b"2", revision))
        await changes.aclose()  # type: ignore[attr-defined]


async def check_compare_and_set(bus: Bus, other: Bus) -> None:
    """Checks what a lease needs of the keys of a bus."""
    first = await bus.put("fleet.a.process.x", b"1", 0)
    second = await bus.put("fleet.a.process.x", b"2", first)
    with pytest.raises(ConflictError):
        await other.delete("fleet.a.process.x", first)
    assert await other.all("fleet.a.") == {"fleet.a.process.x": Revised(b"2", second)}
    await other.delete("fleet.a.process.x", second)
    with pytest.raises(ConflictError):
        await bus.put("fleet.a.process.x", b"3", second)
    with pytest.raises(ConflictError):
        await bus.delete("fleet.a.process.x", second)
    assert await bus.all("fleet.a.") == {}
    again = await asyncio.gather(
        *(one.put("fleet.a.world.arena", b"%d" % at, 0) for at, one in enumerate((bus, other) * 4)),
        return_exceptions=True,
    )
    assert sum(isinstance(each, ConflictError) for each in again) == 7, "only one creates a key"
    assert [*await bus.all("fleet.a.")] == ["fleet.a.world.arena"]


async def test_the_keys_of_nats_are_compared_and_set(server: NatsServer) -> None:
    buses = [await NatsBus.connect(server.url, name, log=False) for name in ("one", "two")]
    await check_compare_and_set(*buses)
    for bus in buses:
        await bus.close()


async def test_the_keys_of_a_local_bus_are_compared_and_set() -> None:
    hub = LocalHub()
    await check_compare_and_set(LocalBus(hub), LocalBus(hub))


async def test_an_address_without_a_server_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nats_bus, "CONNECT_S", 0.3)
    with pytest.raises(BusError, match=r"bus = 'nats://127\.0\.0\.1:9'"):
        await NatsBus.connect("nats://127.0.0.1:9", "arena")
    with pytest.raises(BusError, match=r"world = 'a\.b'"):
        await NatsBus.connect("nats://127.0.0.1:9", "a.b")


async def test_the_parts_of_a_world_on_nats(server: NatsServer) -> None:
    buses = [await NatsBus.connect(server.url, "arena") for _ in range(3)]
    made = Cluster(iter(buses).__next__)
    try:
        sequencer, edge = made.sequencer(), await made.edge()
        standby = made.sequencer(begins=False)
        ann = await made.join(edge, "Ann")
        await soon(lambda: ann.stats.inputs_used > 10)
        made.kill(sequencer)
        await buses[0].close()
        await soon(lambda: standby.core is not None)
        used = ann.stats.inputs_used
        await soon(lambda: ann.stats.inputs_used > used + 10)
        assert ann.stats.reconnects == 0
    finally:
        await made.close()
        for bus in buses:
            await bus.close()
