"""Hard cases of the ground: rest, walls, corners, corridors, holes, edges (H1 to H7, H9, H16 to H19, H30).

Where the contract leaves a choice, it is this: a diagonal hit on a corner stops y, because x moves first (H5). A box as
wide as a hole falls in only if it is aligned with it on a tick (H7). Past a corner the way is an L (H16).
"""

import pytest

from shared.checks import SceneError
from shared.inputs import Input
from shared.scene import Template
from shared.units import BLOCK
from shared.world import World
from tests.lengths import contained, long
from tests.worlds import EAST, STEP, TEMPLATES, WEST, around, build, floor, high, low, settle, steps

FACES = (2, 32, 512, 8192, 131072, 0, -3)


@pytest.mark.slow
def test_h1_rest_for_a_million_ticks(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (-0.3, 0.7, 0))
    assert settle(world) == 1
    state = world.state(entity)
    for _ in range(10**6):
        world.step()
    assert world.awake_count == 0
    assert world.tick == 10**6 + 1
    assert world.state(entity) == state


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize("template", ["box", "person"])
def test_h2_pressed_against_a_face(compiled: bool, template: str, face: int) -> None:
    for sign in (-1, 1):
        at = sign * face
        wall = [at - 1, -9, 0, at, 9, 9, 1] if sign > 0 else [at, -9, 0, at + 1, 9, 9, 1]
        world = build([floor(x=at), wall], compiled=compiled, **around(at, 0, 0))
        entity = world.spawn(template, (at + sign * 1.3, 0.1, 0))
        steps(world, 64, {entity: WEST if sign > 0 else EAST})
        for _ in range(100):
            assert (low if sign > 0 else high)(world, entity)[0] == at
            assert world.velocity(entity) == (0, 0, 0)
            world.step()


def test_h3_a_floor_of_single_blocks_has_no_seams(compiled: bool) -> None:
    tiles = [[x, y, -1, x + 1, y + 1, 0, 1 + (x + y) % 2] for x in range(-20, 25) for y in range(-2, 3)]
    world = build(tiles, compiled=compiled)
    entity = world.spawn("box", (-19.9, 0.1, 0))
    x, y, z = world.position(entity)
    world.step({entity: EAST})
    for tick in range(1, 801):
        assert world.velocity(entity) == (3, 0, 0)
        assert world.position(entity) == (x + tick * 3 / 64, y, z)
        world.step()
    assert 800 * 3 / 64 == 37.5


def test_h4_sliding_along_a_wall_keeps_the_other_axis(compiled: bool) -> None:
    world = build([floor(), [8, -30, 0, 9, 30, 4, 1]], compiled=compiled)
    entity = world.spawn("runner", (7, -10, 0))
    steps(world, 640, {entity: Input(96, 64)})
    assert high(world, entity)[0] == 8
    assert world.position(entity)[1:] == (10, 0)
    assert world.velocity(entity) == (0, 2, 0)


@pytest.mark.parametrize("east", [1, -1])
@pytest.mark.parametrize("north", [1, -1])
def test_h5_diagonal_hit_on_a_corner(compiled: bool, east: int, north: int) -> None:
    """The corner of the box meets the corner of the block exactly on a tick. x moves first and is free; then y is
    stopped. This holds in all quadrants."""
    block = [0 if east > 0 else -1, 0 if north > 0 else -1, -2, 1 if east > 0 else 0, 1 if north > 0 else 0, 3, 1]
    world = build([block], compiled=compiled, gravity=0)
    side = 5 / 8
    start = [-2 - side if way > 0 else 2 for way in (east, north)]
    entity = world.spawn("stone", (start[0], start[1], 0), (8 * east, 8 * north, 0))
    steps(world, 16)
    corner = [(high if way > 0 else low)(world, entity)[k] for k, way in enumerate((east, north))]
    assert corner == [0, 0]
    steps(world, 2)
    assert world.velocity(entity) == (8 * east, 0, 0)
    corner = [(high if way > 0 else low)(world, entity)[k] for k, way in enumerate((east, north))]
    assert corner == [2 / 8 * east, 0]


@pytest.mark.parametrize(("offset", "passes"), [(0, True), (STEP, False), (-STEP, False)])
def test_h6_a_corridor_as_wide_as_the_box(compiled: bool, offset: float, passes: bool) -> None:
    walls = [[0, -9, 0, 9, 0, 3, 1], [0, 1, 0, 9, 9, 3, 1]]
    world = build([floor(), *walls], compiled=compiled)
    entity = world.spawn("cube", (-2, offset, 0))
    steps(world, 200, {entity: EAST})
    assert world.position(entity) == ((-2 + 200 * 3 / 64 if passes else -1), offset, 0)


