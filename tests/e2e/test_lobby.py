"""The lobby example on a real server: two players meet in the ring, duel in a world of their own, and come back.

The settings are those of docs/worlds.md, and a real browser shows the worlds and their players.
"""

import asyncio
import random
from pathlib import Path
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot
from client_sdk.events import Joined, Moved
from scripts.live_page.chromium import chromium, installed
from sovereign_netcode.examples.lobby import Walker
from tests.client_sdk.servers import real_server
from tests.readme.pages import programs

pytestmark = pytest.mark.e2e
CELLS = "[...document.querySelectorAll('#rows tr')].map(row => [...row.cells].map(cell => cell.textContent))"


async def visits(url: str, name: str, seed: int, enough: asyncio.Event) -> list[Any]:
    """Plays until `enough` is set and the player is back in the hall. Returns its joins and moves."""
    client = await AsyncClient.connect(url, name=name, before_update=Bot(Walker(random.Random(seed))), timeout=60.0)
    seen: list[Any] = []
    async with client:
        async for event in client:
            if isinstance(event, Joined | Moved):
                seen.append(event)
            if enough.is_set() and isinstance(event, Joined) and client.world == "" and len(seen) > 2:
                assert client.core.stats.divergences == 0
                return seen
    raise AssertionError(seen)


@pytest.fixture
def settings(tmp_path: Path) -> str:
    """The file with the settings that the page shows."""
    (file := tmp_path / "lobby.toml").write_text(programs("toml")["Kinds"], "utf-8")
    return str(file)


async def test_two_players_duel_and_come_back(settings: str) -> None:
    with real_server("--config", settings) as url:
        enough = asyncio.Event()
        enough.set()
        async with asyncio.timeout(180):
            ann, bob = await asyncio.gather(visits(url, "Ann", 1, enough), visits(url, "Bob", 2, enough))
    for seen in (ann, bob):
        there, back = (event for event in seen[:4] if isinstance(event, Moved))
        assert (there.world, there.reason) == ("duel-1", "a duel")
        assert back.world == ""
        assert [type(event) for event in seen[:5]] == [Joined, Moved, Joined, Moved, Joined]
    assert sorted({event.reason for seen in (ann, bob) for event in seen[3:4]}) in (
        ["the duel is over", "you won the duel"],
        ["the duel is over"],
    )


@pytest.mark.slow
@pytest.mark.skipif(installed() is None, reason="there is no Chromium on this machine")
async def test_a_browser_shows_the_worlds_and_their_players(settings: str) -> None:
    browser = installed()
    assert browser is not None

    def rows(address: str) -> tuple[list[list[str]], list[str]]:
        with chromium(browser) as tab:
            tab.open(f"{address}/worlds/", 900, 500)
            tab.until(f"{CELLS}.some(row => row[5] === 'Ann, Bob' || row[5] === 'Bob, Ann')", 120)
            return tab.run(CELLS), tab.said

    with real_server("--config", settings) as url:
        enough = asyncio.Event()
        async with asyncio.timeout(240):
            playing = asyncio.gather(visits(url, "Ann", 3, enough), visits(url, "Bob", 4, enough))
            shown, said = await asyncio.to_thread(rows, url.replace("ws:", "http:"))
            enough.set()
            await playing
    assert said == []
    (row,) = (row for row in shown if "Ann" in row[5])
    assert row[0].startswith("duel-")
    assert row[1:4] == ["duel", "2 / 2", "locked"]
    assert row[9] == "0"
