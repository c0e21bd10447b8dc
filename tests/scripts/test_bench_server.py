"""The benchmark of the server: its search with stand-ins of known capacity, and each kind of server once with few
players."""

import sys
import tomllib
from typing import Any, cast

import pytest

from scripts.benchmarks import jitter, rss
from scripts.benchmarks import server as bench
from shared.scene import Scene

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="the generator polls with epoll")


class Holds:
    """A stand-in for a rig: a server that holds `most` clients and works in proportion to their number."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.asked: list[int] = []

    def hold(self, clients: int, seconds: float) -> bench.Figures:
        self.asked.append(clients)
        return {"clients": clients, "held": clients <= self.most, "server_cpu_share": min(1.0, clients / self.most)}


@pytest.mark.parametrize("most", [90, 399, 400, 401, 1000, bench.CAPACITY])
def test_the_search_ends_close_below_the_most_that_is_held(most: int) -> None:
    holds = Holds(most)
    stages = bench.search(cast("bench.Rig", holds), 400, 1.0, 0.04, 20, lambda stage: None)
    best = bench.most(stages)
    assert best is not None
    assert most / 1.05 <= best["clients"] <= most
    assert len(holds.asked) == len(set(holds.asked)) <= 12


def test_a_search_of_few_steps_reports_each_step() -> None:
    told: list[bench.Figures] = []
    stages = bench.search(cast("bench.Rig", Holds(10)), 400, 1.0, 0.2, 3, told.append)
    assert [stage["clients"] for stage in stages] == [400, 200, 100]
    assert stages == told
    assert bench.most(stages) is None


@pytest.mark.parametrize(("players", "per_segment"), [(40, bench.PER_SEGMENT), (30, 30)])
def test_every_player_has_a_spawn_and_a_segment_as_many_as_it_should(players: int, per_segment: int) -> None:
    scene = Scene.from_table({"name": "wide", **tomllib.loads(bench.scene_toml(players, per_segment))})
    assert scene.tick_rate == bench.RATE
    by_segment: dict[tuple[int, int], int] = {}
    for x, y, _ in scene.spawns[:players]:
        cell = (int(x) // 32, int(y) // 32)
        by_segment[cell] = by_segment.get(cell, 0) + 1
    assert set(by_segment.values()) == {per_segment}


@needs_linux
@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.parametrize("kind", ["echo", bench.ECHO_PICOWS, "game", "profile"])
def test_each_kind_of_server_holds_a_few_players(kind: str) -> None:
    more = ("1000",) if kind.startswith("echo") else ()
    with bench.rig(kind, *more, capacity=4, per_segment=4) as running:
        stage: dict[str, Any] = bench.packed(running.hold(4, 0.5))
    assert stage["clients"] == 4
    assert stage["lost"] == 0
    assert stage["cpu_us_per_client_tick"] > 0
    assert stage["bytes_per_client_per_s"] > 0
    assert 0 < stage["fairness"] <= 1
    assert ("samples" in stage) == (kind == "profile")
    if kind in ("game", "profile"):
        assert stage["inputs_used"] > 0
    else:
        assert stage["bytes_per_client_per_s"] > 1000 * bench.RATE / 2


@needs_linux
@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.parametrize("kind", jitter.VARIANTS)
def test_each_variant_of_the_product_has_its_settings(kind: str) -> None:
    uvloop = pytest.importorskip("uvloop")
    with bench.rig(kind, capacity=4, per_segment=4) as running:
        running.hold(4, 0.5)
        made = running.stats()
        assert running.collect() > 0
        assert running.stats()["collections"] > made["collections"]
    assert made["collecting"] == (kind != "off")
    assert (made["frozen"] > 10_000) == (kind in ("product", "asyncio"))
    assert made["loop"] == ("asyncio" if kind == "asyncio" else uvloop.__name__)
    assert sum(n for _, n in made["tick_cpu_counts"]) == sum(n for _, n in made["before_step_cpu_counts"]) > 15


def test_a_variants_quantiles_are_of_all_its_rounds_together() -> None:
    def played(lateness: list[list[int]]) -> bench.Figures:
        times = {f"{name}_counts": lateness for name in jitter.TIMES}
        return dict.fromkeys(jitter.FIGURES, 1.0) | times | {"snapshots_share_worst": 1.0, "generator_cpu_share": 0.2}

    found = jitter.summary([played([[100, 300]]), played([[100, 295], [40_000, 5]])])
    assert found["tick_lateness_ms"] == {"p50": 0.1, "p99": 0.1, "max": 40.0}
    assert found["tick_lateness_ms_of_rounds"]["p99"] == [0.1, 40.0]
    assert found["rss_mb"] == [1.0, 1.0]


@needs_linux
@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.longest
def test_churn_over_sockets_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rss, "SETTLE_S", 18.0)  # a client without a goodbye is kept for 15 s
    told: list[bench.Figures] = []
    found = rss.churn(1 / 3, told.append)
    first, last = found["minutes"]
    assert told == [first, last]
    assert found["rules_failed"] == found["internal_errors"] == 0
    assert last["joined"] > 100
    assert last["removed"] == last["spawned"] > 300
    assert last["segments_loaded"] > 10
    for level, slack in (("clients", 5), ("players", 10), ("entities", 12), ("segments", 1)):
        assert abs(last[level] - first[level]) <= slack, (level, first, last)
    # A connection takes 15 KB. If the server kept lost connections, it would grow by 10 KB for each.
    assert (last["rss_mb"] - first["rss_mb"]) * 1e6 < 5_000 * last["joined"], (first, last)


def test_the_slope_is_that_of_the_line() -> None:
    assert rss.slope([(0.0, 100.0), (1.0, 100.5), (2.0, 101.0)]) == pytest.approx(500.0)
    first = dict.fromkeys(("rss_mb", *rss.LEVELS, *rss.COUNTS), 7)
    assert rss.sample(first, first | {"clients": 9, "joined": 10}, 0.25) == {
        **dict.fromkeys(("rss_mb", *rss.LEVELS), 7),
        **dict.fromkeys(rss.COUNTS, 0),
        "minute": 0.25,
        "clients": 9,
        "joined": 3,
    }


def test_no_spawn_point_is_in_the_margin() -> None:
    scene = Scene.from_table({"name": "wide", **tomllib.loads(bench.scene_toml(20, 5, margin=3))})
    assert scene.size[:2] == (5, 5)
    assert all(max(x, y) < 2 * 32 for x, y, _ in scene.spawns)
