"""`bench.py scale`: figures with their scatter; what cannot be measured is not shown as a result."""

import random
import re
from typing import Any

import pytest
from rich.console import Console

from scripts.benchmarks import scale
from scripts.benchmarks.scale_work import PARTS, work
from scripts.benchmarks.slopes import Figure, Line, fit, mean
from shared.scene import load_scene


def test_the_line_through_points_on_a_line_has_no_scatter() -> None:
    line = fit([(50, 400.0), (100, 500.0), (150, 600.0)])
    assert line.per.value == pytest.approx(2.0)
    assert line.base.value == pytest.approx(300.0)
    assert line.per.scatter == pytest.approx(0.0)
    assert line.base.scatter == pytest.approx(0.0)


def test_the_scatter_holds_the_true_cost_nearly_always() -> None:
    rng = random.Random(1)
    held = 0
    for _ in range(400):
        points = [(n, 700 + 5 * n + rng.gauss(0, 90)) for n in (50, 100, 150) for _ in range(6)]
        per, base = fit(points)
        held += abs(per.value - 5) <= per.scatter and abs(base.value - 700) <= base.scatter
    assert held > 340


def test_a_figure_below_its_scatter_is_no_result() -> None:
    assert str(Figure(5.31, 0.42)) == "5.3 +-0.4"
    assert str(Figure(-10.3, 2.5)) == "below what can be measured (+-2.5)"
    assert str(Figure(1.0, 1.5)) == "below what can be measured (+-1.5)"
    assert str(Figure(0.33, 0.02)) == "0.33 +-0.02"
    ratio = Figure(60.0, 6.0).over(Figure(50.0, 5.0))
    assert (ratio.value, round(ratio.scatter, 2)) == (1.2, 0.17)
    assert mean([1.0, 2.0, 3.0]).value == 2.0


def made(rng: random.Random, noise: float, per: dict[str, float]) -> dict[str, Any]:
    """Returns measurements with a cost per player of each process, and with noise."""

    def us(name: str, players: int) -> float:
        return 900 + per.get(name, 0.0) * players + rng.gauss(0, noise)

    def windows(*names: str) -> list[dict[str, float]]:
        numbers = [n for n in (50, 100, 150) for _ in range(6)]
        return [{"players": n, "calm": True, **{name: us(name, n) for name in names}} for n in numbers]

    trip = {"p50": 4.0, "p99": 6.0, "max": 7.0}
    bus = {"log_bytes": 80.0, "batch_bytes": 60.0, "bus_round_trip_ms": trip, "edge_lead_ms": 3.0, "batches_late": 0}
    return {
        "players": [50, 100, 150],
        "work": windows(*PARTS, "log", "batches"),
        "live": windows("server") + windows("edge", "sequencer", "standby", "bus"),
        "bus": [{"players": n, "ticks": 90, **bus} for n in (50, 100, 150)],
        "takeover_ms": [255.0, 256.0],
    }


def shown(figures: dict[str, Any]) -> str:
    console = Console(width=200, record=True, quiet=False, file=None, force_terminal=False)
    with console.capture() as captured:
        scale.show(figures, console)
    return captured.get()


def test_noise_is_never_shown_as_a_result() -> None:
    """Without any cost per player, half of the slopes are negative."""
    for seed in range(20):
        text = shown(made(random.Random(seed), 200.0, {}))
        assert not re.search(r"(?<!\+)-\d", text), text
        assert "below what can be measured" in text
        if "no arithmetic" not in text:
            assert "arithmetic from these figures, not measured" in text


def test_the_arithmetic_follows_from_the_figures() -> None:
    per = {"edge": 30.0, "server": 28.0, "sequencer": 5.0, "standby": 1.0, "game": 8.0}
    text = shown(made(random.Random(1), 1.0, per))
    assert re.search(r"process: one process, per client +\S* *28\.0", text)
    assert "arithmetic from these figures, not measured" in text
    flat = Figure(0.0, 0.0)
    lines = {name: Line(Figure(per[name], 0.0), flat) for name in ("edge", "sequencer", "standby")}
    rows = {players: (edges, load) for players, edges, load in scale.arithmetic(lines)}
    assert [rows[players][0] for players in (1000, 10_000)] == [2, 22]  # 29 us each of 23,333 less those of the replica
    assert [rows[players][1] for players in (1000, 10_000)] == pytest.approx([0.15, 1.5])
    assert scale.arithmetic(lines | {"standby": Line(Figure(9.0, 0.0), flat)})[2][:2] == (5000, 0)


def test_the_loss_is_told_for_each_number_of_clients() -> None:
    rows = [{"players": n, name: us * n} for n in (50, 100) for us in (40.0, 44.0) for name in ("server",)]
    rows += [{"players": n, "edge": 1.1 * us * n} for n in (50, 100) for us in (40.0, 44.0)]
    found = scale.losses(rows)
    assert [round(found[n].value, 6) for n in (50, 100)] == [10.0, 10.0]


def test_the_work_of_all_parts_is_measured() -> None:
    rows = work(load_scene("meadow"), (2, 4), 1, 1)
    assert [row["players"] for row in rows] == [4, 2]
    assert all(row[name] > 0 for row in rows for name in (*PARTS, "log", "batches"))


def test_windows_with_late_batches_do_not_count_if_enough_others_do() -> None:
    figures = made(random.Random(1), 1.0, {"edge": 30.0, "server": 28.0, "sequencer": 5.0, "standby": 1.0})
    for row in figures["live"]:
        if "edge" in row and row["players"] == 150:
            row["calm"], row["edge"] = False, 2 * row["edge"]
    assert "6 of 36 windows of processes, in which many batches were late, do not count" in shown(figures)
    assert scale.costs(figures)[1]["edge"].per.value == pytest.approx(30.0, abs=0.2)
    for row in figures["live"]:
        row["calm"] = "server" in row
    assert "18 of 36 windows of processes, in which many batches were late, count all the same" in shown(figures)
