"""Contacts that end and begin again, contacts with blocks, and zones."""

from pathlib import Path
from typing import Any

import pytest

from server.game_api.zones import ZONES_MAX
from server.rules import Rules
from shared.checks import SceneError
from shared.template import Template
from sovereign_netcode.examples.freeze import Freeze
from tests.server.test_persisted_state import Stored
from tests.tables import FLOOR, Table

WALL = [[0, 0, 0, 32, 32, 1, 1], [20, 0, 1, 21, 32, 5, 2]]
"""A floor, and a wall at x = 20."""


class Witness(Rules):
    """Rules that record contacts and visits with the tick."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def on_contact(self, a: int, b: int) -> None:
        self.calls.append(("contact", a, b))

    def on_contact_end(self, a: int, b: int) -> None:
        self.calls.append(("end", a, b))

    def on_enter(self, zone: str, entity: int) -> None:
        self.calls.append(("enter", zone, entity))

    def on_exit(self, zone: str, entity: int) -> None:
        self.calls.append(("exit", zone, entity))


class Bumps(Rules):
    """Rules that record contacts with blocks."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def on_block_contact(self, entity: int, x: int, y: int, z: int) -> None:
        self.calls.append((entity, x, y, z))


def taken(rules: Witness | Bumps) -> list[tuple[Any, ...]]:
    """Returns the calls since the last time."""
    calls, rules.calls = rules.calls, []
    return calls


def pair(table: Table) -> tuple[int, int]:
    """Returns two entities that touch."""
    a, b = (table.game.api.spawn("runner", (x, 16.0, 1.0)) for x in (10.0, 10.625))
    table.tick()
    return a, b


def test_a_contact_ends_when_one_goes_or_is_removed() -> None:
    rules = Witness()
    table = Table(rules=rules)
    table.tick()
    game = table.game.api
    a, b = pair(table)
    assert taken(rules) == [("contact", a, b)]
    table.tick(5)
    assert taken(rules) == []
    game.steer(a, -1, 0)
    table.tick(2)
    assert taken(rules) == [("end", a, b)]
    game.place(a, (10.0, 16.0, 1.0))
    table.tick()
    assert taken(rules) == [("contact", a, b)]
    game.remove(b)
    table.tick()
    assert taken(rules) == [("end", a, b)]
    table.tick(5)
    assert taken(rules) == []


def test_rules_without_a_hook_of_contacts_pay_nothing() -> None:
    table = Table(rules=Rules())
    table.tick()
    assert not table.game.api.hooks._watchers._active
    table.game.api.add_zone("a", (0, 0, 0), (1, 1, 1))
    assert not table.game.api.hooks._watchers._active


def test_a_contact_comes_again_after_a_change() -> None:
    rules = Witness()
    table = Table(rules=rules)
    table.tick()
    a, b = pair(table)
    taken(rules)
    table.game.api.change(b, "ghost")
    table.tick()
    assert taken(rules) == [("contact", a, b)]
    table.game.api.change(b, "ghost")
    table.tick(3)
    assert taken(rules) == []
    table.game.api.change(a, "ghost")
    table.game.api.change(b, "runner")
    table.tick(3)
    assert taken(rules) == [("contact", a, b)]


def test_a_change_by_the_contact_itself_does_not_repeat_it() -> None:
    class Swap(Witness):
        def on_contact(self, a: int, b: int) -> None:
            super().on_contact(a, b)
            kinds = [self.game.template(entity) for entity in (a, b)]
            for entity, kind in ((a, kinds[1]), (b, kinds[0])):
                self.game.change(entity, kind)

    rules = Swap()
    table = Table(rules=rules)
    table.tick()
    a = table.game.api.spawn("runner", (10.0, 16.0, 1.0))
    b, c = (table.game.api.spawn("ghost", (x, 16.0, 1.0)) for x in (10.625, 11.25))
    table.tick()
    assert taken(rules) == [("contact", a, b), ("contact", b, c)]
    assert [table.game.api.template(entity) for entity in (a, b, c)] == ["ghost", "ghost", "runner"]
    table.tick()  # b has changed since its contact with a
    assert taken(rules) == [("contact", a, b)]
    table.tick(5)
    assert taken(rules) == []


