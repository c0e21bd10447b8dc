"""The server process dies and is started again. Its clients, in a game's loop and in an event loop, reconnect."""

import asyncio
import contextlib
import gc
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.client import Client
from client_sdk.events import Disconnected, Event, Joined, Left, Resumed
from scripts.soak_test.walkers import walk
from tests.client_sdk.servers import ROOT
from tests.e2e.processes import MOVING_BLOCKS, RECOVERY_S, Strider
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.e2e
COMMAND = (sys.executable, "-m", "server", "--host", "127.0.0.1", "--scene", "flat", "--log-level", "warning")


@contextlib.contextmanager
def server(data: Path, port: int = 0) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yields a server process and its URL. The process is killed at the end, as by a power cut."""
    flags = ("--port", str(port), "--data", str(data))
    with subprocess.Popen([*COMMAND, *flags], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("listening on "), "the server did not start"
            yield process, line.split()[-1]
        finally:
            process.kill()


def port_of(url: str) -> int:
    return int(url.rpartition(":")[2])


def happened(player: Strider, wanted: type[Event]) -> bool:
    return any(isinstance(event, wanted) for event in player.events)


@pytest.mark.slow
def test_a_client_in_a_games_loop_survives_its_server(tmp_path: Path) -> None:
    with server(tmp_path) as (process, url):
        client = Client.connect(url, name="Ann")
        player = Strider(client)
        player.plays(until=lambda: happened(player, Joined))
        me = client.entity
        assert player.plays(seconds=2) > MOVING_BLOCKS  # on disk by now
        process.kill()
        player.plays(until=lambda: happened(player, Disconnected))
        assert client.reconnecting
        assert client.view().me is not None, "there is something to draw all the time"
    with server(tmp_path, port_of(url)):
        player.plays(until=lambda: happened(player, Resumed))
        assert (client.entity, client.playing) == (me, True)
        player.plays(seconds=RECOVERY_S)
        used = client.stats.inputs_used
        assert player.plays(seconds=2) > MOVING_BLOCKS
        assert client.stats.inputs_used > used
        assert not happened(player, Left)
        client.close()


@pytest.mark.slow
def test_a_client_gives_up_after_its_patience(tmp_path: Path) -> None:
    with server(tmp_path) as (_, url):
        client = Client.connect(url, patience_s=1.0)
        player = Strider(client)
        player.plays(until=lambda: happened(player, Joined))
    player.plays(until=lambda: happened(player, Left))
    assert client.closed
    assert happened(player, Disconnected)


async def test_a_client_in_an_event_loop_survives_its_server(tmp_path: Path) -> None:
    loop, reported = asyncio.get_running_loop(), list[dict[str, Any]]()
    loop.set_exception_handler(lambda _, context: reported.append(context))
    with contextlib.ExitStack() as first:
        process, url = await loop.run_in_executor(None, first.enter_context, server(tmp_path))
        client = await AsyncClient.connect(url, name="Ann", before_update=walk)
        seen: list[Event] = []

        async def until(wanted: type[Event]) -> None:
            async with asyncio.timeout(PATIENCE_S):
                async for event in client:
                    seen.append(event)
                    if isinstance(event, wanted):
                        return

        await until(Joined)
        me = client.entity
        await asyncio.sleep(2)
        process.kill()
        await until(Disconnected)
    with contextlib.ExitStack() as second:
        await loop.run_in_executor(None, second.enter_context, server(tmp_path, port_of(url)))
        await until(Resumed)
        assert client.entity == me
        await asyncio.sleep(RECOVERY_S)
        used, way, place = client.stats.inputs_used, 0.0, client.view().me
        for _ in range(20):
            await asyncio.sleep(0.1)
            before, place = place, client.view().me
            assert before is not None
            assert place is not None
            way += math.dist(before.position, place.position)
        assert client.stats.inputs_used > used
        assert way > MOVING_BLOCKS
        await client.close()
        assert not any(isinstance(event, Left) for event in seen)
        gc.collect()
        assert reported == [], "failed attempts leave no exception that asyncio complains about"
