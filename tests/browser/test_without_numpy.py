"""A client without numpy does the same as one with it: the same bytes sent, the same views, worlds and corrections."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from shared import kernels
from tests.acrobat import CLASSES
from tests.browser.replayed import SAME, replayed
from tests.browser.tapes import Recorded, acrobats, walkers

ROOT = Path(__file__).parent.parent.parent


def same(recorded: Recorded) -> dict[str, Any]:
    """Returns the results of a tape that is played natively, as far as they have to be the same everywhere."""
    data, behaves = recorded.tape
    found = replayed(data, CLASSES if behaves else ())
    assert found["numpy"]
    assert (found["corrections"], found["replayed"]) == (recorded.corrections, recorded.replayed)
    return {name: found[name] for name in SAME}


def without_numpy(recorded: Recorded, folder: Path, form: str = kernels.AUTO) -> dict[str, Any]:
    """Returns the results of a tape that another process plays, which has no numpy."""
    path = folder / "tape"
    path.write_bytes(recorded.tape.data)
    command = [sys.executable, "-m", "tests.browser.replayed", str(path), "--no-numpy"]
    command += ["behaves"] if recorded.tape.behaves else []
    environment = os.environ | {kernels.VARIABLE: form}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert not found["numpy"]
    assert form in (kernels.AUTO, found["kernel"])
    return {name: found[name] for name in SAME}


def test_a_walk_with_a_lost_connection(tmp_path: Path) -> None:
    recorded = walkers(4, players=5)
    assert recorded.sent > 100
    assert without_numpy(recorded, tmp_path) == same(recorded)


def test_behaviours(tmp_path: Path) -> None:
    recorded = acrobats(3, players=3)
    assert without_numpy(recorded, tmp_path) == same(recorded)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["hills", "topdown"])
def test_a_long_walk_among_many(scene: str, tmp_path: Path) -> None:
    recorded = walkers(20, players=20, link="far", scene=scene)
    assert recorded.replayed > 50
    assert without_numpy(recorded, tmp_path) == same(recorded)


@pytest.mark.slow
def test_a_long_game_with_behaviours(tmp_path: Path) -> None:
    recorded = acrobats(15)
    assert recorded.corrections > 0
    assert without_numpy(recorded, tmp_path) == same(recorded)


@pytest.mark.slow
def test_the_plain_kernel_too(tmp_path: Path) -> None:
    recorded = acrobats(6)
    assert without_numpy(recorded, tmp_path, kernels.PLAIN) == same(recorded)
