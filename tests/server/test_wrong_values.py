"""Wrong values for the game API: each is refused by name, and nothing has changed."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from server.agents import Arena
from server.config.limits import Limits
from server.game import Game
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld
from server.players.player import Player
from server.rules import Rules, RulesError
from shared.checks import MissingError, SceneError
from shared.scene import load_scene
from tests.shared.test_wrong_values import ENTITY, NUMBER, TEMPLATE, THREE, WHOLE, Calls
from tests.tables import Table

FLAT = load_scene("flat")
Act = Callable[[GameApi, Any], Any]
NAN = math.nan
PLAYER, RUNNER, GONE = 1, 2, 3


class Played(Table):
    """A game with a player, a runner that the rules steer, and an entity that has been removed."""

    def __init__(self) -> None:
        super().__init__()
        self.link = self.join()
        self.api = self.game.api
        self.player = self.game.players[PLAYER]
        for x in (8.0, 24.0):
            self.api.spawn("runner", (x, 16.0, 1.0))
        self.api.remove(GONE)
        self.api.share("score", [1])
        self.api.set(RUNNER, "mood", "calm")
        self.tick()


def marks(table: Played) -> tuple[Any, ...]:
    """Returns everything that a call of the rules may change."""
    stage, kept = table.api, table.api.kept
    return (
        table.game.world.state_hash(), len(table.game.world), table.game.world.next_id, dict(stage.steered),
        repr(kept.attributes), repr(kept.shared), len(stage.outgoing), stage.hooks.waiting, list(table.game.players),
    )  # fmt: skip


def refused(act: Act, bad: Any, error: type[Exception], said: str) -> None:
    table, pen = Played(), Calls()
    before = marks(table)
    table.game.world.attach(pen)
    with pytest.raises(error, match=said):
        act(table.api, bad)
    assert marks(table) == before
    assert pen.calls == []
    table.tick(3)
    assert (table.game.faults.total, table.game.counters.rules_failed) == (0, 0)


VALUE: list[Any] = [object(), {1: 2}, {"a": {1}}, 1j, "x" * 300, 1 << 70, np.int64(3), [[[]] * 400], Player(1)]
NAME: list[Any] = [None, 5, "", "n" * 33, b"name", ["name"]]

CASES: list[tuple[str, str, Act, list[Any]]] = [
    ("ticks", "seconds = ", lambda g, bad: g.ticks(bad), NUMBER),
    ("entities", "template = ", lambda g, bad: g.entities(bad), [bad for bad in TEMPLATE if bad is not None]),
    ("spawn template", "template = ", lambda g, bad: g.spawn(bad, (8, 8, 1)), TEMPLATE),
    ("spawn position", "position", lambda g, bad: g.spawn("stone", bad), [
        *THREE, (8, NAN, 1), (8, 8, True),
    ]),
    ("spawn velocity", "velocity", lambda g, bad: g.spawn("stone", (8, 8, 1), bad), [
        *THREE, (0, 0, NAN), (0, 0, 1025),
    ]),
    ("spawn attribute", "mood", lambda g, bad: g.spawn("stone", (8, 8, 1), mood=bad), VALUE),
    ("spawn attributes", "template 'stone': more than 32", lambda g, bad: g.spawn("stone", (8, 8, 1), **bad), [
        {f"a{n}": n for n in range(33)},
    ]),
    ("remove player", "entity = 1: is a player's", lambda g, bad: g.remove(bad), [PLAYER, np.int64(PLAYER)]),
    ("place", "position", lambda g, bad: g.place(RUNNER, bad), [*THREE, (0, 0, NAN), ("1", 0, 0)]),
    ("throw", "velocity", lambda g, bad: g.throw(RUNNER, bad), [*THREE, (0, 0, NAN), (0, 0, 2000)]),
    ("push", "velocity", lambda g, bad: g.push(RUNNER, bad), [*THREE, (0, 0, NAN), (0, 0, 2000)]),
    ("change", "template = ", lambda g, bad: g.change(RUNNER, bad), TEMPLATE),
    ("steer player", "entity = 1: is a player's", lambda g, bad: g.steer(bad, 1, 0), [PLAYER]),
    ("steer x", "x = ", lambda g, bad: g.steer(RUNNER, bad, 0), [NAN, math.inf, "1", None, [1]]),
    ("steer y", "y = ", lambda g, bad: g.steer(RUNNER, 0, bad), [NAN, math.inf, "1", None, [1]]),
    ("steer jump", "jump = ", lambda g, bad: g.steer(RUNNER, 0, 0, jump=bad), ["no", None, 0.5]),
    ("block", "x = ", lambda g, bad: g.block(bad, 0, 0), WHOLE),
    ("set_block x", "x = ", lambda g, bad: g.set_block(bad, 8, 5, 1), WHOLE),
    ("set_block z", "z = ", lambda g, bad: g.set_block(8, 8, bad, 1), WHOLE),
    ("set_block kind", "kind = ", lambda g, bad: g.set_block(8, 8, 5, bad), [*WHOLE, -1, 256]),
    ("set_block nowhere", r"block \(99, 8, 5\)", lambda g, bad: g.set_block(99, 8, 5, bad), [1]),
    ("kind", "kind = ", lambda g, bad: g.kind(bad), ["lava", "", None, 3, ["water"]]),
    ("rewound player", "player = ", lambda g, bad: g.rewound(bad), [None, PLAYER, "Ann"]),
    ("rewound seen", "seen = ", lambda g, bad: g.rewound(g.players[PLAYER], bad), [
        bad for bad in NUMBER if bad is not None
    ]),
    ("set name", "name = ", lambda g, bad: g.set(RUNNER, bad, 1), NAME),
    ("set value", "mood", lambda g, bad: g.set(RUNNER, "mood", bad), VALUE),
    ("get name", "name = ", lambda g, bad: g.get(RUNNER, bad), NAME),
    ("share name", "name = ", lambda g, bad: g.share(bad, 1), NAME),
    ("share value", "score", lambda g, bad: g.share("score", bad), VALUE),
    ("send name", "name = ", lambda g, bad: g.send(bad), NAME),
    ("send data", "send 'boom': data = ", lambda g, bad: g.send("boom", bad), [*VALUE[:4], "x" * 2000]),
    ("send to", "to = ", lambda g, bad: g.send("boom", 1, bad), [PLAYER, "Ann", [PLAYER], [None], {"a": 1}, object()]),
]  # fmt: skip


@pytest.mark.parametrize(("said", "act", "wrong"), [case[1:] for case in CASES], ids=[name for name, *_ in CASES])
def test_a_wrong_value_is_named_and_nothing_is_done(said: str, act: Act, wrong: list[Any]) -> None:
    for bad in wrong:
        refused(act, bad, SceneError, f"^{said}")


BY_ENTITY: dict[str, Act] = {
    "position": lambda g, e: g.position(e),
    "velocity": lambda g, e: g.velocity(e),
    "touching": lambda g, e: g.touching(e),
    "template": lambda g, e: g.template(e),
    "remove": lambda g, e: g.remove(e),
    "place": lambda g, e: g.place(e, (8, 8, 1)),
    "throw": lambda g, e: g.throw(e, (0, 0, 1)),
    "push": lambda g, e: g.push(e, (0, 0, 1)),
    "change": lambda g, e: g.change(e, "cube"),
    "steer": lambda g, e: g.steer(e, 1, 0),
    "set": lambda g, e: g.set(e, "mood", 1),
}


@pytest.mark.parametrize("name", BY_ENTITY)
def test_an_entity_that_is_not_there_is_named(name: str) -> None:
    refused(BY_ENTITY[name], GONE, MissingError, f"^entity = {GONE}: has been removed$")
    refused(BY_ENTITY[name], 99, MissingError, "^entity = 99: there is no such entity$")
    with pytest.raises(KeyError):
        BY_ENTITY[name](Played().api, 99)


@pytest.mark.parametrize("name", [*BY_ENTITY, "get"])
def test_a_value_that_is_no_entity_number_is_named(name: str) -> None:
    reads: Act = lambda g, e: g.get(e, "mood")  # noqa: E731
    act = BY_ENTITY.get(name, reads)
    for bad in [*ENTITY, 0, -1, 1 << 31]:
        refused(act, bad, SceneError, "^entity = ")
        assert bad not in Played().api
    table = Played()
    with pytest.raises(
        SceneError, match=r"^entity = <Player '', entity 1>: is a player; its entity is `player.entity`"
    ):
        act(table.api, table.player)


def test_numbers_of_numpy_do_what_pythons_do() -> None:
    made = []
    kinds: list[tuple[Any, Any]] = [(int, float), (np.int64, np.float32), (np.uint8, np.float64)]
    for whole, real in kinds:
        table = Played()
        game: Any = table.api
        pen = Calls()
        table.game.world.attach(pen)
        runner = whole(RUNNER)
        game.place(runner, np.array((10, 10, 2), np.int64))
        game.throw(runner, (real(1), real(0), real(4)))
        game.push(runner, (real(1), real(0), real(4)))
        game.steer(runner, real(1), whole(0), jump=True)
        game.change(runner, "cube")
        game.set(runner, "mood", "cross")
        game.set_block(whole(9), whole(9), whole(9), whole(5))
        entity = game.spawn("stone", (real(20), real(20), real(3)), told=1)
        assert game.block(whole(9), whole(9), whole(9)) == 5
        assert game.get(runner, "mood") == "cross"
        assert runner in game
        assert game.ticks(real(2)) == 128
        table.tick(4)
        game.remove(whole(entity))
        table.tick()
        assert table.link.closings == []
        made.append((table.game.world.state_hash(), repr(pen.calls), repr(game.kept.attributes)))
    assert len(set(made)) == 1


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"scene": None}, SceneError, "scene = None: must be a `Scene`"),
        ({"scene": "flat"}, SceneError, "scene = 'flat': must be a `Scene`"),
        ({"limits": {"clients_max": 3}}, SceneError, "limits = .*: must be a `Limits`"),
        ({"world": "world"}, SceneError, "world = 'world': must be a `RecordedWorld`"),
        ({"world": RecordedWorld(load_scene("arena"), compiled=False)}, SceneError, "world: is one of <Scene 'arena'"),
        ({"seed": 1.5}, SceneError, "seed = 1.5: must be a whole number"),
        ({"seed": True}, SceneError, "seed = True: must be a whole number"),
        ({"authenticate": "token"}, RulesError, "authenticate = 'token': must be a function"),
        ({"rules": Rules}, RulesError, r"rules = Rules: is a class; pass an instance, Rules\(\)"),
        ({"rules": "tag:Tag"}, RulesError, "rules = 'tag:Tag': must be an instance of a subclass"),
    ],
)
def test_a_game_of_wrong_parts_is_refused(given: dict[str, Any], error: type[Exception], said: str) -> None:
    whole: dict[str, Any] = {"scene": FLAT, "compiled": False} | given
    with pytest.raises(error, match=f"^{said}"):
        Game(**whole)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("clients_max", 1.5), ("clients_max", True), ("clients_max", -1), ("clients_max", "5"), ("hello_s", math.nan),
        ("hello_s", -1), ("edits_per_s", "1"), ("loopback_exempt", 1), ("resume_s", None),
    ],
)  # fmt: skip
def test_a_limit_of_the_wrong_kind_is_named(name: str, bad: Any) -> None:
    with pytest.raises(SceneError, match=f"^{name} = "):
        Limits(**{name: bad})


@pytest.mark.parametrize(("name", "bad"), [("agents", 1.5), ("agents", True), ("repeat", "1"), ("seconds", math.nan)])
def test_an_arena_of_wrong_numbers_is_refused(name: str, bad: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name} = "):
        Arena("flat", compiled=False, **{name: bad})
