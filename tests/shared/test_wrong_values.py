"""Wrong values for a world or a scene: each is refused by name, and nothing has changed."""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from server.journal.recorded_world import Observer, RecordedWorld
from shared.blocks import FILL_MAX
from shared.checks import MissingError, SceneError
from shared.inputs import Input, make_input
from shared.scene import Scene, Template, load_scene
from shared.world import World
from shared.world_state import WorldState
from tests.worlds import build, floor, scene

NAN, INF = math.nan, math.inf
STATE = (1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)

Act = Callable[[World], Any]

WHOLE: list[Any] = [1.5, NAN, INF, "1", None, True, np.True_, np.float64(1), [1], np.array([1, 2]), 10**5000, b"1"]
"""Values that are not whole numbers."""
NUMBER: list[Any] = [NAN, INF, -INF, "1", None, True, np.True_, [1.0], np.array([1.0]), 1j, 10**400, np.float32(NAN)]
"""Values that are not finite numbers."""
THREE: list[Any] = [
    None,
    5,
    "abc",
    (1, 2),
    (1, 2, 3, 4),
    {1, 2, 3},
    {1: 2},
    np.zeros((3, 3)),
    np.array(5),
    iter((1, 2, 3)),
]
"""Values that are not three numbers."""
TEMPLATE: list[Any] = [None, 0, "", "no such", b"box", ["box"], True, np.str_("no such")]
ENTITY: list[Any] = [1.0, "1", None, True, (1,), np.float64(1), np.True_, [1]]


def world_with_two(*, compiled: bool) -> RecordedWorld:
    """Returns a world with a floor and two boxes on it; the second one has been removed."""
    world = RecordedWorld(scene([floor(0)]), compiled=compiled)
    world.load_terrain()
    for x in (0, 4):
        world.spawn("box", (x, 0, 0))
    world.remove(2)
    world.step()
    return world


@functools.cache
def kept_world(compiled: bool) -> RecordedWorld:
    """Returns one such world for many cases: an act that is refused does not change it."""
    return world_with_two(compiled=compiled)


class Calls(Observer):
    def tick(self, world: WorldState, inputs: Any) -> None: ...


def refused(world: RecordedWorld, act: Act, error: type[Exception], said: str) -> None:
    """Runs an act that must be refused, and checks that neither the world nor a recording of it has changed."""
    pen = Calls()
    before = (world.state_hash(), world.tick, world.next_id, len(world), dict(world.editing), set(world.placing))
    world.attach(pen)
    with pytest.raises(error, match=said):
        act(world)
    world.detach(pen)
    assert pen.calls == []
    assert (world.state_hash(), world.tick, world.next_id, len(world), world.editing, world.placing) == before


def field(name: str, act: Callable[[World, Any], Any], wrong: list[Any]) -> list[Any]:
    """Returns the cases of one argument: the act, and the beginning of the error."""
    return [
        pytest.param(lambda world, bad=bad: act(world, bad), name, id=f"{name}-{number}")
        for number, bad in enumerate(wrong)
    ]