@pytest.mark.parametrize(("ticks", "falls"), [(32, True), (32.5, False)])
def test_h7_a_hole_as_wide_as_the_box(compiled: bool, ticks: float, falls: bool) -> None:
    """The box falls if it is aligned with the hole on some tick, and crosses it otherwise. Nothing happens between
    ticks."""
    world = build([[-9, -9, -3, 9, 9, 0, 1], [0, 0, -2, 1, 1, 0, 0]], compiled=compiled)
    entity = world.spawn("cube", (-ticks * 3 / 64, 0, 0))
    steps(world, 128, {entity: EAST})
    if falls:
        assert world.position(entity) == (0, 0, -2)
    else:
        assert world.position(entity) == ((128 - ticks) * 3 / 64, 0, 0)


def test_h9_the_edge_of_a_floor(compiled: bool) -> None:
    world = build([floor(half=8)], compiled=compiled)
    off, on = world.spawn("box", (8, 0, 0)), world.spawn("box", (8 - STEP, 2, 0))
    corner = world.spawn("box", (8, 8, 0))
    world.step()
    assert world.falling(off)
    assert world.falling(corner)
    assert not world.falling(on)
    settled = world.state(on)
    steps(world, 20)
    assert world.state(on) == settled
    assert world.position(off)[2] < 0


def test_h9_walking_off_the_edge(compiled: bool) -> None:
    """The tick that clears the edge still ends at the height of the floor. The flag is up one tick later."""
    world = build([floor(half=8)], compiled=compiled)
    entity = world.spawn("box", (8 - 6 / 64, 0, 0))
    steps(world, 2, {entity: EAST})
    assert world.position(entity) == (8, 0, 0)
    assert not world.falling(entity)
    world.step()
    assert world.falling(entity)
    assert world.position(entity)[2] < 0


def test_h9_stopping_on_the_tick_that_clears_the_edge(compiled: bool) -> None:
    world = build([floor(half=8)], compiled=compiled)
    entity = world.spawn("box", (8 - 6 / 64, 0, 0))
    steps(world, 2, {entity: EAST})
    world.step({entity: Input()})
    assert world.position(entity)[0] == 8
    assert world.velocity(entity)[:2] == (0, 0)
    assert world.falling(entity)
    assert world.position(entity)[2] < 0


def test_h9_stopped_by_a_wall_on_the_tick_that_clears_the_edge(compiled: bool) -> None:
    world = build([floor(half=8), [9, -9, -9, 10, 9, 9, 1]], compiled=compiled)
    entity = world.spawn("stone", (8 - 3 / 64, 0, 0), (64, 0, 0))
    world.step()
    assert high(world, entity)[0] == 9
    assert world.velocity(entity) == (0, 0, 0)
    world.step()
    assert world.falling(entity)


def test_h16_past_a_corner_at_a_block_a_tick(compiled: bool) -> None:
    """The straight way misses the block and ends at (1, 7/4). The L-shaped way loses 5/8 of x, less than the step of
    one tick."""
    world = build([[1, 0, -2, 2, 1, 3, 1]], compiled=compiled, gravity=0)
    entity = world.spawn("stone", (0, 3 / 4, 0), (64, 64, 0))
    world.step()
    assert world.position(entity) == (3 / 8, 7 / 4, 0)
    assert world.velocity(entity) == (0, 64, 0)
    assert 1 - world.position(entity)[0] == 5 / 8


@pytest.mark.parametrize("far", [10**6, 10**7, -(10**7)])
def test_h17_the_same_run_far_away(compiled: bool, integrator: str, far: int) -> None:
    def run(x: int, y: int) -> list[tuple[int, ...]]:
        fill = [[x - 8, y - 8, -1, x + 8, y + 8, 0, 1], [x + 3, y - 8, 0, x + 4, y + 8, 2, 1]]
        world = build(fill, compiled=compiled, integrator=integrator, **around(x, y, 0))
        walker, person = world.spawn("box", (x + 0.3, y, 0)), world.spawn("person", (x - 0.7, y - 3, 4))
        stone = world.spawn("stone", (x, y + 3, 2), (5.1, -3.3, 7.7))
        track = []
        for tick in range(120):
            world.step({walker: Input(90, 30, tick & 1), person: EAST} if tick % 30 == 0 else None)
            for entity in (walker, person, stone):
                _, _, flags, px, py, pz, *rest = world.state(entity)
                track.append((flags, px - x * BLOCK, py - y * BLOCK, pz, *rest))
        return track

    assert run(far, -far) == run(0, 0)


