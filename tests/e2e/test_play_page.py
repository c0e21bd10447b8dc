"""The page /play in a real browser: it loads Python, joins a real server, and a person plays with keys or by touch.

It takes Python for browsers from the package registries, as `scripts/browser` does.
"""

import asyncio
import contextlib
import json
import math
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import trustme

from scripts.browser_build.packages import FetchError, npm_package
from scripts.live_page.chromium import Tab, chromium, installed
from tests.client_sdk.servers import ROOT, real_server

BROWSER = installed()
JOIN_S = 240.0
"""Longest time until the page has joined, in seconds. It takes 10 s on a machine that does nothing else."""
pytestmark = [
    pytest.mark.e2e,
    pytest.mark.usefixtures("python_for_browsers"),
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine"),
]
ME = "globalThis.play?.view?.me"
PLACE = f"{ME}?.position"


def stats(url: str) -> dict[str, Any]:
    with urllib.request.urlopen(url.replace("ws:", "http:") + "/stats", timeout=30) as answer:
        return dict(json.load(answer))


def played(
    url: str, play: Callable[[Tab], None], width: int, height: int, *flags: str, phone: bool = False
) -> dict[str, Any]:
    """Opens the page in a browser with further flags, plays, and returns what it then knows."""
    assert BROWSER is not None
    with chromium(BROWSER, *flags) as tab:
        if phone:
            tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=5)
        tab.open(f"{url.replace('ws', 'http', 1)}/play", width, height, scale=2.0 if phone else 1.0, phone=phone)
        tab.until("document.readyState === 'complete' && location.pathname === '/play'")
        tab.run("document.getElementById('name').value = '<b>Ann'")
        tab.run("document.getElementById('go').click()")
        tab.until(f"{ME} || document.getElementById('trouble').textContent", JOIN_S)
        assert tab.run("document.getElementById('trouble').textContent") == ""
        play(tab)
        return {
            "stats": tab.run("play.client.stats"),
            "kernel": tab.run("play.client.started.kernel"),
            "name": tab.run(f"{ME}.attributes.name"),
            "markup": tab.run("document.querySelectorAll('b:not(#title):not(#keys b)').length"),
            "foreign": tab.run(
                "performance.getEntriesByType('resource').filter(r => !r.name.startsWith(origin)).length"
            ),
            "coloured": tab.run(COLOURS),
            "said": tab.said,
        }


COLOURS = """(() => {
  const {data} = picture.getContext("2d").getImageData(0, 0, picture.width, picture.height), found = new Set();
  for (let at = 0; at < data.length; at += 4 * 97) found.add(data[at] << 16 | data[at + 1] << 8 | data[at + 2]);
  return found.size;
})()"""


def walked(tab: Tab, blocks: float) -> None:
    """Waits until the player has walked so far."""
    start = tab.run(PLACE)
    tab.until(f"(([x, y]) => Math.hypot(x - {start[0]}, y - {start[1]}) > {blocks})({PLACE})", 60)


def key(tab: Tab, code: str, *, down: bool) -> None:
    tab.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=code[-1].lower())


GAMEPAD = (
    """navigator.getGamepads = () => [null, {connected: true, axes: [-0.7, 0.6, 0, 0], buttons: [{pressed: true}]}]"""
)


async def test_tag_with_the_keyboard_and_a_gamepad() -> None:
    def play(tab: Tab) -> None:
        key(tab, "KeyD", down=True)
        key(tab, "Space", down=True)  # to get over a step of the ground
        walked(tab, 2)
        key(tab, "KeyD", down=False)
        key(tab, "Space", down=False)
        tab.run(GAMEPAD)
        walked(tab, 1)
        tab.until(f"{ME}.velocity[2] > 0", 60)
        tab.run("navigator.getGamepads = () => [null]")
        tab.run("document.getElementById('lag').value = 80")
        tab.run("document.getElementById('lag').oninput()")
        tab.until("play.client.stats.rtt_s > 0.07", 60)
        tab.until("document.querySelectorAll('#figures tr').length > 8 && document.getElementById('clock').textContent")

    async with asyncio.timeout(600):
        with real_server("--game", "sovereign_netcode.examples.tag:Tag") as url:
            found = await asyncio.to_thread(played, url, play, 1200, 800)
            figures = await asyncio.to_thread(stats, url)
    assert found["said"] == [], "there is no exception, and no load that the policy forbids"
    assert found["kernel"] == "prebuilt"
    assert found["stats"]["divergences"] == 0
    assert found["name"] == "<b>Ann"
    assert (found["markup"], found["foreign"]) == (0, 0)
    assert found["coloured"] > 100, "the picture is not empty"
    assert figures["inputs_used"] > 10
    assert (figures["malformed"], figures["internal_errors"]) == (0, 0)


