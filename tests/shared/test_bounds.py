"""The compiled kernels stay within their arrays: what they do is done once more with every index checked.

Compiled code that writes beside an array damages the process without a word, and some of it reads what peers send.
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
CHECKED = ("-p", "tests.kernels.checking")
"""Has the tests run the kernel that `scripts/kernels` builds, with checks."""
CONTROL_CHECKED = """
import numpy as np
from tests.kernels import checking
from shared import kernels
few, many = np.zeros(12, np.int64), np.zeros(24, np.int64)
kernels.get(True).alike(few, 2, many, 2, 1, 1, few)
"""
CONTROL = """
import numpy as np
from shared import bulk, kernels
kernels.jitted(bulk).sort(np.zeros(3, np.int64), 4)
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not kernels.numba_installed(), reason="Numba is not installed"),
]


def test_no_index_of_the_prebuilt_kernel_is_out_of_bounds() -> None:
    environment = os.environ | {"NUMBA_OPT": "0", "NUMBA_CPU_NAME": "generic"}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            (sys.executable, *arguments), cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )

    assert "SystemError" in run("-c", CONTROL_CHECKED).stderr
    done = run("-m", "pytest", "-q", "-p", "no:cacheprovider", *CHECKED, "-m", "not slow", "-k", "not plain", *WORK)
    assert done.returncode == 0, done.stdout


def test_no_index_is_out_of_bounds(tmp_path: Path) -> None:
    environment = os.environ | {
        "NUMBA_BOUNDSCHECK": "1",
        "NUMBA_CACHE_DIR": str(tmp_path),
        kernels.VARIABLE: kernels.NUMBA,
    }

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            (sys.executable, *arguments), cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )

    assert "IndexError: index is out of bounds" in run("-c", CONTROL).stderr
    done = run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", "-k", "not plain", *WORK)
    assert done.returncode == 0, done.stdout