def test_a_thawed_player_is_frozen_again_by_who_still_touches_it() -> None:
    kinds = [Template(name, walk_speed=3) for name in ("player", "freezer", "frozen")]
    table = Table(rules=Freeze(), templates=tuple(kinds), player="player")
    table.tick()
    game = table.game.api
    hunter, prey = game.spawn("freezer", (10.0, 16.0, 1.0)), game.spawn("player", (10.6, 16.0, 1.0))
    table.tick()
    assert game.template(prey) == "frozen"
    game.change(prey, "player")
    table.tick()
    assert (game.template(hunter), game.template(prey)) == ("freezer", "frozen")


def test_landing_and_running_against_a_wall_are_contacts_with_blocks() -> None:
    rules = Bumps()
    table = Table(rules=rules, fill=WALL)
    table.tick()
    game = table.game.api
    runner = game.spawn("runner", (18.0, 16.5, 3.0))
    table.tick(40)
    assert taken(rules) == [(runner, 18, 16, 0)]
    game.steer(runner, 1, 0)
    table.tick(40)
    assert taken(rules) == [(runner, 20, 16, 1)]
    game.steer(runner, 1, 1)  # along the wall, over other blocks
    table.tick(40)
    assert game.position(runner)[1] > 18
    assert taken(rules) == []
    game.steer(runner, -1, 0)
    table.tick(4)
    game.steer(runner, 0, 0, jump=True)
    table.tick(2)
    game.steer(runner, 0, 0)
    table.tick(80)
    ((landed, _, _, z),) = taken(rules)
    assert (landed, z) == (runner, 0)


def test_a_ball_hits_a_wall_and_a_ceiling() -> None:
    rules = Bumps()
    table = Table(rules=rules, fill=[*WALL, [0, 0, 8, 20, 32, 9, 3]])
    table.tick()
    game = table.game.api
    flung = game.spawn("stone", (15.0, 16.5, 3.0), (20.0, 0.0, 4.0))
    table.tick(40)
    hit = [(x, y, z) for _, x, y, z in taken(rules)]
    assert [block for block in hit if block[0] == 20] == [(20, 16, hit[0][2])]
    assert game.entities() == [flung]
    up = game.spawn("stone", (5.5, 5.5, 5.0), (0.0, 0.0, 16.0))
    table.tick(70)
    assert [call for call in taken(rules) if call[0] == up] == [(up, 5, 5, 8), (up, 5, 5, 0)]


def test_block_contacts_after_a_restart_are_not_reported_again(tmp_path: Path) -> None:
    first = Stored(tmp_path, Bumps())
    runner = first.game.api.spawn("runner", (16.5, 16.5, 1.0))
    first.tick(3)
    first.stop()
    rules = Bumps()
    second = Stored(tmp_path, rules)
    second.game.api.steer(runner, 0, 1)
    second.tick(8)
    assert rules.calls == []
    second.stop()


def test_a_zone_reports_visits() -> None:
    rules = Witness()
    table = Table(rules=rules)
    table.tick()
    game = table.game.api
    game.add_zone("goal", (12.0, 14.0, 1.0), (14.0, 18.0, 3.0))
    game.add_zone("beside", (10.0, 14.0, 4.0), (14.0, 18.0, 5.0))
    walker = game.spawn("runner", (10.0, 16.0, 1.0))
    table.tick(2)
    assert taken(rules) == []
    game.steer(walker, 1, 0)
    seen: list[tuple[str, float]] = []
    for _ in range(80):
        game.steer(walker, 1, 0)
        x = game.position(walker)[0]
        assert (game.inside("goal") == [walker]) is (12 - 0.625 < x < 14)
        table.tick()
        seen += [(kind, x) for kind, zone, _ in taken(rules) if zone == "goal"]
    (enter, west), (leave, east) = seen
    assert (enter, leave) == ("enter", "exit")
    assert 12 - 0.625 < west < 12 - 0.5
    assert 14 <= east < 14.125