async def test_dodge_with_its_behaviours_on_a_phone() -> None:
    def touch(tab: Tab, kind: str, *points: tuple[float, float]) -> None:
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])

    def play(tab: Tab) -> None:
        tab.until("!document.getElementById('touch').hidden")
        assert tab.run("[...document.querySelectorAll('#pads button')].map(each => each.textContent)") == [
            "jump",
            "dash",
            "fire",
        ]
        box = tab.run("(({left, top, width}) => [left, top, width])(stick.getBoundingClientRect())")
        middle = box[0] + box[2] / 2, box[1] + box[2] / 2
        inside = tab.run("[innerWidth, innerHeight]")
        assert 0 < box[0] < box[0] + box[2] < inside[0]
        assert 0 < box[1] < box[1] + box[2] < inside[1]
        touch(tab, "touchStart", middle)
        touch(tab, "touchMove", (middle[0] + 40, middle[1]))
        walked(tab, 0.5)
        touch(tab, "touchEnd")
        before = tab.run("play.view.me.fields.loaded_at")
        at = tab.run("(({left, top}) => [left + 30, top + 30])(pads.children[2].getBoundingClientRect())")
        touch(tab, "touchStart", tuple(at))
        tab.until(f"play.view.me.fields.loaded_at > {before}", 60)
        touch(tab, "touchEnd")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth"), "nothing is wider than the screen"

    async with asyncio.timeout(600):
        with real_server("--game", "sovereign_netcode.examples.dodge:Dodge") as url:
            found = await asyncio.to_thread(played, url, play, 390, 844, phone=True)
            figures = await asyncio.to_thread(stats, url)
    assert found["said"] == []
    assert found["stats"]["divergences"] == 0
    assert found["coloured"] > 100
    assert math.isfinite(found["stats"]["frame_s"])
    assert figures["internal_errors"] == 0


async def test_over_tls(tmp_path: Path) -> None:
    issued = trustme.CA().issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(tmp_path / "cert.pem")
    issued.private_key_pem.write_to_path(tmp_path / "key.pem")
    files = ("--tls-cert", str(tmp_path / "cert.pem"), "--tls-key", str(tmp_path / "key.pem"))

    def play(tab: Tab) -> None:
        key(tab, "KeyA", down=True)
        walked(tab, 1)

    async with asyncio.timeout(600):
        with real_server("--scene", "flat", *files) as url:
            assert url.startswith("wss://")
            found = await asyncio.to_thread(played, url, play, 900, 700, "--ignore-certificate-errors")
    assert found["said"] == []
    assert found["stats"]["divergences"] == 0


@pytest.fixture
def new_game(tmp_path: Path) -> Path:
    """A folder with a new game, `king`."""
    command = [sys.executable, "-m", "sovereign_netcode.new_game", "king"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    return tmp_path


async def test_a_new_game_plays_in_the_browser_as_it_is(new_game: Path) -> None:

    def play(tab: Tab) -> None:
        key(tab, "KeyW", down=True)
        key(tab, "Space", down=True)
        walked(tab, 1)
        tab.run("globalThis.told = []; play.client.addEventListener('event', ({detail}) => told.push(detail.type))")
        key(tab, "ShiftLeft", down=True)
        tab.until("told.includes('Announced')", 60)  # the dash of its behaviour, predicted in the browser

    async with asyncio.timeout(600):
        program = (sys.executable, "-m", "sovereign_netcode.server")
        with real_server("--game", "king:King", program=program, folder=new_game) as url:
            found = await asyncio.to_thread(played, url, play, 1000, 700)
    assert found["said"] == []
    assert found["stats"]["divergences"] == 0


@pytest.fixture
def examples(tmp_path: Path) -> Path:
    """A folder with the examples for pages of one's own, and three.js."""
    if shutil.which("node") is None:
        pytest.skip("there is no Node.js on this machine")
    folder = tmp_path / "web"
    shutil.copytree(ROOT / "scripts" / "examples" / "web", folder, ignore=shutil.ignore_patterns("node_modules"))
    try:
        (folder / "node_modules").mkdir()
        (folder / "node_modules" / "three").symlink_to(npm_package("three"))
    except FetchError as error:
        pytest.skip(str(error))
    return folder


@contextlib.contextmanager
def proxied(folder: Path, url: str) -> Iterator[str]:
    """Serves the examples beside a game server. Yields their address."""
    command = ["node", "serve.mjs", url.replace("ws:", "http:"), "0"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as pages:
        try:
            assert pages.stdout is not None
            yield pages.stdout.readline().split("/canvas.html")[0]
        finally:
            pages.terminate()


def examined(address: str, *scripts: str) -> list[Any]:
    """Returns the values of expressions in an example, once it has joined and drawn."""
    assert BROWSER is not None
    with chromium(BROWSER, "--enable-unsafe-swiftshader", "--use-angle=swiftshader") as tab:
        tab.open(address, 240, 200)  # small: it is drawn without a graphics card
        tab.until("globalThis.client?.view().me", JOIN_S)
        key(tab, "Space", down=True)  # it jumps as long as the key is held, also where a block is in its way
        tab.until("client.view().me.velocity[2] > 0", 120)
        values = [tab.until(script, 60) for script in scripts]
        errors = [line for line in tab.said if "exceptionThrown" in line or '"level": "error"' in line]
        return [*values, errors]


@pytest.mark.parametrize(
    ("page", "scripts"),
    [
        ("canvas.html", ["court.getContext('2d').getImageData(320, 320, 1, 1).data[0] === 255"]),
        ("three.html", ["segments.size", "boxes.size > 1", "[...segments.values()].some(({count}) => count > 900)"]),
    ],
)
async def test_the_examples_for_pages_of_ones_own(examples: Path, page: str, scripts: list[str]) -> None:
    async with asyncio.timeout(600):
        with real_server("--game", "sovereign_netcode.examples.tag:Tag") as url, proxied(examples, url) as address:
            *values, errors = await asyncio.to_thread(examined, f"{address}/{page}", *scripts)
    assert all(values)
    assert errors == []
