"""A sleeping entity costs nothing. Any event that takes its support away wakes it, and wakes no other entity."""

import random

import numpy as np
import pytest

from shared import layout
from shared.inputs import Input
from shared.scene import Template
from shared.world import World
from tests.worlds import EAST, STEP, TEMPLATES, around, build, floor, high, scene, settle, steps

SUPPORT = ("removed", "teleported", "shrunk", "made a ghost", "written elsewhere", "dropped", "walked away")


def take_away(world: World, below: int, how: str) -> None:
    """Ends the support that an entity gives to the entities on top of it."""
    if how == "removed":
        world.remove(below)
    elif how == "teleported":
        world.place(below, (8, 8, 0))
    elif how == "shrunk":
        world.set_template(below, "slab")
    elif how == "made a ghost":
        world.set_template(below, "ghost")
    elif how == "written elsewhere":
        state = list(world.state(below))
        state[4] += 4 << 24
        world.put([tuple(state)])
    elif how == "dropped":
        world.fill((-4, -4, -1), (4, 4, 0), 0)
    else:
        world.set_velocity(below, (64, 0, 0))


@pytest.mark.parametrize("how", SUPPORT)
@pytest.mark.parametrize("upside_down", [False, True], ids=["low id below", "high id below"])
def test_support_by_an_entity_ends(compiled: bool, how: str, upside_down: bool) -> None:
    world = build([floor()], compiled=compiled)
    spots = [("stone", (0, 0, 0)), ("box", (0.25, 0, 7 / 4))]
    if upside_down:
        spots.reverse()
    ids = {name: world.spawn(name, at) for name, at in spots}
    bystander = world.spawn("box", (5, 5, 0))
    settle(world)
    assert world.position(ids["box"])[2] == 7 / 4
    take_away(world, ids["stone"], how)
    assert not world.awake(bystander)
    steps(world, 2)
    assert world.falling(ids["box"])
    steps(world, 200)
    assert world.position(ids["box"])[2] < 7 / 4


@pytest.mark.parametrize("upside_down", [False, True], ids=["low id below", "high id below"])
def test_a_lift_that_goes_down_takes_its_rider_along(compiled: bool, upside_down: bool) -> None:
    """The rider is never inside the lift, and stands on it again at the bottom."""
    world = build([[-4, -4, -9, 4, 4, -8, 1], [-4, -4, -1, 4, 4, 0, 1]], compiled=compiled)
    names = ["box", "slab"] if upside_down else ["slab", "box"]
    ids = {name: world.spawn(name, (0, 0, 0 if name == "slab" else 1)) for name in names}
    settle(world)
    world.fill((-4, -4, -1), (4, 4, 0), 0)
    while world.awake_count:
        world.step()
        assert high(world, ids["slab"])[2] <= world.position(ids["box"])[2]
    assert world.position(ids["slab"])[2] == -8
    assert world.position(ids["box"])[2] == -7


@pytest.mark.parametrize("template", ["box", "ghost"])
def test_a_block_removed_wakes_only_the_entities_that_stand_on_it(compiled: bool, template: str) -> None:
    world = build([floor()], compiled=compiled)
    spots = {(x, y): world.spawn(template, (x + 0.5, y + 0.5, 0)) for x in range(-4, 4) for y in range(-4, 4)}
    settle(world)
    assert world.set_block(0, 0, -1, 0)
    overlapping = {(-1, -1), (-1, 0), (0, -1), (0, 0)}
    assert {spot for spot, entity in spots.items() if world.awake(entity)} == overlapping
    world.step()
    assert world.awake_count == 0
    world.fill((-1, -1, -1), (1, 1, 0), 0)
    world.step()
    assert [spot for spot, entity in spots.items() if world.falling(entity)] == [(-1, -1)]


