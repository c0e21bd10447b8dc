"""Faults of the reference engine's physics, open (1 to 13) and fixed. The product has none of them."""

import random

import numpy as np
import pytest

from shared.inputs import NEUTRAL, Input, clamp, make_input
from shared.terrain import generate
from shared.units import BLOCK
from shared.world import World
from tests.worlds import EAST, JUMP, NORTH, STEP, TEMPLATES, WEST, around, build, floor, high, low, scene, settle, steps

RUN_AND_JUMP = Input(127, 0, 1)


@pytest.mark.parametrize("top", [0, 32, 64, -32])
def test_1_walking_on_a_floor_whose_top_is_a_multiple_of_32(compiled: bool, top: int) -> None:
    world = build([floor(top)], compiled=compiled, tick_rate=32, **around(0, 0, top))
    entity = world.spawn("box", (0, 0, top))
    steps(world, 32, {entity: EAST})
    assert world.position(entity) == (3, 0, top)
    for _ in range(5):
        world.step({entity: RUN_AND_JUMP})
        assert world.velocity(entity)[2] > 0
        world.step({entity: NEUTRAL})
        settle(world)


def test_2_no_ghost_walls_at_seams(compiled: bool) -> None:
    """2000 landings on single blocks at every fraction of a block: each keeps its velocity along the floor."""
    tiles = [[x, y, -1, x + 1, y + 1, 0, 1 + (x + y) % 2] for x in range(-12, 12) for y in range(-12, 12)]
    world = build(tiles, compiled=compiled, entity_collision=False, tick_rate=32, gravity=18)
    r = random.Random(2)
    speeds = {}
    for _ in range(2000):
        start = r.uniform(-6, 6), r.uniform(-6, 6), r.uniform(0, 2)
        entity = world.spawn("stone", start, (r.uniform(-4, 4), r.uniform(-4, 4), 0))
        speeds[entity] = world.velocity(entity)
    steps(world, 20)
    for entity, (x, y, _) in speeds.items():
        assert world.velocity(entity) == (x, y, 0)
        assert world.position(entity)[2] == 0


@pytest.mark.parametrize("spot", [(1, 0, 0), (-5 / 8, 0, 0), (0, 1, 0), (0, -5 / 8, 0), (1, 1, 0), (-5 / 8, -5 / 8, 0)])
def test_3_edges_and_corners_do_not_support(compiled: bool, spot: tuple[float, float, float]) -> None:
    """The edges of a block (0 to 1) do not support, nor those of an equally wide entity; one grid step further in, both
    do."""
    x, y, z = spot
    inward = [(STEP if part < 0 else -STEP) if part else 0 for part in (x, y)]
    world = build([[0, 0, -1, 1, 1, 0, 1], [5, 5, -1, 6, 6, 0, 1]], compiled=compiled)
    cube = world.spawn("cube", (5, 5, 0))
    beside = [world.spawn("box", at) for at in ((x, y, z), (5 + x, 5 + y, 1))]
    for at, entity in zip(((0, 0, 0), (5, 5, 1)), beside, strict=True):
        other = world.copy()
        other.place(entity, (at[0] + x + inward[0], at[1] + y + inward[1], at[2]))
        other.step()
        assert not other.falling(entity)
    world.step()
    assert all(world.falling(entity) for entity in beside)
    assert not world.falling(cube)


