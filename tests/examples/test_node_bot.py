"""The client in Node.js, written from docs/protocol.md: it plays on a real server, which has nothing to complain of."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from shared.terrain import GRASS
from tests.e2e.processes import running, stats, until

EXAMPLES = Path(__file__).resolve().parents[2] / "scripts" / "examples"
FILES = ("bot.mjs", "package.json", "package-lock.json")
PLAYED_S = 4
WALK_SPEED, GROUND = 3.0, 8.0
UNREACHABLE = "ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ECONNRESET|ETIMEDOUT|ENETUNREACH"


def test_the_lock_pins_by_content_and_names_no_registry() -> None:
    lock = json.loads((EXAMPLES / "package-lock.json").read_text())
    packages = {name: entry for name, entry in lock["packages"].items() if name}
    assert {"node_modules/ws", "node_modules/@msgpack/msgpack"} == packages.keys()
    assert all(entry["integrity"].startswith("sha512-") and "resolved" not in entry for entry in packages.values())


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A directory with the example and its two packages."""
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
def test_it_joins_walks_and_reads_snapshots(installed: Path) -> None:
    with running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        url = "ws://{}:{}".format(*address)
        done = subprocess.run(
            ["node", "bot.mjs", url, str(PLAYED_S)],
            cwd=installed,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        found = json.loads(done.stdout.splitlines()[-1])
        assert found["name"] == "node", "the attributes of its entity"
        assert found["at"][2] == GROUND
        assert found["below"] == GRASS, "the terrain was unpacked, and is where the rows say that it is"
        assert found["terrain"] >= 9  # more, where its way leads over a border
        assert found["snapshots"] > 16
        assert found["used"] > 16
        assert WALK_SPEED / 2 < found["path"] < WALK_SPEED * (PLAYED_S + 1)
        until(lambda: stats(address)["left"] == 1)
        figures = stats(address)
        assert figures["inputs_used"] >= found["used"]
        assert (figures["malformed"], figures["kicked"], figures["inputs_refused"], figures["closed"]) == (0, 0, 0, {})
        assert figures["internal_errors"] == 0
