"""Edits of the world and free places: an edit is refused as a whole, or pushes entities to the nearest free place."""

import pytest

from shared.checks import SceneError
from shared.units import RANGE_BLOCKS
from shared.world import OverlapError
from tests.worlds import STEP, build, floor, settle, steps


def test_a_fill_is_all_or_nothing(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (4.5, 0.5, 0))
    settle(world)
    before = world.state_hash()
    with pytest.raises(OverlapError, match=r"blocks \(0, 0, 0\) to \(5, 1, 2\): entity 1 is there"):
        world.fill((0, 0, 0), (5, 1, 2), 3)
    with pytest.raises(SceneError, match=r"block .*: its segment is not loaded"):
        world.fill((30, 0, 0), (33, 1, 1), 3)
    for kind in (-1, 256, 1.0, True, None):
        with pytest.raises(SceneError, match=r"^kind = "):
            world.set_block(0, 0, 0, kind)  # type: ignore[arg-type]
    assert world.state_hash() == before
    assert world.awake_count == 0
    assert world.fill((0, 0, 0), (4, 1, 2), 3) == 8
    assert world.fill((0, 0, 0), (4, 1, 2), 3) == 0
    assert world.fill((3, 0, 0), (6, 1, 2), 0) == 2
    assert world.fill((0, 0, 0), (0, 1, 2), 3) == 0
    assert world.position(entity) == (4.5, 0.5, 0)


def test_touching_is_not_overlapping(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    world.spawn("cube", (0, 0, 0))
    for x, y, z in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)):
        assert world.set_block(x, y, z, 1)
        assert world.blocks.get(x, y, z) == 1
    with pytest.raises(OverlapError):
        world.set_block(0, 0, 0, 1)


def test_a_non_solid_entity_is_in_nobodys_way(compiled: bool) -> None:
    """A block is placed into it all the same. The entity is inside then, and free to leave."""
    world = build([floor()], compiled=compiled)
    ghost = world.spawn("ghost", (0, 0, 0))
    world.set_block(0, 0, 0, 1)
    world.step()
    assert world.position(ghost) == (0, 0, 0)


@pytest.mark.parametrize(
    ("start", "moved"),
    [
        ((0.0, 0.0, -0.25), (0.0, 0.0, 0.0)),  # out of the floor
        ((0.0, 0.0, -0.75), (0.0, 0.0, 0.0)),
        ((3 - 0.5, 0.0, 0.0), (3 - 5 / 8, 0.0, 0.0)),  # west of a wall
        ((4 - 0.25, 0.0, 0.0), (4.0, 0.0, 0.0)),  # east of it
        ((0.0, 6 - 0.5, 0.0), (0.0, 6 - 5 / 8, 0.0)),  # south
        ((0.0, 7 - 0.125, 0.0), (0.0, 7.0, 0.0)),  # north
        ((0.0, 0.0, 4.5), (0.0, 0.0, 4.25)),  # below a ceiling
    ],
)  # fmt: skip
def test_pushed_to_the_nearest_free_place(
    compiled: bool, start: tuple[float, float, float], moved: tuple[float, float, float]
) -> None:
    fill = [floor(), [3, -20, 0, 4, 20, 3, 1], [-20, 6, 0, 20, 7, 3, 1], [-20, -20, 6, 20, 20, 7, 1]]
    world = build(fill, compiled=compiled)
    with pytest.raises(OverlapError):
        world.spawn("box", start)
    assert world.position(world.spawn("box", start, push=True)) == moved


def test_at_equal_distance_up_comes_first_then_west_east_south_north_down(compiled: bool) -> None:
    """A cube is inside a block of its size, in a shaft whose sides are opened one by one."""
    world = build([[-4, -4, -4, 5, 5, 5, 1]], compiled=compiled, gravity=0)
    sides = [(0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)]
    with pytest.raises(OverlapError, match="nor within a block of it"):
        world.spawn("cube", (0, 0, 0), push=True)
    for side in sides:
        world.set_block(*side, 0)
        entity = world.spawn("cube", (0, 0, 0), push=True)
        assert world.position(entity) == side
        world.remove(entity)


def test_pushed_out_of_entities_and_past_them(compiled: bool) -> None:
    """The nearest free place may touch an entity, between block faces. It is never further away than a block."""
    world = build([floor()], compiled=compiled)
    crate = world.spawn("cube", (0.25, 0, 0))
    pushed = world.spawn("box", (1, 0.1, 0), push=True)
    assert world.position(pushed)[0] == 1.25
    world.place(pushed, (0.25 - 0.5, 0, 0), push=True)
    assert world.position(pushed)[0] == 0.25 - 5 / 8
    world.place(pushed, (0.5, 0.2, 0.9), push=True)
    assert world.position(pushed)[2] == 1
    assert world.position(crate) == (0.25, 0, 0)


def test_a_push_goes_no_further_than_a_block(compiled: bool) -> None:
    world = build([[-9, -9, -9, 9, 9, 1, 1]], compiled=compiled)
    assert world.position(world.spawn("box", (0, 0, 0), push=True)) == (0, 0, 1)
    with pytest.raises(OverlapError):
        world.spawn("box", (5, 5, -STEP), push=True)


