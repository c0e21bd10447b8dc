"""The soak test in its smallest form: everything at once for a quarter of a minute, and that it detects faults."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.soak_test import app as soak
from scripts.soak_test.cells import Cells
from scripts.soak_test.disturbance import QUIET_SHARE, Course
from scripts.soak_test.server_process import logged
from scripts.soak_test.walkers import Walker
from shared import messages
from tests.e2e.processes import ROOT
from tests.worlds import build, floor

MINUTES = 0.25
CLIENTS = 8

pytestmark = pytest.mark.e2e


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="suspends processes")
def test_everything_at_once_loses_no_edit_and_leaves_no_error_unexplained(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    command = (str(ROOT / "scripts" / "soak.py"), "--minutes", str(MINUTES), "--clients", str(CLIENTS))
    ended = subprocess.run([sys.executable, *command, "--json", str(out)], capture_output=True, text=True, timeout=240)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = json.loads(out.read_text("utf-8"))
    assert found["lost_edits"] == found["unexplained_errors"] == 0
    assert found["honest_snapshot_share"] > 0.5
    details = found["details"]
    assert details["lives"] == 2
    assert details["counts"]["kill"] == details["counts"]["stall"] == details["counts"]["abuse"] == 1
    assert details["counts"]["came back"] > 0
    assert details["blocks_checked"] > 0
    assert details["inputs_used"] > 0.5 * details["snapshots_due"]
    assert details["stuck_s_max"] <= soak.STUCK_S_MAX
    assert details["blocks_walked_least"] > 5


def test_an_acknowledged_edit_that_is_missing_is_found() -> None:
    world, untouched = build([floor()]), build([floor()])
    cells, rng = Cells(), random.Random(1)
    done, open_, refused = (0, 0, 1), (1, 0, 1), (2, 0, 1)
    kinds = [cells.ask(7, cell, rng) for cell in (done, open_, refused)]
    assert None not in kinds
    assert cells.ask(8, done, rng) is None, "it belongs to another client"
    cells.answered(done, kinds[0] or 0, messages.DONE)
    cells.answered(refused, kinds[2] or 0, messages.OVERLAPS)
    assert len(cells.lost(world, untouched)) == 1
    world.set_block(*done, kinds[0] or 0)
    assert cells.lost(world, untouched) == []
    world.set_block(*open_, kinds[1] or 0)
    assert cells.lost(world, untouched) == [], "no client got its verdict"
    world.set_block(*refused, 9)
    assert len(cells.lost(world, untouched)) == 1


def test_each_log_entry_is_explained_or_an_error(tmp_path: Path) -> None:
    told = [("started", "info"), ("the event loop has stalled", "warning"), ("internal error in serving", "error")]
    lines = [json.dumps({"event": event, "level": level}) for event, level in told]
    (tmp_path / "log 1").write_text("\n".join([*lines, "Traceback (most recent call last):"]) + "\n", "utf-8")
    bad, explained = logged(tmp_path)
    assert [line.partition(": ")[2] for line in bad] == [lines[2], "Traceback (most recent call last):"]
    assert explained == {"the event loop has stalled": 1}


def test_a_player_who_was_stuck_is_an_error() -> None:
    walker = Walker(0, 0)
    assert soak.wrongs(walker) == []
    walker.progress.stuck_s = soak.STUCK_S_MAX + 0.5
    walker.unexplained.append("left")
    assert soak.wrongs(walker) == ["left", "stuck for 1.5 s"]


def test_a_course_has_one_of_each_at_least_and_a_quiet_end() -> None:
    for minutes in (0.25, 1.0, 30.0):
        plan = Course(60 * minutes, random.Random(2)).plan()
        assert {what for _, what in plan} == {"kill", "stall", "abuse"}
        assert all(at <= 60 * minutes * (1 - QUIET_SHARE) for at, what in plan if what == "kill")
        assert plan == sorted(plan)
