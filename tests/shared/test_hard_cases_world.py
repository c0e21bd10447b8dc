"""Hard cases of meetings, edits, numbers and copies (H14, H15, H20 to H26, H31 to H33)."""

import itertools
import random

import numpy as np
import pytest

from shared.checks import SceneError
from shared.inputs import Input
from shared.terrain import generate
from shared.world import OverlapError, World
from tests.lengths import long
from tests.worlds import EAST, JUMP, STEP, WEST, build, floor, high, low, settle, states


@pytest.mark.parametrize(("first", "plane"), [("east-bound", 33 / 64), ("west-bound", 31 / 64)])
def test_h14_two_movers_head_on(compiled: bool, first: str, plane: float) -> None:
    """A gap of one block closes by 6/64 a tick. In the eleventh tick 4/64 are left: the lower id takes 3, the
    other 1."""
    world = build([floor()], compiled=compiled)
    spots = [(-5 / 8, EAST), (1.0, WEST)]
    if first == "west-bound":
        spots.reverse()
    entities = [world.spawn("box", (x, 0, 0)) for x, _ in spots]
    wishes = {entity: input_ for entity, (_, input_) in zip(entities, spots, strict=True)}
    east, west = entities if first == "east-bound" else entities[::-1]
    for tick in range(1, 40):
        world.step(wishes)
        assert high(world, east)[0] <= low(world, west)[0]
        if tick <= 10:
            assert (high(world, east)[0], low(world, west)[0]) == (tick * 3 / 64, 1 - tick * 3 / 64)
    assert high(world, east)[0] == low(world, west)[0] == plane
    assert world.velocity(east) == world.velocity(west) == (0, 0, 0)


def test_h15_a_pile_of_five(compiled: bool, integrator: str) -> None:
    world = build([[-4, -4, 0, 4, 4, 1, 1]], compiled=compiled, integrator=integrator)
    pile = [world.spawn("box", (0.1 * i, -0.1 * i, 2 + 3 * i)) for i in range(5)]
    settle(world)
    assert [world.position(entity)[2] for entity in pile] == [1, 2.75, 4.5, 6.25, 8]
    assert world.awake_count == 0
    world.fill((-4, -4, 0), (4, 4, 1), 0)
    world.step()
    assert all(world.falling(entity) for entity in pile)
    heights = [world.position(entity)[2] for entity in pile]
    assert [b - a for a, b in itertools.pairwise(heights)] == [7 / 4] * 4
    assert heights[0] < 1


def test_h15_a_pile_with_its_highest_id_below(compiled: bool) -> None:
    """Support is checked at the start of a turn. An entity whose turn comes before that of the one below follows a tick
    later."""
    world = build([[-4, -4, 0, 4, 4, 1, 1]], compiled=compiled)
    pile = [world.spawn("box", (0, 0, 1 + 7 / 4 * i)) for i in reversed(range(5))][::-1]
    settle(world)
    world.fill((-4, -4, 0), (4, 4, 1), 0)
    for tick in range(5):
        world.step()
        assert [world.falling(entity) for entity in pile] == [i <= tick for i in range(5)]


@pytest.mark.parametrize("how", ["spawn", "place"])
def test_h20_a_place_inside_a_block(compiled: bool, how: str) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (5, 5, 0))

    def put(position: tuple[float, float, float], *, push: bool) -> int:
        if how == "spawn":
            return world.spawn("box", position, push=push)
        world.place(entity, position, push=push)
        return entity

    before = world.state_hash()
    with pytest.raises(OverlapError, match=r"position = .*no room"):
        put((0, 0, -STEP), push=False)
    assert world.state_hash() == before
    pushed = put((0, 0, -0.25), push=True)
    assert world.position(pushed) == (0, 0, 0)
    world.step()
    assert world.position(pushed) == (0, 0, 0)


def test_h21_a_block_into_an_entity(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0.5, 0.5, 0))
    before = world.state_hash()
    with pytest.raises(OverlapError, match=f"entity {entity} is there"):
        world.set_block(0, 0, 1, 1)
    with pytest.raises(OverlapError, match=f"entity {entity} is there"):
        world.fill((-5, -5, 1), (5, 5, 2), 1)
    assert world.state_hash() == before
    assert world.set_block(0, 0, 2, 1)
    assert world.set_block(-1, 0, 0, 1)
    ghost = world.spawn("ghost", (5.1, 5.1, 0))
    assert world.set_block(5, 5, 0, 1)
    assert world.position(ghost) == (round(5.1 / STEP) * STEP, round(5.1 / STEP) * STEP, 0)


