"""The two reports as commands: their form, and the exact figures in them. No time is judged."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from shared import kernels

ROOT = Path(__file__).resolve().parent.parent.parent
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not kernels.numba_installed(), reason="the reports need Numba"),
]

CHOICES = {"format", "integrator", "tick_rate", "mover", "obstacles", "executor"}
COLUMNS = {
    "ns", "apex_error", "landing_error_ms", "minute_error", "inside_share", "inside_depth", "tangential_lost",
    "error_1e6", "error_1e7", "corrections_per_minute",
}  # fmt: skip
Report = dict[str, Any]


def run(out: Path, *command: str) -> Report:
    """Runs a report. Numba optimises little, because compiling takes longest here and no time is judged."""
    done = subprocess.run(
        [sys.executable, *command, "--quick", "--json", str(out)],
        cwd=ROOT, env=os.environ | {"NUMBA_OPT": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report: Report = json.loads(out.read_text("utf-8"))
    return report


@pytest.fixture(scope="module")
def accuracy(tmp_path_factory: pytest.TempPathFactory) -> list[Report]:
    out = tmp_path_factory.mktemp("accuracy")
    report = run(out / "accuracy.json", "scripts/accuracy.py", "--plot", str(out / "picture.png"))
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert len(report["conclusion"]) > 500
    return list(report["rows"])


def test_the_benchmark_reaches_the_hash_of_the_step_in_c(tmp_path: Path) -> None:
    report = run(tmp_path / "physics.json", "scripts/bench.py", "physics")
    for key in ("walk_ns", "walk_pairs_ns", "rest_ns", "million_ms_per_tick"):
        assert report[key] > 0
    assert report["obstacles_agree"]
    assert all(row["low"] <= row["median"] <= row["high"] for row in report["rows"])
    if report["hash_equal_to_c"] is None:
        assert report["ratio_to_c"] is None  # there is no gcc
    else:
        assert report["hash_equal_to_c"] is True
        assert report["ratio_to_c"] > 0


def test_every_row_has_its_choices_and_all_columns_as_numbers(accuracy: list[Report]) -> None:
    for row in accuracy:
        assert row.keys() >= CHOICES
        assert all(isinstance(row[column], int | float) for column in COLUMNS)
    for choice, least in (("format", 5), ("integrator", 3), ("tick_rate", 6), ("mover", 3), ("obstacles", 2)):
        assert len({row[choice] for row in accuracy}) >= least


def test_the_product_is_never_inside_a_block_nor_corrected_nor_off_far_away(accuracy: list[Report]) -> None:
    ours = [row for row in accuracy if row["product"]]
    assert {row["executor"] for row in ours} == {"compiled", "plain"}
    for row in ours:
        for column in ("inside_share", "inside_depth", "error_1e6", "error_1e7", "corrections_per_minute"):
            assert row[column] == 0, (row["tick_rate"], column)
        assert abs(row["tangential_lost"]) < 1e-4


def test_the_mean_meets_the_closed_form_exactly_where_a_tick_is_a_binary_fraction(accuracy: list[Report]) -> None:
    for row in (row for row in accuracy if row["product"] and row["integrator"] == "mean"):
        assert row["landing_error_ms"] == 0
        if 128 % row["tick_rate"] == 0:
            assert row["apex_error"] == 0
        else:
            assert 0 < abs(row["apex_error"]) < 1e-4


def test_the_seeds_integrator_is_too_low_by_the_closed_form(accuracy: list[Report]) -> None:
    for row in (row for row in accuracy if row["product"] and row["integrator"] == "semi"):
        jump, gravity, h = 8.0, 18.0, 1 / row["tick_rate"]
        ticks = range(2 * row["tick_rate"])
        sampled = max(jump * n * h - gravity * (n * h) ** 2 / 2 for n in ticks)
        semi = max(jump * n * h - gravity * h * h * n * (n + 1) / 2 for n in ticks)
        assert row["apex_error"] == pytest.approx(semi - sampled, abs=1e-4)


def test_going_back_along_the_velocity_loses_what_the_clamp_keeps(accuracy: list[Report]) -> None:
    lost = {row["mover"]: row["tangential_lost"] for row in accuracy if row["format"] == "grid 2^-24"}
    assert lost["rewind"] > 0.9
    assert abs(lost["clamp"]) < 1e-3
    assert abs(lost["impact"]) < 1e-3