CASES = [
    *field(r"x = ", lambda w, bad: w.set_block(bad, 0, 3, 1), [*WHOLE, 1 << 28, -(1 << 28) - 1]),
    *field(r"y = ", lambda w, bad: w.set_block(0, bad, 3, 1), WHOLE[:3]),
    *field(r"z = ", lambda w, bad: w.set_block(0, 0, bad, 1), WHOLE[:3]),
    *field(r"kind = ", lambda w, bad: w.set_block(0, 0, 3, bad), [*WHOLE, -1, 256, np.int64(300)]),
    *field(r"push = ", lambda w, bad: w.set_block(0, 0, 3, 1, push=bad), [None, 1, "yes"]),
    *field(r"block \(99, 0, 0\)", lambda w, bad: w.set_block(99, 0, 0, bad), [0, 1]),
    *field(r"x = ", lambda w, bad: w.block(bad, 0, 0), WHOLE[:3]),
    *field(r"low", lambda w, bad: w.fill(bad, (1, 1, 5), 1), THREE),
    *field(r"high\.y = ", lambda w, bad: w.fill((0, 0, 4), (1, bad, 5), 1), WHOLE),
    *field(r"low = .*, high = .*: .* blocks; at most", lambda w, bad: w.fill((0, 0, 4), bad, 1), [
        (10_000, 10_000, 10_000), (1 << 28, 1 << 28, 1 << 28), (FILL_MAX + 1, 1, 5),
    ]),
    *field(r"high = .*: must not be below low", lambda w, bad: w.fill((1, 1, 4), bad, 1), [
        (0, 2, 5), (2, 0, 5), (2, 2, 3),
    ]),
    *field(r"block \(32, 0, 4\)", lambda w, bad: w.fill((0, 0, 4), bad, 1), [(FILL_MAX, 1, 5), (40, 1, 5)]),
    *field(r"kind = ", lambda w, bad: w.fill((0, 0, 4), (1, 1, 5), bad), WHOLE[:3]),
    *field(r"template = ", lambda w, bad: w.spawn(bad, (0, 8, 0)), TEMPLATE),
    *field(r"position", lambda w, bad: w.spawn("box", bad), THREE),
    *field(r"position\.z = ", lambda w, bad: w.spawn("box", (0, 8, bad)), [*NUMBER, 1 << 29, -1e300]),
    *field(r"velocity", lambda w, bad: w.spawn("box", (0, 8, 0), bad), THREE),
    *field(r"velocity\.x = ", lambda w, bad: w.spawn("box", (0, 8, 0), (bad, 0, 0)), [*NUMBER, 1025]),
    *field(r"push = ", lambda w, bad: w.spawn("box", (0, 8, 0), push=bad), [None, 1]),
    *field(r"template = ", lambda w, bad: w.spawn_many(bad, [(0, 8, 0)]), TEMPLATE),
    *field(r"positions", lambda w, bad: w.spawn_many("box", bad), [
        None, 5, "abc", [], [1, 2, 3], [(0, 8)], [(0, 8, 0), (1, 2)], [("0", "8", "0")], [(0, 8, NAN)], [(0, 8, INF)],
        [(True, False, True)], [(0, 8, 1j)], [(0, 8, 1 << 29)], [object()] * 3, [[[0, 8, 0]]],
    ]),
    *field(r"position", lambda w, bad: w.place(1, bad), THREE),
    *field(r"position\.x = ", lambda w, bad: w.place(1, (bad, 8, 0)), NUMBER),
    *field(r"push = ", lambda w, bad: w.place(1, (0, 8, 0), push=bad), [None, 1]),
    *field(r"velocity", lambda w, bad: w.set_velocity(1, bad), THREE),
    *field(r"velocity\.y = ", lambda w, bad: w.set_velocity(1, (0, bad, 0)), NUMBER),
    *field(r"template = ", lambda w, bad: w.set_template(1, bad), TEMPLATE),
    *field(r"states", lambda w, bad: w.put(bad), [
        None, 5, "abc", [5], [(1, 2)], [STATE, (1, 2)], [STATE, STATE], [(1.5, *STATE[1:])], [(True,) * 12],
        np.zeros((1, 12)), np.zeros((1, 13), np.int64), np.zeros((1, 1, 12), np.int64), [(*STATE[:11], 1 << 70)],
        [("1", *STATE[1:])],
    ]),
    *field(r"states\[1\]\.id = ", lambda w, bad: w.put([STATE, (bad, *STATE[1:])]), [0, -1, 1 << 31]),
    *field(r"states\[0\]\.template = ", lambda w, bad: w.put([(1, bad, *STATE[2:])]), [-1, 7, 99, 1 << 40]),
    *field(r"states\[0\]\.x = ", lambda w, bad: w.put([(*STATE[:3], bad, *STATE[4:])]), [1 << 60, -(1 << 60)]),
    *field(r"states\[0\]\.vz = ", lambda w, bad: w.put([(*STATE[:8], bad, *STATE[9:])]), [1 << 31]),
    *field(r"states\[0\]\.move_x = ", lambda w, bad: w.put([(*STATE[:9], bad, 0, 0)]), [128, -128]),
    *field(r"states\[0\]\.buttons = ", lambda w, bad: w.put([(*STATE[:11], bad)]), [-1, 256]),
    *field(r"segment", lambda w, bad: w.load_segment(bad, np.zeros(32768, np.uint8)), [
        *THREE, (0, 0, 1.5), (0, 0, 1 << 23),
    ]),
    *field(r"kinds = ", lambda w, bad: w.load_segment((0, 0, 0), bad), [
        None, 5, [], np.zeros(5, np.uint8), np.zeros(32768), np.full(32768, 256), np.full(32768, -1),
        np.zeros(32768, bool),
    ]),
    *field(r"segment", lambda w, bad: w.unload_segment(bad), THREE),
    *field(r"segment", lambda w, bad: w.load_terrain([bad]), [*THREE, (0, 0, 1.5)]),
    *field(r"segment", lambda w, bad: w.write_blocks(bad, [0], [1]), THREE),
    *field(r"offsets\[1\] = ", lambda w, bad: w.write_blocks((0, 0, 0), [0, bad], [1, 1]), [*WHOLE, -1, 32768]),
    *field(r"kinds\[0\] = ", lambda w, bad: w.write_blocks((0, 0, 0), [0], [bad]), [*WHOLE, -1, 256]),
    *field(r"kinds: ", lambda w, bad: w.write_blocks((0, 0, 0), [0], bad), [[], [1, 2]]),
    *field(r"turns = ", lambda w, bad: w.follow(bad, 1, 2), [
        np.zeros((1, 8)), np.zeros((1, 7), np.int64), np.zeros(8, np.int64),
    ]),
    *field(r"tick = ", lambda w, bad: w.rebase(bad), [*WHOLE, -2, 1 << 53]),
    *field(r"next_id = ", lambda w, bad: setattr(w, "next_id", bad), [*WHOLE, 2, (1 << 31) + 1]),
    *field(r"inputs\[1\]", lambda w, bad: w.step({1: bad}), [
        None, 5, "abc", (1, 0), (1, 0, 0, 0), Input(1.5, 0, 0), Input(0, NAN, 0), Input(0, 0, 256), Input(0, 0, -1),  # type: ignore[arg-type]
        Input(1 << 40, 0, 0), Input("1", 0, 0),  # type: ignore[arg-type]
    ]),
]  # fmt: skip


