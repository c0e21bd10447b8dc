"""The cause of a child process that fails is reported by every command that starts one."""

import argparse
import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from scripts.benchmarks import server as bench
from sovereign_netcode.loadtest.processes import CannotStartError, cause, child, own_server
from sovereign_netcode.play import own_server as play
from sovereign_netcode.stderr import Stderr

ROOT = Path(__file__).resolve().parents[2]

MISSING = "import no_such_library"


@contextlib.contextmanager
def rig(scene: Path) -> Iterator[bench.Rig]:
    running = bench.Rig("scripts.benchmarks.busy_server", "game", str(scene))
    try:
        yield running
    finally:
        running.close()


def run(program: str) -> tuple[Stderr, int]:
    """Runs a program. Returns its stderr and its exit code."""
    errors = Stderr()
    process = subprocess.Popen([sys.executable, "-c", program], stderr=errors.pipe)
    errors.started()
    return errors, process.wait()


@pytest.mark.parametrize(
    ("program", "cause"),
    [
        (MISSING, "ModuleNotFoundError: No module named 'no_such_library'"),
        ("import sys; sys.exit('error: port = 7: in use')", "port = 7: in use"),
        ("import sys; sys.stderr.write('first\\nlast without an end')", "last without an end"),
        ("import sys; sys.stderr.write('the cause\\n\\n  \\n'); sys.exit(3)", "the cause"),
        ("import os; os.write(2, b'\\xff\\n'); os._exit(1)", "\ufffd"),
        ("import sys; sys.exit(3)", "it ended with exit code 3 and wrote no error"),
    ],
)
def test_the_last_line_is_the_cause_and_all_is_passed_on(
    program: str, cause: str, capfd: pytest.CaptureFixture[str]
) -> None:
    errors, code = run(program)
    assert errors.cause(code) == cause
    shown = capfd.readouterr().err
    assert (cause in shown) == ("wrote no error" not in cause)


def test_one_that_still_runs_is_not_waited_for() -> None:
    errors = Stderr()
    command = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=errors.pipe) as process:
        errors.started()
        assert errors.cause(process.poll()) == "it still runs, but does not answer"


async def test_a_load_test_names_why_there_is_no_server() -> None:
    args = argparse.Namespace(game=None, scene="nowhere", tick_rate=None)
    with pytest.raises(CannotStartError, match=r"^the server did not start: scene 'nowhere': cannot be read"):
        async with own_server(args):
            pass


async def test_a_load_test_names_why_a_process_of_bots_died() -> None:
    async with child("-c", MISSING) as process:
        assert await process.wait() == 1
        assert cause(process) == "ModuleNotFoundError: No module named 'no_such_library'"


def test_the_window_names_why_there_is_no_server() -> None:
    with (
        pytest.raises(RuntimeError, match=r"^the server did not start: game = 'nothing:Here': cannot be loaded"),
        play.server("nothing:Here", None),
    ):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="the generator polls with epoll")
@pytest.mark.parametrize(
    ("broken", "error"),
    [("benchmarks/busy_server.py", "the server did not start"), ("loadgen/generator.py", "")],
)
def test_the_benchmark_names_what_is_missing(
    broken: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripts = tmp_path / "scripts"
    for name in ("benchmarks", "loadgen"):
        (scripts / name).mkdir(parents=True)
    (scripts / "__init__.py").touch()
    listening = "print('listening on ws://127.0.0.1:1', flush=True)\nimport sys\nsys.stdin.read()\n"
    (scripts / "benchmarks" / "busy_server.py").write_text(listening)
    (scripts / broken).write_text(MISSING)
    monkeypatch.setattr(bench, "ROOT", tmp_path)
    monkeypatch.setattr(bench, "PATIENCE_S", 3.0)
    with pytest.raises(bench.RigError, match="No module named 'no_such_library'") as told, rig(tmp_path) as running:
        running.load.next()
    assert str(told.value).startswith(error or "the generator of load does not answer")


def test_a_benchmark_that_fails_says_so_in_a_line(tmp_path: Path) -> None:
    """The environment is the one of `scripts/demo` alone, which has neither picows nor matplotlib."""
    without = (
        "import sys; sys.modules.update(picows=None, matplotlib=None);"
        "import importlib.util as u; real = u.find_spec;"
        "u.find_spec = lambda name: None if name in ('picows', 'matplotlib') else real(name);"
    )
    for program, expected in (
        (
            "from scripts.experiments import accuracy; sys.exit(accuracy.main(['--plot', 'x.png']))",
            "error: --plot: matplotlib is not installed",
        ),
        (
            "from scripts.environment import lacking; sys.exit(lacking('picows'))",
            "picows is not installed here; `python scripts/test --version`",
        ),
    ):
        done = subprocess.run(
            [sys.executable, "-c", without + program], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode != 0
        assert expected in done.stdout + done.stderr
        assert "Traceback" not in done.stderr
