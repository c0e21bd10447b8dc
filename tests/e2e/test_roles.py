"""The roles of `sovereign-server` as real processes on a real NATS server."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from client_sdk.async_client import AsyncClient
from scripts.scale_lab.cluster import Cluster, PartProcess
from scripts.scale_lab.nats_server import binary
from shared.inputs import make_input
from tests.patience import PATIENCE_S, soon

pytestmark = [pytest.mark.e2e, pytest.mark.skipif(not binary(), reason="there is no nats-server here")]


@pytest.fixture
async def cluster(tmp_path: Path) -> AsyncIterator[Cluster]:
    """A world of a sequencer, an edge and a standby, not started yet."""
    made = Cluster(tmp_path, edges=1, arguments=("--scene", "flat"))
    try:
        yield made
    finally:
        made.close()


async def test_a_standby_takes_over_from_a_sequencer_that_was_killed(cluster: Cluster) -> None:
    await cluster.start()
    (edge,), (standby,) = cluster.edges, cluster.standbys
    other = PartProcess(cluster.folder, "edge9", ("--role", "edge", "--scene", "hills"))
    other.start(cluster.nats.url)
    client = await AsyncClient.connect(
        edge.url, name="Ann", before_update=lambda core: core.set_input(make_input(1.0, 0.0))
    )
    await soon(lambda: client.stats.inputs_used > 10)
    cluster.sequencer.kill()
    async with asyncio.timeout(PATIENCE_S):
        while not (await standby.stats())["leads"]:  # noqa: ASYNC110 - another process has no event for it
            await asyncio.sleep(0.1)
    used = client.stats.inputs_used
    await soon(lambda: client.stats.inputs_used > used + 20)
    assert client.stats.reconnects == 0
    await client.close()
    status, page = await standby.page("/metrics")
    assert (status, b"sovereign_tick " in page) == (200, True)
    assert b'sovereign_part{role="standby",world="world"} 1.0' in page
    assert b"sovereign_leads 1.0" in page
    assert b"sovereign_epoch 2.0" in page
    assert await asyncio.to_thread(other.wait, PATIENCE_S) == 2, "a part of another world does not start"
    assert "error: the world 'world' on the bus is another one (scene." in other.log.read_text("utf-8")
