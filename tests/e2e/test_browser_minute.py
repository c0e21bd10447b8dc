"""A minute of play in a real browser beside bots on a real server: nothing diverges, and inputs are used.

It prints what a minute costs (`pytest -s`): frames per second, and the client's share of a frame.
"""

import asyncio
import contextlib
import json
import random
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot, RunAndJump
from scripts.live_page.chromium import chromium, installed
from tests.client_sdk.servers import real_server

BROWSER = installed()
MINUTE_S = 60
BOTS = 12
JOIN_S = 240.0
pytestmark = [
    pytest.mark.e2e,
    pytest.mark.usefixtures("python_for_browsers"),
    pytest.mark.slow,
    pytest.mark.longest,
    pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine"),
]

PLAY = """(async () => {
  const {connect} = await import("/play/sovereign.js"), began = performance.now();
  const client = globalThis.mine = await connect({name: "Page"});
  const joined = performance.now() - began, causes = {}, shares = [], whole = [];
  client.addEventListener("event", ({detail}) => {
    if (detail.type === "Corrected") causes[detail.cause] = (causes[detail.cause] ?? 0) + 1;
    if (detail.type === "Diverged" || detail.type === "Left") causes[detail.type] = 1;
  });
  client.addEventListener("frame", () => {
    shares.push(1000 * client.stats.frame_s); whole.push(client.stats.worker_ms);
  });
  let turns = 0, drawn = 0;
  const end = performance.now() + SECONDS * 1000;
  await new Promise(done => {
    function draw(now) {
      const angle = Math.floor(now / 700) * 2.4;
      client.setInput(Math.cos(angle), Math.sin(angle), {buttons: {jump: Math.floor(now / 300) % 4 === 0}});
      if (client.view().me) drawn++;
      if (performance.now() < end) requestAnimationFrame(draw); else done();
    }
    requestAnimationFrame(draw);
  });
  const p = (list, share) => list.sort((a, b) => a - b)[Math.floor(list.length * share)];
  const told = {
    joined_s: joined / 1000, load_s: client.started.loadMs / 1000, start_s: client.started.startMs / 1000,
    memory_mb: client.started.memory / 1e6, kernel: client.started.kernel,
    drawn_per_s: drawn / SECONDS, views_per_s: shares.length / SECONDS, others: client.view().others.length,
    share_ms: [p(shares, 0.5), p(shares, 0.99)], worker_ms: [p(whole, 0.5), p(whole, 0.99)],
    stats: client.stats, causes, verdict: await client.verdict(),
  };
  client.close();
  return told;
})().then(found => found, error => ({failed: String(error)}))
  .then(found => { globalThis.told = JSON.stringify(found); })"""


def minute(url: str) -> dict[str, Any]:
    """Returns what the page knows after a minute."""
    assert BROWSER is not None
    with chromium(BROWSER) as tab:
        tab.open(f"{url.replace('ws:', 'http:')}/play", 1000, 700)
        tab.until("document.readyState === 'complete' && location.pathname === '/play'")
        tab.run("globalThis.told = null")
        tab.call("Runtime.evaluate", expression=PLAY.replace("SECONDS", str(MINUTE_S)))
        told = tab.until("globalThis.told", JOIN_S + MINUTE_S)
        assert tab.said == []
        return dict(json.loads(told))


@contextlib.asynccontextmanager
async def bots(url: str) -> AsyncIterator[list[AsyncClient]]:
    """Runs bots natively."""
    made = [
        await AsyncClient.connect(url, name=f"Bot {i}", before_update=Bot(RunAndJump(random.Random(i))), timeout=60.0)
        for i in range(BOTS)
    ]
    try:
        yield made
    finally:
        for client in made:
            await client.close()


async def test_a_minute_beside_bots() -> None:
    with real_server("--scene", "arena") as url:
        async with asyncio.timeout(JOIN_S + 3 * MINUTE_S), bots(url) as beside:
            found = await asyncio.to_thread(minute, url)
            native = [client.stats.corrections for client in beside]
    print(json.dumps(found | {"native corrections": native}, indent=1))
    assert "failed" not in found, found
    assert found["kernel"] == "prebuilt"
    assert found["others"] == BOTS
    assert found["stats"]["divergences"] == 0
    assert found["causes"].keys() <= {"late input", "other entity", "unknown edit", "server act", "missing terrain"}
    assert found["verdict"]["verdict"] != "diverging"
    assert found["views_per_s"] > 5


JOINS = """(async () => {
  const {connect} = await import("/play/sovereign.js");
  globalThis.types = [];
  globalThis.mine = await connect({name: "Page"});
  mine.addEventListener("event", ({detail}) => types.push(detail.type));
  globalThis.drawing = true;
  function draw() {
    mine.setInput(Math.cos(performance.now() / 900), Math.sin(performance.now() / 900));
    if (drawing) mine.view();
    requestAnimationFrame(draw);
  }
  draw();
})().catch(error => { globalThis.failed = String(error); })"""
AWAY_S = 17.0
"""Time for which the page is away, in seconds: longer than a server waits for a silent client."""


def away(url: str) -> dict[str, Any]:
    """Returns what happens to a page that does not draw, and to one that is frozen."""
    assert BROWSER is not None
    with chromium(BROWSER) as tab:
        tab.open(f"{url.replace('ws:', 'http:')}/play", 1000, 700)
        tab.until("document.readyState === 'complete' && location.pathname === '/play'")
        tab.call("Runtime.evaluate", expression=JOINS)
        tab.until("globalThis.failed || globalThis.mine?.view().me", JOIN_S)
        assert tab.run("globalThis.failed ?? ''") == ""
        tab.run("drawing = false; types.length = 0")
        time.sleep(AWAY_S)
        hidden = tab.run("types")
        tab.run("drawing = true; types.length = 0")
        time.sleep(1.0)
        tab.call("Page.setWebLifecycleState", state="frozen")
        time.sleep(AWAY_S)
        tab.call("Page.setWebLifecycleState", state="active")
        tab.until("mine.view().state === 'playing' && mine.stats.snapshot_age_s < 2 && mine.stats.rtt_s > 0", 60)
        before = tab.run("mine.view().me.position")
        tab.until(f"(([x, y]) => Math.hypot(x - {before[0]}, y - {before[1]}) > 0.5)(mine.view().me.position)", 60)
        return {
            "hidden": hidden,
            "frozen": tab.run("types"),
            "divergences": tab.run("mine.stats.divergences"),
            "said": tab.said,
        }


async def test_a_page_that_was_hidden_and_one_that_slept_play_on() -> None:
    with real_server("--scene", "flat") as url:
        async with asyncio.timeout(JOIN_S + 3 * MINUTE_S):
            found = await asyncio.to_thread(away, url)
    assert set(found["hidden"]) <= {"Corrected", "Resynchronised", "SegmentLoaded"}
    assert set(found["frozen"]) <= {"Corrected", "Resynchronised", "Disconnected", "Resumed", "Joined", "SegmentLoaded"}
    assert found["divergences"] == 0
    lost = "WebSocket connection to"  # the browser's own line about a connection that broke off
    assert [line for line in found["said"] if lost not in line] == []