@pytest.mark.parametrize(("act", "said"), CASES)
def test_a_wrong_value_is_named_and_nothing_is_done(act: Act, said: str, compiled: bool) -> None:
    refused(kept_world(compiled), act, SceneError, said)


BY_ENTITY: dict[str, Callable[[World, Any], Any]] = {
    "state": lambda w, e: w.state(e),
    "position": lambda w, e: w.position(e),
    "velocity": lambda w, e: w.velocity(e),
    "falling": lambda w, e: w.falling(e),
    "awake": lambda w, e: w.awake(e),
    "rows": lambda w, e: w.rows([1, e]),
    "state_hash": lambda w, e: w.state_hash([e]),
    "place": lambda w, e: w.place(e, (0, 8, 0)),
    "set_velocity": lambda w, e: w.set_velocity(e, (0, 0, 1)),
    "set_template": lambda w, e: w.set_template(e, "cube"),
    "remove": lambda w, e: w.remove(e),
    "step": lambda w, e: w.step({e: Input()}),
}


@pytest.mark.parametrize("name", BY_ENTITY)
def test_an_entity_that_is_not_there_is_named(name: str) -> None:
    world, act = world_with_two(compiled=False), BY_ENTITY[name]
    none, removed = "there is no such entity", "has been removed"
    for gone, why in ((2, removed), (np.int64(2), removed), (8, none), (0, none), (-1, none), (1 << 31, none)):
        refused(world, lambda w, gone=gone: act(w, gone), MissingError, rf"^entity = {gone}: {why}$")  # type: ignore[misc]
    with pytest.raises(KeyError):
        act(world, 8)


@pytest.mark.parametrize("name", sorted(set(BY_ENTITY) - {"rows", "state_hash", "step"}))
def test_a_value_that_is_no_entity_number_is_named(name: str) -> None:
    world = world_with_two(compiled=False)
    for bad in ENTITY:
        refused(world, lambda w, bad=bad: BY_ENTITY[name](w, bad), SceneError, "^entity = ")  # type: ignore[misc]
        assert bad not in world


