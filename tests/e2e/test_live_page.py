"""The live page in a real browser: it draws the ground, and a bot moves on it."""

import asyncio
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot, RunAndJump
from scripts.live_page.chromium import chromium, installed
from tests.client_sdk.servers import ROOT, real_server

BROWSER = installed()
pytestmark = [pytest.mark.e2e, pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine")]

SPOT = "[...document.querySelectorAll('#players td')].map(cell => cell.textContent)"
PAINTED = """(() => {
  const {data} = ground.getContext("2d").getImageData(0, 0, ground.width, ground.height);
  return [data.length / 4, data.filter((_, i) => i % 4 === 3 && data[i] === 255).length];
})()"""


def seen(browser: str, url: str) -> dict[str, Any]:
    """Returns the content of the page, once it has shown the bot in five places."""
    with chromium(browser) as tab:
        tab.open(url, 1200, 800)
        tab.until("have && have.every(tile => tile.version >= 0) && !repaint")
        tab.until("charts[0].points.length > 2 && document.querySelectorAll('#players tr').length === 2")
        spots = []
        for _ in range(5):
            spots.append(tab.run(SPOT))
            tab.until(f"{SPOT}[1] !== {spots[-1][1]!r}")
        middle = "toScreen(...frames.at(-1).at.get(state.players[0]).slice(1, 3))"
        return {
            "spots": spots,
            "painted": tab.run(PAINTED),
            "clients": tab.run("charts[2].points.at(-1)[0]"),
            "on_screen": tab.run(f"(([x, y]) => x > 0 && y > 0 && x < 856 && y < 800)({middle})"),
            "markup": tab.run("document.querySelectorAll('#players b, #players img').length"),
            "foreign": tab.run(
                "performance.getEntriesByType('resource').filter(r => !r.name.startsWith(origin)).length"
            ),
            "said": tab.said,
        }


async def test_a_bot_is_seen_running() -> None:
    with real_server("--scene", "flat") as url:
        name = "<img src=x><b>Ann"
        async with asyncio.timeout(120):
            ann = await AsyncClient.connect(
                url, name=name, before_update=Bot(RunAndJump(random.Random(1))), timeout=60.0
            )
            bob = await AsyncClient.connect(url, name="Bob", timeout=60.0)
            assert BROWSER is not None
            found = await asyncio.to_thread(seen, BROWSER, url.replace("ws:", "http:"))
            await ann.close()
            await bob.close()
    assert found["said"] == [], "there is no exception, and no load that the policy forbids"
    assert found["painted"] == [128 * 128, 128 * 128]
    assert found["clients"] == 2
    assert found["on_screen"]
    assert (found["markup"], found["foreign"]) == (0, 0)
    names = {(spot[0], spot[2]) for spot in found["spots"]}
    assert names == {(name, "Bob")}, "a name is shown as text, whatever it contains"
    assert len({spot[1] for spot in found["spots"]}) == 5, "Ann is in another place each time"
    assert len({spot[3] for spot in found["spots"]}) == 1, "Bob stands"


@pytest.mark.slow
def test_the_picture_of_the_readme_is_made_by_its_script(tmp_path: Path) -> None:
    picture = tmp_path / "live.png"
    command = [sys.executable, "scripts/live_picture.py", "--seconds", "1", "--out", str(picture)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    data = picture.read_bytes()
    assert data.startswith(b"\x89PNG")
    assert (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) == (1400, 860)
    assert len(data) > 50_000, "the picture is not empty"
