"""The first join of a client without a prebuilt kernel: it plays at once, while its kernel is compiled.

A kernel takes long to compile, so the same one is compared with the prebuilt one, too.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shared import kernels
from tests.e2e.processes import ROOT, running
from tests.kernels import chains

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.slow,
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


def test_a_client_plays_while_its_kernel_is_compiled_which_agrees_with_the_prebuilt_one_at_every_tick(
    tmp_path: Path,
) -> None:
    with running("--port", "0", "--scene", "flat") as server:
        host, port = server.address()
        environment = os.environ | {kernels.VARIABLE: kernels.NUMBA, "NUMBA_CACHE_DIR": str(tmp_path)}
        command = (sys.executable, "-c", PROGRAM, f"ws://{host}:{port}")
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout == "['plain for now', 'numba'] 0 0 True\n"
    other = chains.elsewhere("hills", chains.TICKS, kernels.NUMBA, NUMBA_CACHE_DIR=str(tmp_path))
    assert other == f"{kernels.NUMBA} {chains.chain('hills', chains.TICKS, compiled=True)}"