def test_4_an_embedded_entity_is_not_thrown(compiled: bool) -> None:
    """The entity may leave at its own speed. The block that it was in does not stop it; the next one does."""
    world = build([[-8, -8, -8, 8, 8, 8, 1]], compiled=compiled)
    entity = world.spawn("box", (12, 0, 0))
    state = list(world.state(entity))
    state[3:6] = [int(-0.3 * BLOCK), BLOCK // 4, int(0.2 * BLOCK)]
    world.put([tuple(state)])
    before = world.position(entity)
    for tick in range(200):
        world.step({entity: (EAST, WEST, NORTH, JUMP)[tick // 10 % 4]})
        after = world.position(entity)
        assert abs(after[0] - before[0]) <= 3 / 64
        assert abs(after[1] - before[1]) <= 3 / 64
        assert abs(after[2] - before[2]) <= 16 / 64
        before = after


@pytest.mark.parametrize("face", [-32, -64, -128])
def test_5_fractional_boxes_slide_on_walls_at_segment_borders(compiled: bool, face: int) -> None:
    world = build([floor(x=face), [face - 1, -30, 0, face, 30, 3, 1]], compiled=compiled, **around(face, 0, 0))
    entity = world.spawn("person", (face + 1, 0, 0))
    steps(world, 64, {entity: Input(-90, 0)})
    x, y, z = world.position(entity)
    assert low(world, entity)[0] == face
    for tick in range(1, 65):
        world.step({entity: Input(-90, 64)})
        vx, vy, _ = world.velocity(entity)
        assert vx == 0
        assert world.position(entity) == (x, y + tick * vy / 64, z)


def test_6_a_long_tick_does_not_tunnel(compiled: bool) -> None:
    """A tick of 0.2 s at the terminal speed is 3.2 blocks. Ticks cannot get longer, because the step reads no clock."""
    world = build([floor()], compiled=compiled, tick_rate=5, gravity=18)
    entity = world.spawn("box", (0, 0, 20))
    settle(world)
    assert world.position(entity) == (0, 0, 0)


def test_7_jump_and_move_in_one_tick(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    world.step({entity: RUN_AND_JUMP})
    assert world.velocity(entity) == (3, 0, 8 - 16 / 64)
    assert world.position(entity)[0] == 3 / 64
    assert world.position(entity)[2] > 0


@pytest.mark.parametrize("border", [0, 32, -32])
def test_8_a_block_removed_under_a_sleeper_of_the_next_segment(compiled: bool, border: int) -> None:
    """The position lies in one segment. The block that holds the box, and is removed, lies in the other."""
    world = build([[border - 1, 0, -1, border, 1, 0, 1]], compiled=compiled, **around(border, 0, 0))
    entity = world.spawn("person", (border + 0.1, 0.5, 0))
    settle(world)
    assert world.position(entity)[2] == 0
    world.set_block(border - 1, 0, -1, 0)
    world.step()
    assert world.falling(entity)


def test_9_a_supporter_that_walks_away(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    below, rider = world.spawn("slab", (0, 0, 0)), world.spawn("box", (0, 0, 1))
    settle(world)
    world.set_velocity(below, (8, 0, 0))
    for tick in range(1, 5):
        world.step()
        assert low(world, below)[0] == tick / 8
        assert world.position(rider) == (0, 0, 1)
    world.step()
    assert low(world, below)[0] == 5 / 8 == high(world, rider)[0]
    assert world.falling(rider)
    steps(world, 64)
    assert world.position(rider) == (0, 0, 0)


def test_10_holding_a_key_against_a_step_and_jumping_onto_it(compiled: bool) -> None:
    world = build([floor(), [2, -9, 0, 9, 9, 1, 1]], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    steps(world, 64, {entity: EAST})
    assert high(world, entity)[0] == 2
    steps(world, 64, {entity: RUN_AND_JUMP})
    world.step({entity: EAST})
    steps(world, 63)
    assert world.position(entity)[2] == 1
    assert world.position(entity)[0] > 3


def test_11_what_is_not_loaded_is_solid(compiled: bool) -> None:
    ground = scene([floor(half=40)])
    world = World(ground, compiled=compiled)
    world.load_terrain([(0, 0, 0), (0, 0, -1)])
    walker, jumper = world.spawn("box", (30, 8, 0)), world.spawn("box", (8, 8, 30))
    steps(world, 200, {walker: EAST})
    assert high(world, walker) == (32, 8 + 5 / 8, 7 / 4)
    assert world.position(jumper) == (8, 8, 0)
    for index in ((1, 0, -1), (1, 0, 0)):
        world.load_segment(index, generate(ground.terrain, index))
    steps(world, 64)
    assert world.position(walker) == (32 - 5 / 8 + 3, 8, 0)


def test_12_a_row_used_again_has_no_past(compiled: bool) -> None:
    """An entity in the row of one that was jumping behaves exactly like the first entity of a new world."""
    world = build([floor()], compiled=compiled)
    first = world.spawn("box", (0, 0, 0))
    steps(world, 10, {first: RUN_AND_JUMP})
    world.remove(first)
    world.step()
    second = world.spawn("box", (0, 0, 0))
    assert second != first
    assert world.state(second)[1:] == (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    settle(world)
    assert world.position(second) == (0, 0, 0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_13_a_move_that_is_no_number(bad: float) -> None:
    for x, y in ((bad, 0.0), (0.0, bad)):
        with pytest.raises(ValueError, match="must be finite"):
            make_input(x, y)


# -- faults that are fixed -------------------------------------------------------------------------------------------


def test_the_terminal_velocity_points_down(compiled: bool) -> None:
    world = build(compiled=compiled, size=(2, 2, 4))
    entity = world.spawn("box", (0, 0, 90))
    steps(world, 300)
    assert world.velocity(entity) == (0, 0, -16)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_stopped_on_the_side_it_came_from(compiled: bool, axis: int, sign: int) -> None:
    world = build([[-1, -1, -1, 1, 1, 1, 1]], compiled=compiled, gravity=0)
    start, speed = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    start[axis], speed[axis] = -sign * 6.0, sign * 20.0
    entity = world.spawn("stone", (start[0], start[1], start[2]), (speed[0], speed[1], speed[2]))
    steps(world, 64)
    assert (high if sign > 0 else low)(world, entity)[axis] == -sign


@pytest.mark.parametrize("axis", range(3))
def test_a_collision_stops_one_component(compiled: bool, axis: int) -> None:
    lows, highs = [-20, -20, -20], [20, 20, 20]
    lows[axis], highs[axis] = 2, 3
    world = build([[*lows, *highs, 1]], compiled=compiled, gravity=0)
    entity = world.spawn("stone", (0, 0, 0), (4, 4, 4))
    steps(world, 64)
    expected = [4, 4, 4]
    expected[axis] = 0
    assert world.velocity(entity) == tuple(expected)


def test_a_new_entity_in_the_air_falls_at_once(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 5))
    told = build([floor()], compiled=compiled)
    told.put([world.state(entity)])
    for each in (world, told):
        each.step()
        assert each.falling(entity)
        assert each.position(entity)[2] < 5


def test_blocks_removed_and_placed_in_every_segment_are_seen(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    for x in (-20, 20):
        for y in (-20, 20):
            entity = world.spawn("box", (x, y, 0))
            world.fill((x, y, -1), (x + 1, y + 1, 0), 0)
            steps(world, 2)
            assert world.falling(entity)
            world.set_block(x, y, -3, 1)
            settle(world)
            assert world.position(entity)[2] == -2


def test_an_entity_does_not_collide_with_itself(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    world.place(entity, (0.25, 0, 0.25))
    steps(world, 64, {entity: EAST})
    assert world.velocity(entity) == (3, 0, 0)
    world.set_template(entity, "cube")
    assert world.position(entity)[2] == 0


@pytest.mark.parametrize("how", ["removed", "made a ghost", "teleported"])
def test_a_box_that_is_gone_is_no_obstacle(compiled: bool, how: str) -> None:
    world = build([floor()], compiled=compiled)
    entity, obstacle = world.spawn("box", (0, 0, 0)), world.spawn("box", (2, 0, 0))
    steps(world, 64, {entity: EAST})
    assert high(world, entity)[0] == 2
    if how == "removed":
        world.remove(obstacle)
    elif how == "made a ghost":
        world.set_template(obstacle, "ghost")
    else:
        world.place(obstacle, (2, 9, 0))
    steps(world, 64)
    assert world.velocity(entity) == (3, 0, 0)


def test_an_input_for_a_removed_entity_changes_nothing(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    gone, here = world.spawn("box", (0, 0, 0)), world.spawn("box", (5, 0, 0))
    world.remove(gone)
    before = world.state_hash()
    with pytest.raises(KeyError):
        world.step({here: EAST, gone: EAST})
    assert world.state_hash() == before


def test_no_intent_has_no_direction() -> None:
    assert make_input(0, 0) == make_input(-0.0, 0.0) == NEUTRAL == clamp(NEUTRAL)
    assert make_input(5e-324, 0) == NEUTRAL


def test_falling_out_of_the_world_is_an_event(compiled: bool) -> None:
    world = build(compiled=compiled, origin=(0, 0, 0), size=(1, 1, 1))
    entity, other = world.spawn("box", (8, 8, 1)), world.spawn("box", (20, 8, 25))
    while not world.fell:
        assert low(world, entity)[2] >= 0
        world.step()
    assert world.fell == [entity]
    assert low(world, entity)[2] < 0
    world.remove(entity)
    world.step()
    assert world.fell == []
    assert other in world


def test_a_tap_of_one_tick_is_one_tick_of_motion(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    for taps in range(1, 10):
        world.step({entity: EAST})
        world.step({entity: NEUTRAL})
        assert world.position(entity) == (taps * 3 / 64, 0, 0)


def test_the_index_of_segments_follows_an_entity(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (-1, 4, 0))
    assert world.in_segment((-1, 0, 0))[:, 0].tolist() == [entity]
    steps(world, 64, {entity: EAST})
    assert world.in_segment((0, 0, 0))[:, 0].tolist() == [entity]
    world.place(entity, (-9, -9, -9))
    assert world.in_segment((-1, -1, -1))[:, 0].tolist() == [entity]
    assert not np.concatenate([world.in_segment(index) for index in world.blocks if index != (-1, -1, -1)]).size


def test_every_template_has_a_box() -> None:
    assert all(min(template.row()[3:6]) > 0 for template in TEMPLATES)
