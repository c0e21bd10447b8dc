"""`sovereign-server --reload`: a changed game restarts the server, and its players come back by themselves."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from client_sdk.client import Client
from server.runtime.reload import folder_of, stamps
from tests.e2e.processes import END_S, START_S

GAME = """
from sovereign_netcode.server import Rules

class Mine(Rules):
    scene = "flat"

    def on_start(self):
        self.game.share("version", {version})
"""


def test_sources_and_scenes_are_watched_and_hidden_folders_are_not(tmp_path: Path) -> None:
    for name in ("game.py", "maps/island.toml", "notes.txt", ".venv/other.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    assert sorted(path.name for path in stamps(tmp_path)) == ["game.py", "island.toml"]


def test_the_folder_of_a_game_is_that_of_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert folder_of(None) == tmp_path
    assert folder_of("sovereign_netcode.examples.tag:Tag").name == "examples"


@pytest.mark.e2e
@pytest.mark.slow
def test_a_changed_game_restarts_with_its_players(tmp_path: Path) -> None:
    """A broken version is reported, and the next one starts; the client needs no call besides its loop."""
    game = tmp_path / "mine.py"
    game.write_text(GAME.format(version=1))
    clean = {name: value for name, value in os.environ.items() if not name.startswith("SOVEREIGN_")}
    command = [
        sys.executable,
        "-m",
        "sovereign_netcode.server",
        "--game",
        "mine:Mine",
        "--port",
        "0",
        "--reload",
        "true",
    ]
    server = subprocess.Popen(command, cwd=tmp_path, env=clean, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        url = next(line.split()[-1] for line in server.stdout if line.startswith("listening on "))
        with Client.connect(url, name="Ann") as client:
            plays(client, lambda: client.playing and client.shared.get("version") == 1)
            game.write_text("nonsense(")
            plays(client, lambda: not client.playing)
            game.write_text(GAME.format(version=2) + "\n")
            plays(client, lambda: client.playing and client.shared.get("version") == 2)
    finally:
        server.terminate()
        assert server.wait(END_S) == 0
        server.stdout.close()


def plays(client: Client, holds: Callable[[], bool]) -> None:
    """Runs the client's loop until a condition holds."""
    deadline = time.monotonic() + START_S
    while not holds():
        assert time.monotonic() < deadline
        client.poll()
        client.update()
        time.sleep(0.01)
