"""The asyncio client on real loopback sockets, on asyncio's own loop and on uvloop."""

import asyncio
import random
import socket
import sys
import threading
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot, Wander
from client_sdk.core import Core
from client_sdk.events import Answered, Event, Joined, Left, Resumed
from client_sdk.transports import common
from client_sdk.transports.common import TIMEOUT_S, ConnectError
from shared import messages
from tests.client_sdk.servers import accept, real_server, request, scripted_server, silent_server
from tests.lengths import long
from tests.patience import PATIENCE_S, soon

pytestmark = pytest.mark.e2e

Run = Callable[[Coroutine[Any, Any, None]], None]
LOOPS = ["asyncio"] if sys.platform == "win32" else ["asyncio", *long("uvloop")]


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with real_server("--scene", "flat") as url:
        yield url


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Runs a coroutine with patience; the test runs once with each kind of event loop."""

    def limited(coroutine: Coroutine[Any, Any, None]) -> None:
        factory = pytest.importorskip("uvloop").new_event_loop if request.param == "uvloop" else None
        with asyncio.Runner(loop_factory=factory) as runner:
            runner.run(asyncio.wait_for(coroutine, PATIENCE_S))

    return limited


async def first(client: AsyncClient, kind: type[Event]) -> Any:
    async for event in client:
        if isinstance(event, kind):
            return event
    raise AssertionError(f"it ended without {kind.__name__}")


def test_a_player_joins_walks_and_leaves(url: str, run: Run) -> None:
    async def scene() -> None:
        async with await AsyncClient.connect(url, name="Ann") as client:
            joined = await first(client, Joined)
            assert joined.entity == client.entity
            before = client.view().me
            client.set_input(1, 0)
            goal = client.stats.inputs_sent + 32
            await soon(lambda: client.stats.inputs_sent >= goal)
            after = client.view().me
            assert before is not None
            assert after is not None
            assert after.position[0] - before.position[0] == pytest.approx(3.0, abs=0.8)
            assert client.stats.corrections == 0
            await client.close()
            events = [event async for event in client]
            assert events[-1] == Left(1000, "closed by this client")

    run(scene())


def test_a_block_is_placed_and_the_input_delay_changed(url: str, run: Run) -> None:
    async def scene() -> None:
        async with await AsyncClient.connect(url) as client:
            await first(client, Joined)
            client.set_input_delay(2)
            me = client.view().me
            assert me is not None
            x, y, z = (int(part // 1) for part in me.position)
            assert client.edit(x + 2, y, z + 2, 3) == 1
            assert await first(client, Answered) == Answered(1, True, "done")
            assert client.edit(x + 20, y, z, 3) == 2
            assert await first(client, Answered) == Answered(2, False, "out of reach")
            prediction = client.core.prediction
            assert prediction is not None
            await soon(lambda: prediction.confirmed.blocks.get(x + 2, y, z + 2) == 3)
            assert prediction.ahead == 2
            client.edit(x + 2, y, z + 2, 0)
            await first(client, Answered)

    run(scene())


def test_small_messages_are_not_held_back(url: str, run: Run) -> None:
    async def scene() -> None:
        async with await AsyncClient.connect(url) as client:
            assert client._transport is not None
            sock = client._transport.get_extra_info("socket")
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

    run(scene())


def test_bots_play_side_by_side_without_a_task_each(url: str, run: Run) -> None:
    async def scene() -> None:
        bots = [Bot(Wander(random.Random(seed))) for seed in range(8)]
        clients = await asyncio.gather(*(AsyncClient.connect(url, before_update=bot) for bot in bots))
        await soon(lambda: all(client.core.state == "playing" for client in clients))
        goal = max(client.stats.snapshots for client in clients) + 32
        await soon(lambda: all(client.stats.snapshots >= goal for client in clients))
        assert len(asyncio.all_tasks()) <= 2
        for client in clients:
            assert client.stats.snapshots_skipped == 0
            assert len(client.view().others) == 7
        await asyncio.gather(*(client.close() for client in clients))

    run(scene())


def test_a_server_that_vanishes_ends_the_events(run: Run) -> None:
    async def scene() -> None:
        client = await AsyncClient.connect(address)
        left = [event async for event in client][-1]
        assert isinstance(left, Left)
        assert "broke off" in left.reason
        await client.close()

    with scripted_server(accept) as address:
        run(scene())


def test_a_server_that_stops_reading_is_left(run: Run) -> None:
    over = threading.Event()

    def script(sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        accept(sock)
        over.wait(PATIENCE_S)

    async def scene() -> None:
        client = await AsyncClient.connect(address)
        while client.core.state != "closed":
            client.core._out.append(bytes(100_000))
            client._update()
            await asyncio.sleep(0)
        left = [event async for event in client][-1]
        assert isinstance(left, Left)
        assert left.code == messages.TOO_SLOW
        over.set()

    with scripted_server(script) as address:
        run(scene())


def test_a_refused_connection_reads_like_advice(run: Run) -> None:
    async def scene() -> None:
        with pytest.raises(ConnectError, match="start one with: sovereign-server"):
            await AsyncClient.connect(address)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"ws://127.0.0.1:{listener.getsockname()[1]}"
    run(scene())


def test_a_page_that_is_no_game_reads_like_advice(run: Run) -> None:
    def script(sock: socket.socket) -> None:
        request(sock)
        sock.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    async def scene() -> None:
        with pytest.raises(ConnectError, match="it is not a Sovereign Netcode server"):
            await AsyncClient.connect(address)

    with scripted_server(script) as address:
        run(scene())


def test_silence_ends_in_time(run: Run) -> None:
    over = threading.Event()

    async def scene() -> None:
        with pytest.raises(ConnectError, match="no answer in time"):
            await AsyncClient.connect(address, timeout=0.3)
        over.set()

    with scripted_server(lambda _: over.wait(PATIENCE_S)) as address:
        run(scene())


def test_a_task_that_stopped_waiting_can_wait_again(url: str, run: Run) -> None:
    async def scene() -> None:
        async with await AsyncClient.connect(url) as client:
            await first(client, Joined)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(anext(client), 0.05)
            await client.close()
            assert isinstance(await first(client, Left), Left)

    run(scene())


def test_an_error_in_before_update_is_reported_and_the_player_goes_on(url: str, run: Run) -> None:
    calls = 0

    def wrong(core: Core) -> None:
        nonlocal calls
        calls += 1
        raise LookupError("mine")

    async def scene() -> None:
        told: list[dict[str, Any]] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))
        async with await AsyncClient.connect(url, before_update=wrong) as client:
            await soon(lambda: calls >= 3 and client.stats.inputs_sent >= 2)
            assert client.playing
        assert {type(context["exception"]) for context in told} == {LookupError}

    run(scene())


def test_two_waiting_tasks_both_get_the_end(url: str, run: Run) -> None:
    async def scene() -> None:
        async def all_of(client: AsyncClient) -> int:
            return len([event async for event in client])

        client = await AsyncClient.connect(url)
        both = asyncio.gather(all_of(client), all_of(client))
        await soon(lambda: client.playing)
        await client.close()
        assert sum(await both) >= 2

    run(scene())


def test_a_way_that_has_become_silent_ends(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "SILENCE_S", 0.3)

    async def scene() -> None:
        client = await AsyncClient.connect(address)
        (left,) = [event async for event in client]
        assert isinstance(left, Left)
        assert left.reason == "nothing received for 0.3 s"

    with silent_server() as address:
        run(scene())


def test_a_client_whose_dial_takes_longer_than_a_tick_reconnects_at_once(run: Run) -> None:
    async def scene(url: str) -> None:
        client = await AsyncClient.connect(url)
        await first(client, Joined)
        connect = client._loop.create_connection

        async def slowly(*arguments: Any, **options: Any) -> Any:
            await asyncio.sleep(0.2)  # the client predicts on meanwhile
            return await connect(*arguments, **options)

        client._loop.create_connection = slowly  # type: ignore[method-assign]
        assert client._transport is not None
        client._transport.abort()
        resumed = await first(client, Resumed)
        assert resumed.away_s < TIMEOUT_S, "the first attempt has succeeded"
        await client.close()

    with real_server("--scene", "flat") as url:
        run(scene(url))
