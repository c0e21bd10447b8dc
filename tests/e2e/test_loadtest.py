"""The load test as a command: real processes, real sockets."""

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from client_sdk.bots import Stand, Wander
from server.rules import Rules
from sovereign_netcode.examples.dodge import Dodge
from sovereign_netcode.examples.dodge_brain import DodgePlayer
from sovereign_netcode.loadtest.swarm import policy_of
from tests.client_sdk.servers import real_server
from tests.e2e.processes import inheriting
from tests.lengths import long
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.e2e
needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")

ROOT = Path(__file__).resolve().parents[2]
KEYS = """clients seconds tick_rate server_ticks tick_lateness_ms snapshots_per_client_per_s inputs_sent
inputs_late_share corrections_per_client_minute correction_blocks bytes_per_client_per_s
server_cpu_us_per_client_tick disconnects server_rss_mb""".split()


def loadtest(*flags: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "scripts/loadtest.py", *flags]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.alone
def test_all_clients_play_and_the_figures_are_there(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    done = loadtest("--clients", "10", "--seconds", "3", "--processes", "2", "--json", str(out), "--verdict")
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    assert set(KEYS) <= set(figures)
    assert figures["clients"] == 10
    assert figures["disconnects"] == 0
    assert figures["malformed"] == 0
    assert figures["clients_with_95_percent"] == 10
    assert figures["inputs_sent"] > 10 * 32
    assert set(figures["bytes_per_client_per_s"]) == {"up", "down"}
    assert set(figures["tick_lateness_ms"]) == set(figures["correction_blocks"]) == {"p50", "p99", "max"}
    assert len(figures["server_rss_mb"]) >= 2
    assert figures["server_exit_code"] == 0
    assert [bots["clients"] for bots in figures["bots"]] == [5, 5]
    assert all(set(bots["lag_ms"]) == {"p50", "p99", "max"} for bots in figures["bots"])
    assert "     1 s  clients 10, ticks " in done.stdout
    assert "10 of 10 clients got at least 95 % of their snapshots" in done.stdout


@pytest.mark.slow
def test_it_takes_a_server_that_runs_already(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    with real_server("--scene", "topdown", "--tick-rate", "20") as url:
        flags = ("--clients", "4", "--seconds", "1", "--policy", "dig-and-place", "--json", str(out))
        done = loadtest("--url", url, *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    assert figures["tick_rate"] == 20
    assert figures["resyncs"] == 0


@pytest.mark.slow
def test_a_game_is_played_with_its_behaviours_and_its_bots(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    game = "sovereign_netcode.examples.dodge:Dodge"
    done = loadtest("--game", game, "--clients", "2", "--seconds", "4", "--json", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    assert (figures["game"], figures["policy"], figures["scene"]) == (game, None, None)
    assert figures["disconnects"] == figures["malformed"] == 0
    assert figures["inputs_sent"] > 32


def test_a_game_that_does_not_exist_is_named() -> None:
    done = loadtest("--game", "sovereign_netcode.examples.dodge:Dodgeball")
    assert done.returncode == 2
    assert done.stderr.startswith("error: game = 'sovereign_netcode.examples.dodge:Dodgeball': cannot be loaded")


@pytest.mark.parametrize(
    ("name", "rules", "made"),
    [(None, Rules(), Wander), (None, Dodge(), DodgePlayer), ("stand", Dodge(), Stand)],
    ids=["none", "the game's", "named"],
)
def test_policies_of_bots(name: str | None, rules: Rules, made: type) -> None:
    assert type(policy_of(name, rules, random.Random(1))) is made


@pytest.mark.slow
def test_memory_of_the_server_is_flat_under_sixty_clients(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    done = loadtest("--clients", "60", "--seconds", "16", "--policy", "dig-and-place", "--json", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(out.read_text())
    memory = figures["server_rss_mb"]
    assert len(memory) >= 12
    assert max(memory[5:]) - memory[5] <= 8.0, memory
    assert figures["tick_lateness_ms"]["p99"] > 0
    assert figures["disconnects"] == 0
    print(f"60 clients: memory {memory}, lateness {figures['tick_lateness_ms']}")


def test_no_server_is_one_clear_line() -> None:
    done = loadtest("--url", "ws://127.0.0.1:9", "--clients", "2")
    assert done.returncode == 2
    assert "no server there" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.slow
def test_a_broken_scene_is_one_clear_line() -> None:
    done = loadtest("--scene", "nowhere")
    assert done.returncode == 2
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr


@pytest.fixture
def playing(request: pytest.FixtureRequest) -> Iterator[tuple["subprocess.Popen[str]", dict[int, str]]]:
    """A running load test: its process, and the processes that it has started, with their commands."""
    command = [sys.executable, "-u", "scripts/loadtest.py", "--clients", "4", "--processes", "2", "--seconds", "600"]
    with ExitStack() as stack:
        with inheriting(signal.SIG_IGN, *getattr(request, "param", ())):
            process = stack.enter_context(subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True))
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if "4 play" in line:
                    break
            pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            started = {int(pid): Path(f"/proc/{pid}/cmdline").read_text() for pid in pids}
            assert sorted("loadtest.swarm" in command for command in started.values()) == [False, True, True]
            yield process, started
        finally:
            if process.poll() is None:
                process.kill()
    left = [pid for pid in started if Path(f"/proc/{pid}").exists()]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


@needs_linux
@pytest.mark.parametrize(
    ("number", "playing"),
    [
        (signal.SIGINT, (signal.SIGINT,)),  # like a background job of a script
        *long((signal.SIGTERM, ()), (signal.SIGINT, ()), (signal.SIGTERM, (signal.SIGINT,))),
    ],
    indirect=["playing"],
)
def test_a_signal_leaves_nothing_behind(
    number: signal.Signals, playing: tuple["subprocess.Popen[str]", dict[int, str]]
) -> None:
    process, _ = playing
    process.send_signal(number)
    assert process.wait(PATIENCE_S) == 130


@needs_linux
@pytest.mark.parametrize(
    ("killed", "name"),
    [("loadtest.swarm\0", "a process of bots"), *long(("sovereign_netcode.server\0", "the server"))],
)
def test_the_death_of_a_process_ends_it_at_once_with_nothing_left_behind(
    playing: tuple["subprocess.Popen[str]", dict[int, str]], killed: str, name: str
) -> None:
    process, started = playing
    os.kill(next(pid for pid, command in started.items() if killed in command), signal.SIGKILL)
    out, _ = process.communicate(timeout=PATIENCE_S)  # of the 600 s that it should last
    assert process.returncode == 1
    assert f"failed: {name} ended during the test with exit code -9" in out
    assert "Traceback" not in out