def test_a_zone_that_is_added_moved_or_removed_around_an_entity() -> None:
    rules = Witness()
    table = Table(rules=rules)
    table.tick()
    game = table.game.api
    here = game.spawn("runner", (10.5, 16.5, 1.0))
    table.tick(3)
    game.add_zone("a", (10, 16, 1), (11, 17, 2))
    table.tick()
    assert taken(rules) == [("enter", "a", here)]
    game.add_zone("a", (10, 16, 1), (12, 17, 2))
    table.tick()
    assert taken(rules) == []
    game.add_zone("a", (20, 16, 1), (22, 17, 2))
    table.tick()
    assert taken(rules) == [("exit", "a", here)]
    game.add_zone("b", (10, 16, 1), (11, 17, 2))
    table.tick()
    game.remove_zone("b")
    table.tick()
    assert taken(rules) == [("enter", "b", here)]
    game.add_zone("b", (10, 16, 1), (11, 17, 2))
    table.tick()
    game.remove(here)
    table.tick()
    assert taken(rules) == [("enter", "b", here), ("exit", "b", here)]
    assert table.game.counters.rules_failed == 0


def test_zones_survive_a_restart(tmp_path: Path) -> None:
    first = Stored(tmp_path, Witness())
    inside = first.game.api.spawn("runner", (16.5, 16.5, 1.0))
    for name, low in (("here", 16), ("there", 20), ("gone", 16)):
        first.game.api.add_zone(name, (low, 16, 1), (low + 1, 17, 2))
    first.tick(2)
    first.game.api.remove_zone("gone")
    first.tick()
    first.stop()
    rules = Witness()
    second = Stored(tmp_path, rules)
    second.tick(2)
    assert rules.calls == []
    second.game.api.place(inside, (20.5, 16.5, 1.0))
    second.tick()
    assert rules.calls == [("exit", "here", inside), ("enter", "there", inside)]
    second.stop()


@pytest.mark.parametrize(
    ("low", "high"),
    [((0, 0, 0), (1, 1, 0)), ((2, 0, 0), (1, 1, 1)), ((0, 0), (1, 1, 1)), ((0, 0, 0), (1, 1, float("nan"))), (1, 2)],
)
def test_wrong_zones_are_refused(low: Any, high: Any) -> None:
    game = Table().game.api
    with pytest.raises(SceneError):
        game.add_zone("zone", low, high)
    with pytest.raises(SceneError, match="zone = 'zone': there is no such zone"):
        game.inside("zone")
    with pytest.raises(SceneError):
        game.add_zone("", (0, 0, 0), (1, 1, 1))


def test_zones_are_bounded() -> None:
    game = Table().game.api
    for number in range(ZONES_MAX):
        game.add_zone(f"{number}", (0, 0, 0), (1, 1, 1))
    game.add_zone("7", (0, 0, 0), (1, 1, 2))
    with pytest.raises(SceneError, match="more than 256 zones"):
        game.add_zone("one more", (0, 0, 0), (1, 1, 1))


def test_two_runs_report_the_same() -> None:
    def run() -> list[tuple[Any, ...]]:
        rules = Witness()
        table = Table(rules=rules, fill=FLOOR)
        table.tick()
        game = table.game.api
        game.add_zone("left", (0, 0, 0), (16, 32, 8))
        game.add_zone("right", (12, 0, 0), (14, 32, 8))
        walkers = [game.spawn("runner", (10.0 + x, 10.0 + y, 1.0)) for x in range(3) for y in range(2)]
        for _ in range(6):
            ways = [(game.random.uniform(-1, 1), game.random.uniform(-1, 1)) for _ in walkers]
            for _ in range(24):
                for walker, way in zip(walkers, ways, strict=True):
                    game.steer(walker, *way)
                table.tick()
        return rules.calls

    calls = run()
    assert calls == run()
    assert {"contact", "end", "enter", "exit"} == {call[0] for call in calls}
