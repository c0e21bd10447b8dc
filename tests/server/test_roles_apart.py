"""A server in one process loads nothing of a world on many processes."""

import subprocess
import sys

from tests.e2e.processes import ROOT

PROGRAM = """
import sys
import server.app, server.serving
apart = ("server.scale", "server.cluster", "server.roles", "nats")
print(sorted(name for name in sys.modules if name.startswith(apart)))
"""


def test_a_server_in_one_process_loads_no_part() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