def test_h22_a_block_removed_under_a_sleeper(compiled: bool, integrator: str) -> None:
    world = build([floor()], compiled=compiled, integrator=integrator)
    entity = world.spawn("box", (0.25, 0.25, 0))
    settle(world)
    assert world.set_block(0, 0, -1, 0)
    world.step()
    assert world.falling(entity)
    assert world.position(entity)[2] == (-1 / 4 if integrator == "semi" else -1 / 8) / 64


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 10**400])
@pytest.mark.parametrize("axis", range(3))
def test_h23_to_h25_no_such_number(compiled: bool, bad: float, axis: int) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    before = world.state_hash()
    vector = [0.0, 0.0, 9.0]
    vector[axis] = bad
    three = (vector[0], vector[1], vector[2])
    field = "xyz"[axis]
    with pytest.raises(SceneError, match=rf"^position\.{field} = "):
        world.spawn("box", three)
    with pytest.raises(SceneError, match=rf"^velocity\.{field} = "):
        world.spawn("box", (9, 9, 9), three)
    with pytest.raises(SceneError, match=rf"^position\.{field} = "):
        world.place(entity, three)
    with pytest.raises(SceneError, match=rf"^velocity\.{field} = "):
        world.set_velocity(entity, three)
    assert world.state_hash() == before


@pytest.mark.parametrize("tiny", [5e-324, -5e-324, -0.0])
def test_h26_nothing_smaller_than_a_step(compiled: bool, tiny: float) -> None:
    hashes = []
    for value in (0.0, tiny):
        world = build([floor()], compiled=compiled)
        entity = world.spawn("box", (value, value, value), (value, value, value))
        world.set_velocity(entity, (value, value, value))
        world.place(entity, (value, value, value))
        world.step({entity: Input()})
        assert world.position(entity) == (0, 0, 0)
        assert not world.awake(entity)
        hashes.append(world.state_hash())
    assert hashes[0] == hashes[1]


def busy(compiled: bool) -> World:
    """Returns a world with many moving entities at tick 50."""
    world = build([floor(), [3, -9, 0, 4, 9, 2, 1]], compiled=compiled)
    for i in range(12):
        world.spawn(
            "box" if i % 3 else "stone", (i % 4 - 2, i // 4, 2 * (i % 3)), (1.7, -0.3, 2.0) if i % 3 == 0 else (0, 0, 0)
        )
    for tick in range(50):
        world.step({2: EAST, 3: WEST, 5: JUMP} if tick == 3 else None)
    return world


def test_h31_restored_from_its_states_and_replayed(compiled: bool) -> None:
    """States and blocks are the complete state: a world that gets them goes on alike, whether entities are asleep or
    awake."""
    world = busy(compiled)
    other = World(world.scene, compiled=compiled)
    for index in world.blocks:
        other.load_segment(index, world.blocks.segment(index).reshape(-1).copy())
    other.put(states(world)[::-1])
    other.rebase(world.tick)
    assert other.state_hash() == world.state_hash()
    for tick in range(150):
        inputs = {2: Input(-100, 20, tick % 2), 7: JUMP} if tick % 40 == 0 else {}
        world.step(inputs)
        other.step(inputs)
        assert other.state_hash() == world.state_hash()


@pytest.mark.parametrize("seed", [0, *long(1, 2)])
def test_h32_h33_the_order_of_entry_does_not_matter(compiled: bool, seed: int) -> None:
    """Segments, blocks and entities are entered in any order, and blocks are edited there and back."""
    world = busy(compiled)
    order = random.Random(seed)
    other = World(world.scene, compiled=compiled)
    indices = world.scene.segments()
    order.shuffle(indices)
    for index in indices:
        other.load_segment(index, np.zeros(32**3, np.uint8))
    solid = [
        (int(x + i * 32), int(y + j * 32), int(z + k * 32), int(kinds[z, y, x]))
        for i, j, k in indices
        for kinds in [generate(world.scene.terrain, (i, j, k)).reshape(32, 32, 32)]
        for z, y, x in zip(*np.nonzero(kinds), strict=True)
    ]
    order.shuffle(solid)
    for x, y, z, kind in solid:
        if order.random() < 0.1:
            other.set_block(x, y, z, 9)
            other.set_block(x, y, z, 0)
        other.set_block(x, y, z, kind)
    extra = order.sample(range(-9, 9), 4)
    for x in extra:
        other.set_block(x, 8, 12, 3)
    for x in extra:
        other.set_block(x, 8, 12, 0)
    entities = states(world)
    order.shuffle(entities)
    for state in entities:
        other.put([state])
    other.rebase(world.tick)
    for _ in range(60):
        assert other.state_hash() == world.state_hash()
        world.step()
        other.step()
