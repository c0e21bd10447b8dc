"""The kernel in WebAssembly repeats every recorded call in Node.js with the same results and bytes."""

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared import exports, kernels
from shared.kernels import Kernel
from shared.layout import X
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from tests.kernels import chains
from tests.kernels.tape import Tape
from tests.worlds import build, floor

ROOT = Path(__file__).parent.parent.parent
NODE = shutil.which("node")
WORK = (
    "tests/shared/test_golden.py",
    "tests/shared/test_alike.py",
    "tests/shared/test_follow.py",
    "tests/shared/test_hard_cases_air.py",
    "tests/shared/test_hard_cases_ground.py",
    "tests/shared/test_hard_cases_world.py",
    "tests/shared/test_placing.py",
    "tests/shared/test_properties.py",
    "tests/shared/test_snapshot.py",
    "tests/shared/test_waking.py",
    "tests/server/test_rewind.py",
)

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="there is no Node.js"),
    pytest.mark.skipif(not kernels.available(), reason="there is no compiled kernel to compare with"),
]


@contextlib.contextmanager
def recorded(path: Path, kernel: Kernel | None = None) -> Iterator[Tape]:
    """Makes all compiled worlds of the block record their calls, with `kernel` if it is given."""
    kernel = kernel or kernels.get(True)
    with path.open("wb", 1 << 20) as file, pytest.MonkeyPatch.context() as patch:
        tape = Tape(kernel, file)
        patch.setitem(kernels._kernels, kernel.form, tape.kernel())
        yield tape


def replayed(path: Path) -> str:
    """Returns the output of a tape's replay with the kernel in WebAssembly."""
    assert NODE is not None
    wasm = kernels.LIBRARIES / "kernel.wasm"
    signatures = (f"{name}:{kinds}" for name, kinds in exports.functions(server=False).items())
    command = (
        NODE,
        str(Path(__file__).with_name("replay.mjs")),
        str(wasm),
        str(path),
        str(len(exports.FIELDS)),
        *signatures,
    )
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout.strip()


def test_a_match_of_every_scene_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "tape"
    with recorded(path) as tape:
        for scene in ("arena", "hills"):
            match = Match(load_scene(scene), seed=3)
            for _ in range(3):
                match.join(wander)
            match.run(4)
        world = build([floor()], compiled=True)
        first, _ = world.spawn_many("person", [(0, 0, 0), (0, 0, 2)])
        world.remove(first)
        world.step()
    made = sum(tape.calls.values())
    assert {name for name, count in tape.calls.items() if not count} <= {"relink_range"}
    assert replayed(path) == f"{made} calls"


def test_a_difference_is_found(tmp_path: Path) -> None:
    path, kernel = tmp_path / "tape", kernels.get(True)
    tick = 0

    def collect(entities: Any, rows: int, out: Any) -> int:
        found: int = kernel.collect(entities, rows, out)
        out[12 + X] += tick == 7
        return found

    with recorded(path, Kernel(**(vars(kernel) | {"collect": collect}))):
        world = build(compiled=True)
        world.spawn_many("person", [(0, 0, 0), (4, 0, 0)])
        for tick in range(9):  # noqa: B007 - `collect` looks at it
            world.step()
            world.states()
    assert replayed(path).endswith("collect: array of 192 bytes differs at byte 120")


@pytest.mark.slow
@pytest.mark.parametrize("scene", chains.SCENES)
def test_thousands_of_ticks(scene: str, tmp_path: Path) -> None:
    path = tmp_path / "tape"
    with recorded(path) as tape:
        chains.chain(scene, chains.TICKS, compiled=True)
    assert tape.calls["step"] == chains.TICKS
    assert replayed(path) == f"{sum(tape.calls.values())} calls"


@pytest.mark.slow
@pytest.mark.longest
def test_golden_runs_hard_cases_and_properties(tmp_path: Path) -> None:
    path = tmp_path / "tape"
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.kernels.taping")
    fewer = "not plain and not million_ticks"
    done = subprocess.run(
        (*command, "-m", "not slow", "-k", fewer, *WORK),
        cwd=ROOT,
        env=os.environ | {"TAPE": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    calls = int(next(line for line in done.stdout.splitlines() if line.startswith("taped ")).split()[1])
    assert calls > 50_000
    assert replayed(path) == f"{calls} calls"