@pytest.mark.parametrize("other", [lambda: build([floor(1)]), lambda: build([floor(0)], gravity=9.0), lambda: None])
def test_a_world_of_another_scene_is_not_restored(other: Callable[[], Any]) -> None:
    world = build([floor(0)])
    before = world.state_hash()
    with pytest.raises(SceneError, match=r"^other = (None|a world of 'test': its scene differs in (terrain|gravity))"):
        world.restore(other())
    assert world.state_hash() == before
    world.restore(build([floor(0)]))


@pytest.mark.parametrize("name", ["in_segment", "unload_segment", "write_blocks"])
def test_a_segment_that_is_not_there_is_named(name: str) -> None:
    given = [(9, 9, 9), [0], [1]] if name == "write_blocks" else [(9, 9, 9)]
    refused(
        world_with_two(compiled=False),
        lambda w: getattr(w, name)(*given),
        MissingError,
        r"^segment = \(9, 9, 9\): is not loaded$",
    )


def test_numbers_of_numpy_do_what_pythons_do(compiled: bool) -> None:
    made = []
    kinds: list[tuple[Any, Any]] = [(int, float), (np.int32, np.float32), (np.uint8, np.float64), (np.int64, np.int16)]
    for whole, real in kinds:
        world: Any = world_with_two(compiled=compiled)
        pen = Calls()
        world.attach(pen)
        assert world.set_block(whole(5), whole(5), whole(3), whole(7), push=np.False_)
        assert world.fill(tuple(map(whole, (6, 6, 3))), np.array((8, 8, 4), np.int64), whole(2)) == 4
        assert world.block(whole(7), whole(7), whole(3)) == 2
        entity = world.spawn("box", np.array((10, 10, 3), real), tuple(map(real, (1, 2, 3))))
        assert type(entity) is int
        world.place(whole(entity), [real(12), 12, 3])
        world.set_velocity(whole(entity), (real(1), 0, 0))
        world.step({whole(entity): Input(whole(100), 0, whole(1))})
        world.remove(whole(1))
        world.step()
        made.append((world.state_hash(), repr(pen.calls)))
    assert len(set(made)) == 1


def test_a_box_of_many_segments_is_filled_whole(compiled: bool) -> None:
    world = build([floor(0)], compiled=compiled)
    low, high = (-9, -5, -3), (11, 40 - 8, 4)
    cells = set(itertools.product(*(range(a, b) for a, b in zip(low, high, strict=True))))
    ground = sum(1 for x, y, z in cells if z == -1 and abs(x) <= 30 and -30 <= y < 30)
    assert world.fill(low, high, 9) == len(cells)
    assert world.fill(low, high, 9) == 0
    assert all(world.blocks.get(*cell) == 9 for cell in cells)
    assert world.blocks.get(-10, 0, 0) == world.blocks.get(11, 0, 0) == 0
    assert sum(was == 1 for was in world.editing.values()) == ground
    assert world.fill(low, (low[0], 5, 5), 1) == 0
    assert World(world.scene, compiled=compiled).fill((0, 0, 0), (0, 5, 5), 1) == 0


