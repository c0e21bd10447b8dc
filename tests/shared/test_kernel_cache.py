"""Numba's cache on disk is used only for the sources that it was compiled from."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from shared import kernels

ROOT = Path(__file__).parent.parent.parent
READ = """
import numpy as np
from shared import bulk, layout, numba_kernel
turns = np.zeros(8, np.int64)
told = layout.TOLD | layout.NEW_MOVE | layout.NEW_BUTTONS
ends = np.array([5], np.int64)
assert numba_kernel.jitted(bulk).read_turns(bytes((bulk.HAS_EVENTS, told, 1, 2, 3)), ends, turns) == 1
print(turns[2:5].tolist())
"""


@pytest.mark.slow
@pytest.mark.skipif(not kernels.numba_installed(), reason="Numba is not installed")
def test_a_constant_that_changes_in_another_file_is_compiled_anew(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "shared", tmp_path / "shared", ignore=shutil.ignore_patterns("__pycache__"))

    def read() -> tuple[str, int]:
        done = subprocess.run(
            (sys.executable, "-c", READ), cwd=tmp_path, env={}, capture_output=True, text=True, check=True
        )
        return done.stdout, len(list(tmp_path.rglob("*read_turns*.nbi")))

    assert read() == ("[1, 2, 3]\n", 1)
    assert read() == ("[1, 2, 3]\n", 1)
    layout = tmp_path / "shared" / "layout.py"
    events = "STOP_X, STOP_Y, STOP_Z, GO_X, GO_Y, FALL, LAUNCH, TOLD, WHOLE"
    text = layout.read_text("utf-8")
    assert text.count(events) == 1
    layout.write_text(text.replace(events, "TOLD, STOP_Y, STOP_Z, GO_X, GO_Y, FALL, LAUNCH, STOP_X, WHOLE"), "utf-8")
    assert read() == ("[1, 2, 3]\n", 2)
