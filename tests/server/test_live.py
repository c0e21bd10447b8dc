"""The live page: its content, its bounds, and that it loads nothing from elsewhere."""

import base64
import hashlib
import json
import re
import zlib
from typing import Any

import numpy as np
import pytest

from server.config.settings import load
from server.net.admission import Request
from server.observability.histogram import Histogram
from server.observability.live import ANSWERS_PER_S, SHOWN_MAX, SIDE_MAX, TILE, Live, Relief, html_page
from server.serving import Server
from shared.messages import VERSION, Hello, Inputs
from shared.world import World
from tests.tables import Table
from tests.worlds import build, scene

WIDE = [[0, 0, 0, 320, 320, 1, 3]]


def live(table: Table) -> Live:
    histogram = Histogram()
    histogram.record(0.001)
    return Live(table.game, lambda: table.game.stats() | {"pid": 1, "ready": True}, lambda: {"work": histogram})


def entities(state: dict[str, Any]) -> dict[int, list[int]]:
    """Returns template and position (hundredths of a block) of the entities, by id."""
    rows = np.array(state["entities"]).reshape(-1, 5).tolist()
    return {row[0]: row[1:] for row in rows}


def heights(relief: Relief, number: int) -> tuple[Any, Any]:
    raw = zlib.decompress(relief.tile(number))
    assert len(raw) == 3 * TILE * TILE
    sides = (TILE, TILE)
    return np.frombuffer(raw, "<u2", TILE * TILE).reshape(sides), np.frombuffer(raw[-TILE * TILE :], "u1").reshape(
        sides
    )


def top(world: World, x: int, y: int) -> tuple[int, int]:
    """Returns the height of a column above the lowest block and the kind of its top, by a look at each block."""
    low = world.scene.origin[2] * 32
    for z in reversed(range(low, low + world.scene.size[2] * 32)):
        if kind := world.blocks.get(x, y, z):
            return z - low + 1, kind
    return 0, 0