@pytest.mark.parametrize("border", [0, 32, -32])
def test_h18_an_obstacle_protruding_from_the_next_segment(compiled: bool, border: int) -> None:
    templates = (*TEMPLATES, Template("sign", (-3, 0, 0), (2, 2, 2)))
    world = build([floor(x=border)], compiled=compiled, templates=templates, **around(border, 0, 0))
    sign = world.spawn("sign", (border + 1, 0, 0))
    assert high(world, sign)[0] == border
    walker = world.spawn("box", (border - 4, 0.5, 0))
    rider = world.spawn("box", (border - 1, 0.5, 2))
    steps(world, 64, {walker: EAST})
    assert high(world, walker)[0] == border - 2
    assert world.position(rider)[2] == 2
    assert not world.awake(rider)


@pytest.mark.parametrize("top", [0, 32, -32, 64])
def test_h18_a_floor_that_ends_on_a_segment_border(compiled: bool, top: int) -> None:
    world = build([floor(top)], compiled=compiled, **around(0, 0, top))
    entity = world.spawn("box", (1 / 8, 1 / 8, top))
    steps(world, 64, {entity: EAST})
    assert world.position(entity) == (25 / 8, 1 / 8, top)
    assert not world.falling(entity)
    for _ in range(3):
        world.step({entity: Input(0, 0, 1)})
        assert world.velocity(entity)[2] > 0
        world.step({entity: Input()})
        settle(world)
        assert world.position(entity)[2] == top


def test_h19_negative_coordinates_are_the_mirror(compiled: bool) -> None:
    """Two worlds are mirror images of each other in x and y, block by block and tick by tick."""
    templates = (Template("mirror", (-5 / 16, -5 / 16, 0), (5 / 8, 5 / 8, 7 / 4), walk_speed=3, jump_speed=8),)
    fill = [[-9, -9, -1, 9, 9, 0, 1], [3, -9, 0, 4, 5, 2, 1], [-2, 6, 0, 1, 7, 1, 1]]
    mirrored = [[-x1, -y1, z0, -x0, -y0, z1, kind] for x0, y0, z0, x1, y1, z1, kind in fill]
    worlds = [build(f, compiled=compiled, templates=templates, player="mirror", tick_rate=60) for f in (fill, mirrored)]
    plus, minus = worlds[0].spawn("mirror", (0.3, 0.7, 0)), worlds[1].spawn("mirror", (-0.3, -0.7, 0))
    for tick in range(300):
        move = (127, 0), (50, 90), (-30, 101), (0, -127)
        x, y = move[tick // 40 % 4]
        jump = int(tick % 50 == 0)
        worlds[0].step({plus: Input(x, y, jump)})
        worlds[1].step({minus: Input(-x, -y, jump)})
        a, b = worlds[0].position(plus), worlds[1].position(minus)
        assert a == (-b[0], -b[1], b[2])


def test_h19_a_negative_range_extends_the_other_way(compiled: bool) -> None:
    """The reference engine's y: displacement 0.5 and range -1 are the box from -0.5 to 0.5."""
    one = Template("one", (-0.5, -0.5, 0), (1, 1, 1), walk_speed=3)
    other = Template("one", (-0.5, 0.5, 0), (1, -1, 1), walk_speed=3)
    hashes = []
    for template in (one, other):
        wall = [-9, -4, 0, 9, -3, 2, 1]
        world = build([floor(), wall], compiled=compiled, templates=(template,), player="one")
        entity = world.spawn("one", (0, 0, 2))
        steps(world, 90, {entity: Input(20, -127)})
        assert low(world, entity)[1] == -3
        hashes.append(world.state_hash())
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("axis", range(3))
def test_h19_a_range_of_zero_is_refused(axis: int) -> None:
    for size in (0, 0.0, -0.0, 5e-324):
        sides = [1.0, 1.0, 1.0]
        sides[axis] = size
        with pytest.raises(SceneError, match=rf"templates\.thin\.box_size\.{'xyz'[axis]}"):
            Template("thin", (0, 0, 0), (sides[0], sides[1], sides[2]))


def pressed(compiled: bool) -> tuple[World, int]:
    world = build([floor(), [3, -9, 0, 4, 9, 3, 1], [-9, 3, 0, 9, 4, 3, 1]], compiled=compiled)
    entity = world.spawn("box", (1.3, 1.7, 0))
    steps(world, 64, {entity: Input(90, 89)})
    assert high(world, entity)[:2] == (3, 3)
    return world, entity


@pytest.mark.parametrize("ticks", [*contained(1000), *long(100_000)])
def test_h30_pressed_into_a_floor_and_two_walls(compiled: bool, ticks: int) -> None:
    """The hash over the entity is constant. The hash over the world also contains the tick."""
    world, entity = pressed(compiled)
    state = world.state(entity)
    for _ in range(ticks):
        world.step()
        assert not len(world.changed)
    assert world.state(entity) == state
    assert world.awake(entity)