def test_a_block_placed_or_replaced_wakes_no_entity(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    world.spawn("box", (0, 0, 0))
    settle(world)
    world.fill((-3, -3, -1), (3, 3, 0), 7)
    world.set_block(1, 0, 0, 1)
    world.set_block(5, 5, 0, 0)
    assert world.awake_count == 0


def test_a_segment_that_comes_wakes_what_hung_over_it(compiled: bool) -> None:
    """The position is in one segment. The blocks that hold the box are in another one, which is not loaded yet."""
    world = World(scene([floor(half=40)]), compiled=compiled)
    world.load_terrain([(0, 0, -1), (0, 0, 0), (-1, 0, 0)])
    beside = world.spawn("person", (0.2, 8, 0))
    world.fill((0, 0, -1), (2, 32, 0), 0)
    settle(world)
    assert world.position(beside)[2] == 0
    world.load_segment((-1, 0, -1), np.zeros(32**3, np.uint8))
    world.step()
    assert world.falling(beside)


def test_a_segment_replaced_wakes_what_stood_on_it(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    on, far = world.spawn("box", (8, 8, 0)), world.spawn("box", (-8, -8, 0))
    settle(world)
    world.load_segment((0, 0, -1), np.zeros(32**3, np.uint8))
    assert world.awake(on)
    assert not world.awake(far)
    world.step()
    assert world.falling(on)


def test_a_segment_unloaded_below_the_floor_wakes_what_stood_in_it(compiled: bool) -> None:
    """Below the scene's lowest z, a segment that is not loaded is void."""
    world = build(compiled=compiled, origin=(0, 0, 0), size=(1, 1, 1))
    world.load_segment((0, 0, -1), np.ones(32**3, np.uint8))
    entity = world.spawn("box", (8, 8, 0))
    settle(world)
    world.unload_segment((0, 0, -1))
    world.step()
    assert world.falling(entity)


@pytest.mark.parametrize("border", [0, 32, -32])
def test_support_across_a_segment_border(compiled: bool, border: int) -> None:
    """Rider and supporter have their positions in different segments, and in different cells."""
    templates = (*TEMPLATES, Template("sign", (-3, 0, 0), (2, 2, 2)))
    world = build([floor(x=border)], compiled=compiled, templates=templates, **around(border, 0, 0))
    sign, rider = world.spawn("sign", (border + 1, 0, 0)), world.spawn("box", (border - 2, 1, 2))
    settle(world)
    assert world.position(rider)[2] == 2
    world.remove(sign)
    world.step()
    assert world.falling(rider)


def test_a_mover_wakes_only_what_stands_on_it(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    mover = world.spawn("box", (0, 0, 0))
    beside = [world.spawn("box", (x, y, 0)) for x, y in ((0, 5 / 8), (0, -5 / 8), (-5 / 8, 0), (0, 2), (-2, 0))]
    settle(world)
    steps(world, 20, {mover: EAST})
    assert not any(world.awake(entity) for entity in beside)


def test_a_sleeper_has_no_turn_and_is_not_sent(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    settle(world)
    steps(world, 3)
    assert not len(world.changed)
    assert world.rows([entity])[0, layout.CHANGED] >> layout.EVENT_BITS == 1


def test_a_hundred_thousand_sleepers(compiled: bool) -> None:
    """No sleeper has a turn. Each is still an obstacle, and is woken alone when its block is removed."""
    world = World(scene(origin=(0, 0, 0), size=(10, 10, 1), templates=TEMPLATES), compiled=compiled)
    kinds = np.zeros((32, 32, 32), np.uint8)
    kinds[0] = 1
    for index in world.scene.segments():
        world.load_segment(index, kinds.reshape(-1))
    states = np.zeros((100_000, 12), np.int64)
    states[:, 0] = np.arange(1, 100_001)
    states[:, 1] = 2
    states[:, 3] = (np.arange(100_000) % 316) << 24
    states[:, 4] = (np.arange(100_000) // 316) << 24
    states[:, 5] = 1 << 24
    if not compiled:
        states = states[::97].copy()
    world.put(states)
    world.step()
    assert world.awake_count == 0
    before = world.rows(states[:, 0].tolist())
    steps(world, 100)
    assert (world.rows(states[:, 0].tolist()) == before).all()
    assert world.awake_count == 0
    victim = int(random.Random(1).choice(states[:, 0].tolist()))
    x, y, _ = world.position(victim)
    world.set_block(int(x), int(y), 0, 0)
    assert world.awake_count == 1
    world.step()
    assert world.falling(victim)
    assert world.changed[:, 0].tolist() == [victim]


def test_no_gravity_nothing_to_keep_awake(compiled: bool) -> None:
    """Without gravity a throw raises no flag, so the entity sleeps after it has hit an obstacle."""
    world = build([[-9, -9, 4, 9, 9, 5, 1]], compiled=compiled, gravity=0)
    entity = world.spawn("stone", (0, 0, 0), (0, 0, 9))
    world.set_velocity(entity, (0, 0, 8))
    settle(world, 64)
    assert high(world, entity)[2] == 4
    assert not world.falling(entity)
    world.set_block(0, 0, 4, 0)
    world.place(entity, (0, 0, 4 - 7 / 4 - STEP))
    settle(world, 2)
    assert world.position(entity)[2] == 4 - 7 / 4 - STEP


@pytest.mark.parametrize("spot", [(1 - STEP, 0), (STEP - 5 / 8, 0), (0, 1 - STEP), (0, STEP - 5 / 8)])
@pytest.mark.parametrize("how", ["block", "removed", "walked away"])
def test_held_by_a_single_grid_step(compiled: bool, spot: tuple[float, float], how: str) -> None:
    world = build([floor(-1), [0, 0, -1, 1, 1, 0, 1]], compiled=compiled)
    below = world.spawn("stone" if how == "block" else "cube", (0, 9, -1) if how == "block" else (0, 0, 0))
    rider = world.spawn("box", (*spot, 0 if how == "block" else 1))
    settle(world)
    assert world.position(rider)[2] == (0 if how == "block" else 1)
    if how == "block":
        world.set_block(0, 0, -1, 0)
    elif how == "removed":
        world.remove(below)
    x, y = ((part < 0) - (part > 0) for part in spot)
    world.step({below: Input(127 * x, 127 * y)} if how == "walked away" else None)
    assert world.falling(rider)
