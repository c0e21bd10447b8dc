"""The compiled kernels stay within their arrays. Tests run again with a kernel that checks every index.

Compiled code that writes outside an array damages the process without an error, and some of it reads data from peers.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shared import kernels

ROOT = Path(__file__).parent.parent.parent
WORK = (
    "tests/shared/test_alike.py",
    "tests/shared/test_copies.py",
    "tests/shared/test_follow.py",
    "tests/shared/test_hard_cases_air.py",
    "tests/shared/test_hard_cases_world.py",
    "tests/shared/test_placing.py",
    "tests/shared/test_snapshot.py",
    "tests/shared/test_waking.py",
    "tests/server/test_replication.py",
    "tests/server/test_rewind.py",
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.longest,
    pytest.mark.skipif(not kernels.numba_installed(), reason="Numba is not installed"),
]


def test_no_index_of_the_prebuilt_kernel_is_out_of_bounds() -> None:
    """The other process has verified that the checks work (`tests.kernels.checking`)."""
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.kernels.checking")
    environment = os.environ | {"NUMBA_OPT": "0", "NUMBA_CPU_NAME": "generic"}
    done = subprocess.run(
        (*command, "-k", "not plain", *WORK),
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