FLAT = load_scene("flat")
SCENES: list[tuple[str, Callable[[Any], Any], list[Any]]] = [
    ("name", lambda bad: replace(FLAT, name=bad), [None, 5, "", "n" * 65, b"flat"]),
    ("tick_rate", lambda bad: replace(FLAT, tick_rate=bad), [*WHOLE, 0, 241]),
    ("gravity", lambda bad: replace(FLAT, gravity=bad), [*NUMBER, -1]),
    ("terminal_speed", lambda bad: replace(FLAT, terminal_speed=bad), [*NUMBER, -1, 0, 1025]),
    ("integrator", lambda bad: replace(FLAT, integrator=bad), [None, 5, "rk4", ["mean"], np.array(["mean", "semi"])]),
    ("entity_collision", lambda bad: replace(FLAT, entity_collision=bad), [None, 1, "yes"]),
    ("size", lambda bad: replace(FLAT, size=bad), [*THREE, (0, 1, 1), (1, 1.5, 1), (1 << 17, 1, 1)]),
    ("origin", lambda bad: replace(FLAT, origin=bad), [*THREE, (0, 0, NAN), (1 << 24, 0, 0)]),
    ("terrain", lambda bad: replace(FLAT, terrain=bad), [None, 5, "flat", {}, {"generator": 5}]),
    ("terrain.x", lambda bad: replace(FLAT, terrain={"generator": "flat", "x": bad}), [object(), {1j}, 1 << 70]),
    ("spawns", lambda bad: replace(FLAT, spawns=bad), [None, 5, (), "abc", np.zeros((0, 3))]),
    ("spawns[0]", lambda bad: replace(FLAT, spawns=(bad,)), [*THREE, (0, 0, NAN), (0, 0, 1 << 29)]),
    ("templates", lambda bad: replace(FLAT, templates=bad), [None, 5, (), "abc"]),
    ("templates[0]", lambda bad: replace(FLAT, templates=(bad,)), [None, "player", {"name": "player"}]),
    ("player", lambda bad: replace(FLAT, player=bad), TEMPLATE),
    ("reach", lambda bad: replace(FLAT, reach=bad), [*NUMBER, -1, 1025]),
    ("templates.name", lambda bad: Template(bad), [None, 5, "", "n" * 65]),
    ("templates.a.box_size", lambda bad: Template("a", box_size=bad), [*THREE, (0, 1, 1), (1, 1, NAN), (1, 1, True)]),
    ("templates.a.walk_speed", lambda bad: Template("a", walk_speed=bad), [*NUMBER, -1, 1025]),
    ("templates.a.solid", lambda bad: Template("a", solid=bad), [None, 1, "yes"]),
    ("templates.a.shown", lambda bad: Template("a", shown=bad), [None, 1, "seen", ["predicted"]]),
    ("like", lambda bad: FLAT.with_template("b", like=bad), [0, "", "no such", ["player"], True]),
    ("templates.speed", lambda bad: FLAT.with_template("b", speed=bad), [1]),
    ("scene", World, [None, 5, "flat", FLAT.to_table()]),
    ("scene", lambda bad: Scene.from_table(bad), [None, 5, "flat", [1]]),
    ("scene", load_scene, [None, 5, b"flat", ["flat"], "no such", "a\0b", ""]),
    ("x", lambda bad: make_input(bad, 0), ["1", None, [1], 1j, NAN, INF, 1e300, np.array([1, 2])]),
    ("y", lambda bad: make_input(0, bad), ["1", None, NAN]),
    ("jump", lambda bad: make_input(0, 0, jump=bad), ["no", None, 0.5, []]),
    ("buttons", lambda bad: make_input(0, 0, buttons=bad), [*WHOLE[:3], -1, 256]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "make", "wrong"), SCENES, ids=[name for name, *_ in SCENES])
def test_a_wrong_value_of_a_scene_is_named(name: str, make: Callable[[Any], Any], wrong: list[Any]) -> None:
    for bad in wrong:
        with pytest.raises(SceneError) as error:
            make(bad)
        assert str(error.value).startswith(name), f"{bad!r}: {error.value}"
        assert "\n" not in str(error.value)


def test_a_scene_of_numpys_numbers_is_the_same_one() -> None:
    changes: dict[str, Any] = {
        "tick_rate": np.int64(FLAT.tick_rate), "gravity": np.float64(FLAT.gravity), "size": np.array(FLAT.size),
        "entity_collision": np.bool_(FLAT.entity_collision), "reach": np.float64(FLAT.reach),
    }  # fmt: skip
    same = replace(FLAT, **changes)
    assert same.fingerprint == FLAT.fingerprint
    assert Scene.from_table(same.to_table()) == same
    runs: dict[str, Any] = {"walk_speed": np.float32(3), "solid": np.True_}
    assert Template("a", **runs).row() == Template("a", walk_speed=3.0).row()


def test_a_key_that_is_held_counts_as_one() -> None:
    yes: list[Any] = [True, 1, np.True_, 1.0]
    no: list[Any] = [False, 0, np.False_, 0.0]
    for one, none, jump in zip(yes, no, (True, 1, np.True_, True), strict=True):
        assert make_input(one, none, jump=jump) == Input(127, 0, 1)
