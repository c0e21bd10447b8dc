"""The benchmark of saved worlds as a command: the form of its output; no time is judged."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from shared import kernels

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.skipif(not kernels.available(), reason="with plain Python it takes minutes")
def test_it_measures_and_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    command = [sys.executable, "scripts/bench_store.py", "--quick", "--dir", str(tmp_path / "disk")]
    out = tmp_path / "report.json"
    done = subprocess.run([*command, "--json", str(out)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(out.read_text("utf-8"))
    assert list(report["verdicts"]) == ["nowhere", "process", "power"]
    assert [figures["entities"] for figures in report["checkpoints"]] == [1_000, 10_000]
    assert all(figures["checkpoint_ms"]["max"] > 0 for figures in report["checkpoints"])
    assert report["ticks"]["log_bytes_per_tick"] > 0
    assert report["way_back"]["ticks"] == 192
    assert "step to disk, power" in done.stdout
    assert list((tmp_path / "disk").iterdir()) == []
