"""The programs in the README, run as they stand there.

pygame-ce is installed for the tests and runs without a display. The other engines are used where they are installed
(they are heavy: 12 to 200 MB); elsewhere the least that has the shape of their loop stands in for them.
"""

import re
import subprocess
import sys

import pytest

from tests.client_sdk.servers import ROOT, real_server
from tests.readme.run_snippet import README, snippets

ENGINES = ["pygame-ce", "pyglet", "arcade", "Panda3D", "ursina"]


def run(*arguments: str) -> str:
    command = [sys.executable, "-m", "tests.readme.run_snippet", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_there_are_no_others() -> None:
    assert [*snippets()] == [*ENGINES, "asyncio", "A bot"]


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engines_loop(engine: str) -> None:
    said = run(engine).splitlines()[-1]
    assert said in ("walked, in the engine", "walked, in a stand-in; it has drawn True")
    assert engine != "pygame-ce" or said.endswith("the engine")


@pytest.mark.e2e
def test_asyncio_and_bots() -> None:
    with real_server("--scene", "flat") as url:
        assert "walked" in run("asyncio", url)
        said = run("A bot", url)
        assert "Joined(" in said
        assert "walked" in said


def test_single_player() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)
    (program,) = [block for block in blocks if "Loopback(" in block]
    space: dict[str, object] = {}
    exec(compile(program, "README.md", "exec"), space)
    client = space["client"]
    assert client.playing  # type: ignore[attr-defined]
    assert client.stats.inputs_late == client.stats.divergences == 0  # type: ignore[attr-defined]