def test_places_and_names_of_players() -> None:
    table = Table(resume_s=10.0)
    ann = table.connect(Hello(VERSION, {}, "<b>Ann", "secret-token"))
    table.connect(Hello(VERSION, {}, ""))
    table.tick()
    game = table.game
    slab = game.api.spawn("slab", (4.25, 7.5, 2.0), name="the slab")
    page = live(table)
    before = page.state()
    assert before["scene"] == "test"
    assert before["players"] == [1, 2]
    assert before["names"] == {1: "<b>Ann", slab: "the slab"}
    assert before["away"] == []
    assert entities(before)[slab] == [3, 425, 750, 200]
    assert entities(before)[1] == [0, *(int(100 * part // 1) for part in game.world.position(1))]
    assert before["templates"][3] == ["slab", 0.0, 0.0, 0.0, 4.0, 4.0, 1.0, False]
    assert before["figures"]["clients"] == 2
    assert "pid" not in before["figures"]
    ann.say(Inputs(table.tick_number + 1, -1, bytes((127, 0, 0)) * 8))
    table.tick(8)
    after = entities(page.state())
    assert after[1][1] > entities(before)[1][1], "Ann walks east"
    table.lose(ann)
    text = json.dumps(page.state())
    assert json.loads(text)["away"] == [1]
    assert "secret" not in text
    assert ann.session.player is not None
    assert ann.session.player.tokens[0].hex() not in text


def test_shared_values_that_json_lacks_are_shown_as_text() -> None:
    table = Table()
    table.join()
    shares = {"time": 1.5, "seed": b"\x00", "odds": float("nan"), "of": [{"id": b"\x01"}], "teams": ["red"]}
    for name, value in shares.items():
        table.game.api.share(name, value)
    answer = live(table).pages()["/live"]()

    def no_json(name: str) -> None:
        raise AssertionError(name)

    told = json.loads(answer.body, parse_constant=no_json)["shared"]
    assert told == {"time": 1.5, "seed": "b'\\x00'", "odds": "nan", "of": "[{'id': b'\\x01'}]", "teams": ["red"]}


def test_one_answer_serves_all_viewers_for_an_eighth_of_a_second() -> None:
    table = Table()
    table.join()
    answer = live(table).pages()["/live"]
    first = answer()
    assert (first.status, first.content_type) == (200, "application/json")
    table.tick(table.game.scene.tick_rate // ANSWERS_PER_S - 1)
    assert answer() is first
    table.tick()
    assert json.loads(answer().body)["figures"]["tick"] == table.tick_number


@pytest.mark.slow
def test_a_crowd_shows_all_players_and_a_sample_of_the_other_entities() -> None:
    table = Table(size=(10, 10, 1), fill=WIDE)
    table.join()
    world = table.game.world
    crowd = world.spawn_many("stone", [(x + 0.1, y + 0.1, 1.0) for y in range(20, 120) for x in range(20, 120)])
    late = table.join().session.entity
    state = live(table).state()
    shown = entities(state)
    assert SHOWN_MAX / 2 < len(shown) <= 2 * SHOWN_MAX
    assert {1, late} <= shown.keys()
    assert shown.keys() <= {1, late, *crowd}
    assert live(table).state()["entities"] == state["entities"], "the same entities again"
    assert state["figures"]["entities"] == len(crowd) + 2


def test_the_ground_is_what_lies_on_top() -> None:
    world = build([[-32, -32, -32, 32, 20, -30, 1], [3, 4, -30, 9, 6, 11, 7], [5, 5, 20, 6, 6, 21, 250]])
    relief = Relief(world)
    assert (relief.step, relief.columns, relief.rows) == (1, 1, 1)
    found, kinds = heights(relief, 0)
    at = [(x, y) for y in range(TILE) for x in range(TILE)]
    assert [(int(found[y, x]), int(kinds[y, x])) for x, y in at] == [top(world, x - 32, y - 32) for x, y in at]
    world.unload_segment((0, 0, 0))
    assert int(heights(relief, 0)[0][37, 37]) == 32, "a segment that is not loaded is not shown, but the one below is"


def test_only_the_tile_that_changed_is_another_one() -> None:
    world = build(WIDE, origin=(0, 0, 0), size=(10, 10, 1))
    relief = Relief(world)
    before, packed = relief.versions(), relief.tile(7)
    assert (relief.columns, relief.rows) == (5, 5)
    world.set_block(2 * TILE + 5, TILE + 6, 3, 9)
    after = relief.versions()
    assert [n for n in range(25) if before[n] != after[n]] == [7]
    assert relief.tile(7) != packed
    found, kinds = heights(relief, 7)
    assert (found[6, 5], kinds[6, 5], found[5, 5]) == (4, 9, 1)
    world.set_block(2 * TILE + 5, TILE + 6, 3, 0)
    assert relief.versions() == before
    assert relief.tile(7) == packed


@pytest.mark.parametrize(("size", "step"), [((16, 3, 1), 1), ((17, 1, 1), 2), ((1, 600, 1), 64)])
def test_a_large_world_is_sampled(size: tuple[int, int, int], step: int) -> None:
    made = scene([[0, 0, 0, 20000, 20000, 2, 1], [0, 0, 0, step, 20000, 5, 2]], origin=(0, 0, 0), size=size)
    world = World(made, compiled=False)
    world.load_terrain(index for index in made.segments() if index[0] < 2 and index[1] < 5)
    relief = Relief(world)
    assert relief.step == step
    assert relief.columns * TILE <= SIDE_MAX
    assert relief.rows * TILE <= SIDE_MAX
    assert len(relief.versions()) == relief.columns * relief.rows
    found, _ = heights(relief, 0)
    across = np.repeat([5, 2], [1, TILE - 1])[None, :].repeat(TILE, 0)
    inside = [
        min(-(-min(loaded, part) * 32 // step), TILE) for loaded, part in zip((5, 2), (size[1], size[0]), strict=True)
    ]
    assert (found[: inside[0], : inside[1]] == across[: inside[0], : inside[1]]).all()
    assert not found[inside[0] :].any()
    assert not found[:, inside[1] :].any()


def test_the_page_allows_its_own_script_and_style_and_nothing_else() -> None:
    page = html_page()
    text = page.body.decode()
    headers = dict(page.headers)
    policy = dict(rule.split(" ", 1) for rule in headers["Content-Security-Policy"].split("; "))
    assert policy.pop("connect-src") == "'self'"
    for tag in ("script", "style"):
        (inside,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert policy.pop(f"{tag}-src") == f"'sha256-{digest}'"
    assert set(policy.values()) == {"'none'"}
    assert not re.findall(r"//[\w.-]+\.\w|@import|\bsrc=|<link|url\(|innerHTML|outerHTML|insertAdjacent|\bstyle=", text)


def test_the_page_needs_access_to_figures_and_can_be_switched_off() -> None:
    def statuses(address: str, **flags: str) -> list[int]:
        server = Server(load(flags, {}), Table().game)
        asked = (Request("GET", path, "", None, upgrade=False) for path in ("/", "/live", "/live/0", "/live/1"))
        return [page.status for request in asked if (page := server.admission.answer(request, address, 0.0))]

    assert statuses("127.0.0.1") == [200, 200, 200, 404]
    assert statuses("93.184.215.14") == [426, 403, 403, 404]
    assert statuses("93.184.215.14", figures="all") == [200, 200, 200, 404]
    assert statuses("127.0.0.1", page="false") == [426, 404, 404, 404]
