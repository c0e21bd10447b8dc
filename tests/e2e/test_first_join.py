"""The first start of a server and the first join of a client without a prebuilt kernel; and no index is out of bounds.

Numba takes long to compile a kernel, so one compilation serves all: the start of the server fills the cache, the client
compiles what has been removed from it, and the result is compared with the prebuilt kernel. The compiled functions
check every index, and tests of the physics and of the server run again with them: code that writes outside an array
damages the process without an error, and some of it reads data from peers.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from server.runtime.event_loop import COMPILING
from shared import kernels
from tests.e2e.processes import BUSY, ROOT, running
from tests.kernels import chains

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.slow,
    pytest.mark.longest,
    pytest.mark.skipif(not kernels.numba_installed(), reason="Numba is not installed"),
]

PLAY_S = 900.0
PROGRAM = f"""
import sys, time
from client_sdk import Client, Joined, Left
seen, ticks = [], {{}}
with Client.connect(sys.argv[1], name="Ann") as client:
    end = time.monotonic() + {PLAY_S}
    while time.monotonic() < end and len(seen) < 2 or ticks.get(seen[-1], 0) < 60:
        for event in client.poll():
            assert not isinstance(event, Left), event
        client.set_input(1, 0)
        client.update()
        if client.playing:
            if client.stats.kernel not in seen:
                seen.append(client.stats.kernel)
            ticks[seen[-1]] = ticks.get(seen[-1], 0) + 1
        time.sleep(1 / 60)
    print(seen, client.stats.reconnects, client.stats.divergences, "numba" in sys.modules)
"""


OUT_OF_BOUNDS = """
import numpy as np
from shared import kernels
few, many = np.zeros(12, np.int64), np.zeros(24, np.int64)
kernels.get(True).alike(few, 2, many, 2, 1, 1, few)  # two states in an array with room for one
"""
WORK = (
    "tests/shared/test_alike.py",
    "tests/shared/test_copies.py",
    "tests/shared/test_follow.py",
    "tests/shared/test_hard_cases_air.py",
    "tests/shared/test_hard_cases_world.py",
    "tests/shared/test_places.py",
    "tests/shared/test_placing.py",
    "tests/shared/test_snapshot.py",
    "tests/shared/test_waking.py",
    "tests/server/test_fast_path.py",
    "tests/server/test_replication.py",
    "tests/server/test_rewind.py",
)


def test_a_start_that_compiles_says_so_and_a_client_plays_meanwhile_with_equal_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_BOUNDSCHECK", "1")
    first_start_and_later_ones(tmp_path)
    remove(tmp_path, "step")  # the client has to compile it
    first_join(tmp_path)
    other = chains.elsewhere("hills", chains.TICKS, kernels.NUMBA, NUMBA_CACHE_DIR=str(tmp_path))
    assert other == f"{kernels.NUMBA} {chains.chain('hills', chains.TICKS, compiled=True)}"
    no_index_is_out_of_bounds(tmp_path)


def first_start_and_later_ones(cache: Path) -> None:
    """Checks that the first start compiles the whole kernel, and a later one what is not in the cache, and says so."""
    if os.name == "nt":  # it has no such terminals
        assert in_a_log(cache) == [COMPILING]
    else:
        assert on_a_terminal(cache) == ["compiling", "listening"]
        assert on_a_terminal(cache) == ["listening"]
    remove(cache, "read_turns")
    assert in_a_log(cache) == [COMPILING]
    assert in_a_log(cache) == []


def no_index_is_out_of_bounds(cache: Path) -> None:
    """Runs the short forms of other tests with the compiled functions. First, checks that a wrong index is an error."""

    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = (sys.executable, *arguments)
        return subprocess.run(command, cwd=ROOT, env=compiling(cache), capture_output=True, text=True, check=False)

    assert "IndexError: index is out of bounds" in python("-c", OUT_OF_BOUNDS).stderr
    done = python("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", "-k", "not plain", *WORK)
    assert done.returncode == 0, done.stdout + done.stderr


def first_join(cache: Path) -> None:
    """Checks that a client plays at once with the plain kernel, and then with the compiled one, all without a
    divergence."""
    with running("--port", "0", "--scene", "flat") as server:
        host, port = server.address()
        command = (sys.executable, "-c", PROGRAM, f"ws://{host}:{port}")
        done = subprocess.run(command, cwd=ROOT, env=compiling(cache), capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout == "['plain for now', 'numba'] 0 0 True\n"


def compiling(cache: Path) -> dict[str, str]:
    """Returns the environment of a process that compiles the kernel, with Numba's cache in a folder."""
    return os.environ | {kernels.VARIABLE: kernels.NUMBA, "NUMBA_CACHE_DIR": str(cache)}


def remove(cache: Path, *functions: str) -> None:
    """Removes compiled functions from Numba's cache."""
    for function in functions:
        (index,) = cache.rglob(f"*.{function}-*.nbi")
        index.unlink()


def on_a_terminal(cache: Path) -> list[str]:
    """Returns the first word of each line on the terminal of a starting server, up to the line of its address.

    Lines behind it do not count, because the same read may have brought them, too.
    """
    seen, its = os.openpty()
    command = [sys.executable, "-m", "server", "--port", "0", "--scene", "flat", "--log-level", "warning"]
    with subprocess.Popen(command, cwd=ROOT, env=compiling(cache), stdin=its, stdout=its, stderr=its) as process:
        os.close(its)
        try:
            shown = b""
            while b"listening on" not in shown:
                shown += os.read(seen, 1000)
        finally:
            process.terminate()
            os.close(seen)
    lines = [line for line in shown.decode(errors="replace").splitlines() if not BUSY.search(line)]
    words = [line.partition(" ")[0] for line in lines]
    return words[: words.index("listening") + 1]


def in_a_log(cache: Path) -> list[str]:
    """Returns the log's entries about compiling of a server that starts and ends."""
    flags = ("--port", "0", "--scene", "flat")
    with running(*flags, NUMBA_CACHE_DIR=str(cache), SOVEREIGN_KERNEL=kernels.NUMBA) as server:
        server.address()
        assert server.end(signal.SIGTERM) == 0
        return [json.loads(line)["event"] for line in server.errors if "compiling" in line]
