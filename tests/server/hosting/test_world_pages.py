"""The pages of many worlds: the list for everybody, the page of all worlds, the live page of each, and metrics."""

import json
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from server.hosting.pages import WorldPages
from server.observability.metrics import metrics_page
from server.observability.pages import Page, PageRequest
from tests.server.hosting.bench import KEEPING, PLAIN, Bench

pytestmark = pytest.mark.usefixtures("alarms")


class Reader(Bench):
    """Worlds with their pages."""

    def __init__(self, folder: Path, *, live: bool = True) -> None:
        super().__init__(folder, PLAIN + KEEPING)
        self.pages = WorldPages(self.worlds, self.host, live=live)

    def get(self, target: str, *, trusted: bool = True) -> Page | None:
        path, _, query = target.partition("?")
        return self.pages.get(PageRequest("GET", path, query, trusted, ""))

    def json(self, target: str, *, trusted: bool = True) -> Any:
        page = self.get(target, trusted=trusted)
        assert page is not None
        assert (page.status, page.content_type) == (200, "application/json")
        return json.loads(page.body)


@pytest.fixture
def reader(tmp_path: Path) -> Reader:
    return Reader(tmp_path)


def test_everybody_sees_the_public_worlds(reader: Reader) -> None:
    assert reader.json("/worlds", trusted=False) == {"worlds": []}
    reader.worlds.create("plain", {"mode": "2v2"}, name="a")
    reader.worlds.create("plain", name="secret", private=True)
    reader.worlds.create("keeping", name="b").locked = True
    reader.join("/a", "Ann")
    reader.pass_s(1.5)
    listed = reader.json("/worlds", trusted=False)["worlds"]
    assert listed == [
        {
            "name": "a", "kind": "plain", "players": 1, "players_max": 16, "locked": False, "full": False,
            "properties": {"mode": "2v2"}, "age_s": pytest.approx(1.5, abs=0.1),
        },
        {
            "name": "b", "kind": "keeping", "players": 0, "players_max": 16, "locked": True, "full": False,
            "properties": {}, "age_s": pytest.approx(1.5, abs=0.1),
        },
    ]  # fmt: skip
    assert [world["name"] for world in reader.json("/worlds?kind=keeping", trusted=False)["worlds"]] == ["b"]
    assert reader.json("/worlds?kind=none", trusted=False) == {"worlds": []}


def test_the_list_is_made_anew_ten_times_per_second_at_most(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    reader.worlds.create("plain", name="a")
    entries, calls = reader.worlds.entries, list[int]()

    def counted() -> list[dict[str, Any]]:
        calls.append(1)
        return entries()

    monkeypatch.setattr(reader.worlds, "entries", counted)
    for _ in range(3):
        for _ in range(100):
            assert len(reader.json("/worlds", trusted=False)["worlds"]) == 1
            assert len(reader.json("/worlds?kind=plain", trusted=False)["worlds"]) == 1
            assert reader.json("/worlds?kind=nothing", trusted=False)["worlds"] == []
        reader.pass_s(0.1)
    assert len(calls) == 6


def test_those_who_may_see_private_pages_see_all_worlds_without_codes(reader: Reader) -> None:
    code = reader.worlds.create("plain", {"mode": "2v2"}, name="a", private=True).code
    reader.join(f"/{reader.worlds.seat('a', '', None, '').path[1:]}", "Ann")
    page = reader.get("/worlds/")
    assert page is not None
    assert page.content_type.startswith("text/html")
    (row,) = reader.json("/worlds/live")["worlds"]
    assert {name: row[name] for name in ("name", "kind", "players", "private", "ticking", "names", "failures")} == {
        "name": "a", "kind": "plain", "players": 1, "private": True, "ticking": True, "names": ["Ann"], "failures": 0,
    }  # fmt: skip
    assert code not in json.dumps(row)


def test_each_world_has_a_live_page_and_figures(reader: Reader) -> None:
    for name in ("a", "b"):
        reader.worlds.create("plain", name=name)
    reader.join("/a", "Ann")
    html = reader.get("/a/")
    assert html is not None
    assert html.content_type.startswith("text/html")
    live = reader.json("/a/live")
    assert (live["scene"], [*live["names"].values()], live["players"]) == ("arena", ["Ann"], [1])
    tile = reader.get("/a/live/0")
    assert tile is not None
    assert tile.body
    stats = reader.json("/a/stats")
    assert (stats["world"], stats["kind"], stats["players"], stats["ticks"]) == ("a", "plain", 1, 1)
    assert reader.json("/b/stats")["players"] == 0
    assert reader.json("/b/live")["players"] == []
    page = reader.get("/a")
    assert page is not None
    assert (page.status, dict(page.headers)["Location"]) == (302, "/a/")
    reader.worlds.end("a", "over")
    assert reader.get("/a/stats") is None


@pytest.mark.parametrize("path", ["/worlds/", "/worlds/live", "/a/", "/a", "/a/live", "/a/live/0", "/a/stats", "/a/x"])
def test_private_pages_are_for_trusted_addresses(reader: Reader, path: str) -> None:
    reader.worlds.create("plain", name="a")
    page = reader.get(path, trusted=False)
    assert page is not None
    assert (page.status, page.body) == (403, f"{path}: not allowed for your address\n".encode())


@pytest.mark.parametrize("path", ["/worlds/x", "/worlds/live/0", "/a/x", "/a/live/99", "/a/live/", "/a/a/", "/a//"])
def test_pages_that_do_not_exist(reader: Reader, path: str) -> None:
    reader.worlds.create("plain", name="a")
    page = reader.get(path)
    assert page is not None
    assert page.status == 404


@pytest.mark.parametrize("path", ["/", "/stats", "/live", "/b/", "/b", "//a", "/A/", "/readyz", ""])
def test_other_paths_are_left_to_the_server(reader: Reader, path: str) -> None:
    reader.worlds.create("plain", name="a")
    assert reader.get(path) is None


def test_without_live_pages_there_are_figures_only(tmp_path: Path) -> None:
    reader = Reader(tmp_path, live=False)
    reader.worlds.create("plain", name="a")
    assert reader.json("/a/stats")["world"] == "a"
    assert reader.json("/worlds/live")["worlds"]
    for path in ("/worlds/", "/a/", "/a", "/a/live"):
        page = reader.get(path)
        assert page is not None
        assert page.status == 404


def test_metrics_have_the_name_of_each_world_that_ticks(reader: Reader) -> None:
    for name in ("a", "b", "c"):
        reader.worlds.create("plain", name=name)
    reader.join("/a")
    reader.join("/b")
    reader.tick("b", 9)
    text = metrics_page(dict, dict, reader.pages.metrics)().body.decode()
    found = {
        (sample.name, sample.labels.get("world")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert found["sovereign_worlds", None] == 3
    assert found["sovereign_worlds_ticking", None] == 2
    assert found["sovereign_world_players", "a"] == 1
    assert found["sovereign_world_ticks_total", "b"] == 10
    assert found["sovereign_world_tick_work_s_total", "b"] > 0
    assert ("sovereign_world_players", "c") not in found
    assert 'sovereign_worlds_events_total{event="created"} 3.0' in text