def test_a_block_that_pushes(compiled: bool) -> None:
    """If asked to, a block placed into entities moves each to its nearest free place, the lower id first."""
    world = build([floor()], compiled=compiled)
    first, second, rider = (world.spawn("box", at) for at in ((0.75, 0, 0), (-0.5, 0.25, 0), (0.75, 0, 7 / 4)))
    settle(world)
    assert world.set_block(0, 0, 0, 5, push=True)
    assert world.position(first) == (1, 0, 0)
    assert world.position(second) == (-5 / 8, 0.25, 0)
    assert world.blocks.get(0, 0, 0) == 5
    steps(world, 2)
    assert world.position(rider)[2] == 7 / 4


def test_a_block_that_cannot_push_is_not_placed(compiled: bool) -> None:
    world = build([[-4, -4, -4, 4, 4, 4, 1], [0, 0, 0, 1, 1, 2, 0], [1, 0, 0, 2, 1, 1, 0]], compiled=compiled)
    above, below = world.spawn("cube", (1, 0, 0)), world.spawn("box", (0, 0, 0))
    settle(world)
    before = world.state_hash()
    with pytest.raises(OverlapError, match="nor within a block of it"):
        world.fill((0, 0, 0), (1, 1, 2), 7, push=True)
    assert world.state_hash() == before
    assert world.position(above) == (1, 0, 0)
    assert world.position(below) == (0, 0, 0)


def test_a_teleport_keeps_velocity_and_flag(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("stone", (0, 0, 0), (1, 2, 3))
    world.step()
    state = world.state(entity)
    world.place(entity, (9, 9, 9))
    moved = world.state(entity)
    assert moved[:3] + moved[6:] == state[:3] + state[6:]
    assert world.position(entity) == (9, 9, 9)


def test_a_template_that_does_not_fit_is_refused(compiled: bool) -> None:
    world = build([floor(), [1, -4, 0, 2, 4, 2, 1]], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    before = world.state_hash()
    with pytest.raises(OverlapError, match=r"entity 1: no room for the box of 'slab'"):
        world.set_template(entity, "slab")
    with pytest.raises(SceneError, match=r"template = 'nobody': no such template \(there are box, stone,"):
        world.set_template(entity, "nobody")
    assert world.state_hash() == before


def test_places_outside_of_the_range_are_refused(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    with pytest.raises(SceneError, match=r"position\.y = .*outside of \+-268435456 blocks"):
        world.spawn("box", (0, RANGE_BLOCKS + 1, 0))
    with pytest.raises(SceneError, match="three numbers"):
        world.spawn("box", (0, 0))  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="three numbers"):
        world.spawn("box", (0, 0, 0), (0, 0, 0, 0))  # type: ignore[arg-type]
    with pytest.raises(OverlapError):
        world.spawn("box", (RANGE_BLOCKS, 0, 0))


def test_an_entity_that_does_not_exist_is_refused(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    for call in (
        lambda: world.place(1, (0, 0, 0)),
        lambda: world.remove(1),
        lambda: world.set_velocity(1, (0, 0, 0)),
        lambda: world.set_template(1, "box"),
        lambda: world.state(1),
        lambda: world.position(1),
    ):
        with pytest.raises(KeyError):
            call()


def test_many_at_once_are_as_one_by_one(compiled: bool) -> None:
    spots = [(x / 2, y, 0.0) for x in range(-8, 8, 2) for y in range(-5, 5)]
    worlds = [build([floor()], compiled=compiled) for _ in range(2)]
    ids = worlds[0].spawn_many("cube", spots)
    assert list(ids) == [worlds[1].spawn("cube", spot) for spot in spots]
    for world in worlds:
        world.spawn("box", (0, 0, 3))
    for _ in range(60):
        assert worlds[0].state_hash() == worlds[1].state_hash()
        for world in worlds:
            world.step()


@pytest.mark.parametrize(
    ("spots", "error"),
    [
        ([(0, 0, 0), (3, 0, 0), (0.5, 0, 0)], r"positions\[2\] = .*no room for a 'cube'"),  # in the first one
        ([(0, 0, 0), (6, 0, 0)], r"positions\[1\] = .*no room"),  # in one that existed
        ([(0, 0, 0), (0, 0, -0.5)], r"positions\[1\] = .*no room"),  # in a block
        ([(0, 0, 0), (0, float("nan"), 3)], "positions"),
        ([(0, 0, 0), (0, 0, 1e300)], "positions"),
    ],
)
def test_many_at_once_or_none(compiled: bool, spots: list[tuple[float, float, float]], error: str) -> None:
    world = build([floor()], compiled=compiled)
    world.spawn("cube", (6.5, 0.5, 0))
    settle(world)
    before = world.state_hash()
    with pytest.raises(SceneError, match=error):
        world.spawn_many("cube", spots)
    assert world.state_hash() == before
    world.step()
    assert world.awake_count == 0
    assert list(world.spawn_many("cube", [(0, 0, 0), (1, 0, 0)])) == [2, 3]
    world.step()
    assert world.awake_count == 0
