"""The client in Node.js, written from docs/protocol.md, plays on a real server without an error there.

The positions that it was sent are compared with a recording of that server.
"""

import asyncio
import json
import math
import os
import re
import shutil
import signal
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest

from client_sdk.netsim.links import Link
from sovereign_netcode.examples.tag import Tag
from sovereign_netcode.server.journal.records import replay
from sovereign_netcode.shared import layout
from sovereign_netcode.shared.layout import ID
from tests.e2e.processes import running, stats
from tests.patience import until
from tests.proxy import Proxy

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "scripts" / "examples"
ENVIRONMENT = os.environ | {"SOVEREIGN_WEB": str(ROOT / "client_sdk" / "web")}
FILES = ("bot.mjs", "package.json", "package-lock.json")
PLAYED_S = 4
UNREACHABLE = "ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ECONNRESET|ETIMEDOUT|ENETUNREACH"


def test_the_lock_pins_by_content_and_names_no_registry() -> None:
    lock = json.loads((EXAMPLES / "package-lock.json").read_text())
    packages = {name: entry for name, entry in lock["packages"].items() if name}
    assert {"node_modules/ws", "node_modules/@msgpack/msgpack"} == packages.keys()
    assert all(entry["integrity"].startswith("sha512-") and "resolved" not in entry for entry in packages.values())


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Returns a directory with the example and its two packages."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("there is no Node.js with npm on this machine")
    for name in FILES:
        shutil.copy(EXAMPLES / name, tmp_path)
    command = [npm, "ci", "--no-audit", "--no-fund", "--ignore-scripts"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    if found := re.search(UNREACHABLE, done.stderr) if done.returncode else None:
        pytest.skip(f"npm cannot fetch the two packages ({found[0]})")
    assert done.returncode == 0, done.stderr
    return tmp_path


@pytest.mark.e2e
def test_it_joins_walks_and_knows_exactly_where_everybody_is(installed: Path) -> None:
    record = installed / "record"
    with running("--port", "0", "--game", "sovereign_netcode.examples.tag:Tag", "--record", str(record)) as server:
        address = server.address()
        url = "ws://{}:{}".format(*address)
        done = subprocess.run(
            ["node", "bot.mjs", url, str(PLAYED_S)],
            cwd=installed,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        until(lambda: stats(address)["left"] == 1)
        figures = stats(address)
        assert server.end(signal.SIGTERM) == 0
    told = {said["tick"]: said for said in map(json.loads, done.stdout.splitlines())}
    *_, last = told.values()
    assert len(told) >= PLAYED_S - 1
    assert last["name"] == "node", "the attributes of its entity"
    assert len(last["places"]) == Tag.players_min
    compared = 0
    for moment in replay(record):
        world = moment.world
        if world.tick in told and not moment.ended:  # the meadow is small enough that every entity is in view
            truth = {str(entity): list(world.position(entity)) for entity in world.states()[:, ID].tolist()}
            assert told[world.tick]["places"] == truth, world.tick
            compared += 1
    assert compared == len(told)
    places = [said["places"][str(said["me"])] for said in told.values()]
    assert sum(math.dist(a, b) for a, b in pairwise(places)) > 2
    assert figures["inputs_used"] >= last["used"] > 16
    assert (figures["malformed"], figures["kicked"], figures["inputs_refused"], figures["closed"]) == (0, 0, 0, {})
    assert figures["internal_errors"] == 0


@pytest.mark.e2e
def test_it_predicts_what_the_server_computes(installed: Path) -> None:
    record = installed / "record"
    with running("--port", "0", "--scene", "hills", "--record", str(record)) as server:
        address = server.address()
        done = subprocess.run(
            ["node", "bot.mjs", "ws://{}:{}".format(*address), str(PLAYED_S)],
            cwd=installed,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert server.end(signal.SIGTERM) == 0
    told = [json.loads(line) for line in done.stdout.splitlines()]
    predicted = {tick: state for said in told for tick, *state in said["predicted"]}
    assert len(predicted) > 32, "most ticks of the last seconds"
    compared = {
        moment.world.tick: (predicted[moment.world.tick], list(moment.world.state(told[0]["me"])))
        for moment in replay(record)
        if moment.world.tick in predicted and not moment.ended
    }
    assert compared.keys() == predicted.keys()
    assert all(mine == truth for mine, truth in compared.values())
    assert len({tuple(state[layout.X : layout.Z]) for state in predicted.values()}) > 32, "it walks"
    assert any(state[layout.FLAGS] for state in predicted.values()), "and it jumps"


@pytest.mark.e2e
async def test_it_finds_a_world_and_reconnects_to_it(installed: Path) -> None:
    settings = installed / "worlds.toml"
    settings.write_text('scene = "flat"\n[worlds.arena]\nscene = "flat"\n', "utf-8")
    with running("--port", "0", "--host", "127.0.0.1", "--config", str(settings)) as server:
        address = server.address()
        async with Proxy(address, Link()) as proxy, asyncio.timeout(60):
            bot = await asyncio.create_subprocess_exec(
                *("node", "bot.mjs", f"{proxy.url}/match?kind=arena", str(PLAYED_S)),
                cwd=installed,
                env=ENVIRONMENT,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
            )
            assert bot.stdout is not None
            before = json.loads(await bot.stdout.readline())
            await proxy.cut()
            out, errors = await bot.communicate()
        *_, after = map(json.loads, out.splitlines())
        assert bot.returncode == 0
        assert errors.decode().splitlines()[0] == "goes to /arena-1: matched"
        assert after["me"] == before["me"], "the same entity: it has resumed"
        assert after["used"] > before["used"]
        counts = stats(address)["worlds_counts"]
    assert (counts["match"], counts["created"]) == (1, 1)
