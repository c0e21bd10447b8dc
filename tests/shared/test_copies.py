"""Copies, restored worlds, reused rows and cached lists: the bookkeeping behind the state."""

import random

import numpy as np
import pytest

from shared.inputs import Input
from shared.scene import Template
from shared.world import World
from tests.lengths import long_but
from tests.worlds import EAST, JUMP, TEMPLATES, WEST, build, floor, high, settle, states, steps


def crowd(compiled: bool, n: int = 7, seed: int = 1) -> World:
    """Returns a world of walkers, stones and ghosts on a floor with a few walls."""
    r = random.Random(seed)
    walls = [[r.randint(-9, 9) for _ in range(2)] for _ in range(12)]
    world = build([floor(), *([x, y, 0, x + 1, y + 1, 2, 1] for x, y in walls)], compiled=compiled)
    while len(world) < n:
        add(world, r)
    return world


def add(world: World, r: random.Random) -> None:
    try:
        world.spawn(
            r.choice(("box", "stone", "person", "ghost", "slab")), (r.uniform(-8, 8), r.uniform(-8, 8), r.uniform(0, 6))
        )
    except ValueError:
        return


def wishes(world: World, r: random.Random) -> dict[int, Input]:
    return {
        entity: Input(r.choice((-127, 0, 90)), r.choice((-60, 0, 89)), r.choice((0, 0, 1)))
        for entity in world.entities["id"].tolist()
        if r.random() < 0.1
    }


def disturb(world: World, r: random.Random) -> None:
    """Changes a world at random, so that it differs in entities, rows, blocks and segments."""
    for _ in range(r.randint(1, 6)):
        entities = world.entities["id"].tolist()
        match r.randrange(5):
            case 0:
                for _ in range(r.choice((1, 20))):
                    add(world, r)
            case 1 if entities:
                for entity in r.sample(entities, max(1, len(entities) // r.choice((2, 8)))):
                    world.remove(entity)
            case 2:
                world.fill((-9, -9, -1), (r.randint(-8, 9), 9, 0), r.choice((0, 2)) if r.random() < 0.5 else 0)
            case 3:
                world.load_segment((r.randint(1, 3), 0, 0), np.zeros(32**3, np.uint8))
            case _:
                steps(world, r.randint(1, 9), wishes(world, r))


@pytest.mark.parametrize("seed", long_but(range(4), range(12)))
def test_restored_over_a_world_that_has_diverged(compiled: bool, seed: int) -> None:
    """A restored world goes on like the original, also after it had other rows, another capacity and other segments."""
    r = random.Random(seed)
    world = crowd(compiled, n=r.choice((3, 9, 20)), seed=seed)
    steps(world, r.randint(1, 30), wishes(world, r))
    other = world.copy()
    disturb(other, r)
    disturb(world, r)
    assert other.state_hash() != world.state_hash()
    other.restore(world)
    copied = world.copy()
    for _ in range(40):
        assert world.state_hash() == other.state_hash() == copied.state_hash()
        inputs = wishes(world, r)
        for each in (world, other, copied):
            each.step(inputs)
            assert (each.changed == world.changed)[:, :12].all()
        if r.random() < 0.1:
            state = r.getstate()
            for each in (world, other, copied):
                r.setstate(state)
                add(each, r)


def test_a_restored_world_has_no_ghost_of_its_past(compiled: bool) -> None:
    """The other world has fewer rows than are needed, and the same segments. Its cells are emptied all the same."""
    world = build([floor()], compiled=compiled)
    walker = world.spawn("box", (0, 0, 0))
    other = world.copy()
    for i in range(40):
        other.spawn("stone", (2 + i % 5, -4 + i // 5, 0))
    other.step()
    other.restore(world)
    steps(other, 64, {walker: EAST})
    assert other.position(walker) == (3, 0, 0)
    assert sum(len(other.in_segment(index)) for index in other.blocks) == 1


@pytest.mark.parametrize("moment", ["before the step", "after the step"])
def test_a_copy_knows_what_has_changed(compiled: bool, moment: str) -> None:
    world = build([floor()], compiled=compiled)
    for x in range(3):
        world.spawn("box", (2 * x, 0, 0))
    settle(world)
    world.place(2, (2, 4, 3))
    other = world.copy()
    for each in (world, other):
        each.step()
    if moment == "after the step":
        other = world.copy()
    assert world.changed[:, 0].tolist() == other.changed[:, 0].tolist() == [2]


def test_a_step_leaves_what_it_was_copied_from_alone(compiled: bool) -> None:
    world = crowd(compiled)
    copied = world.copy()
    before = copied.state_hash()
    world.set_block(0, 0, 9, 1)
    steps(world, 9)
    assert copied.state_hash() == before


def test_both_kernels_share_a_past() -> None:
    """A compiled world that is restored from a plain one goes on alike."""
    plain = crowd(False)
    steps(plain, 20, {1: EAST, 2: WEST})
    compiled = World(plain.scene, compiled=True)
    compiled.restore(plain)
    for _ in range(50):
        plain.step()
        compiled.step()
        assert plain.state_hash() == compiled.state_hash()


def test_rebased_to_a_tick_that_has_been_before(compiled: bool) -> None:
    """Changes that an earlier run of these ticks made are forgotten. The new run reports its own changes."""
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    steps(world, 10, {entity: EAST})
    world.put(states(world))
    world.rebase(5)
    for tick in range(6, 15):
        world.step()
        assert world.tick == tick
        assert world.changed[:, 0].tolist() == [entity]


def test_a_state_with_the_bookkeeping_flag_is_still_woken(compiled: bool) -> None:
    """A state with the flag "listed" is put into a world that does not list it yet. The world lists it itself."""
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 5))
    other = build([floor()], compiled=compiled)
    other.put(world.rows([entity])[:, :12])
    assert other.state(entity) == world.state(entity)
    other.step()
    assert other.falling(entity)


def test_an_entity_removed_and_written_again_in_one_tick(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 5))
    state = world.state(entity)
    for _ in range(3):
        world.remove(entity)
        assert entity not in world
        world.put([state])
    assert len(world) == 1
    world.step()
    assert world.awake_count == 1
    assert world.falling(entity)


def test_rows_used_again_keep_the_order_of_ids(compiled: bool) -> None:
    """The lower id decides a contact, wherever its row lies."""
    results = []
    for reuse in (False, True):
        world = build([floor()], compiled=compiled)
        old = [world.spawn("box", (8, y, 0)) for y in range(4)]
        settle(world)
        if reuse:
            for entity in old:
                world.remove(entity)
            world.step()
        first = world.spawn("box", (-5 / 8, 0, 0))
        if reuse:
            world.remove(first)
            world.step()
            world.put([(first, 0, 0, *(int(v * (1 << 24)) for v in (-5 / 8, 0, 0)), 0, 0, 0, 0, 0, 0)])
        second = world.spawn("box", (1, 0, 0))
        steps(world, 40, {first: EAST, second: WEST})
        results.append((world.position(first), world.position(second)))
    assert results[0] == results[1]
    assert results[0][0][0] == 33 / 64 - 5 / 8


def test_an_entity_at_the_edge_of_the_loaded_world_exists_fully(compiled: bool) -> None:
    """The position is the first place that is not loaded, on the high face of the box. The entity still stops others,
    is found and is woken."""
    templates = (*TEMPLATES, Template("west of it", (0, 0, 0), (-1, 1, 1), walk_speed=3))
    world = build([floor(half=64)], compiled=compiled, templates=templates)
    entity, walker = world.spawn("west of it", (30, 0, 0)), world.spawn("box", (20, 0, 0))
    steps(world, 64, {entity: EAST})
    assert world.position(entity) == (32, 0, 0)
    world.step({entity: Input()})
    rider = world.spawn("box", (31.1, 0, 1))
    steps(world, 300, {walker: EAST})
    assert high(world, walker)[0] == 31
    assert world.position(rider)[2] == 1
    world.fill((31, 0, -1), (32, 1, 0), 0)
    world.step()
    assert world.falling(entity)
    assert world.falling(rider)


def test_entities_meet_in_the_void(compiled: bool) -> None:
    """Below the floor nothing is loaded. A box that lands on another still stops there."""
    world = build(compiled=compiled, origin=(0, 0, 0), size=(1, 1, 1), terminal_speed=4)
    lower, upper = world.spawn("stone", (8, 8, -30)), world.spawn("stone", (8, 8, -20))
    world.set_velocity(upper, (0, 0, -4))
    state = list(world.state(lower))
    for _ in range(200):
        state[6:9] = [0, 0, 0]
        world.put([tuple(state)])
        world.step()
    assert world.position(upper)[2] <= world.position(lower)[2] + 7 / 4 + 1
    assert world.position(upper)[2] >= world.position(lower)[2] + 7 / 4


def test_a_direction_beyond_the_range_is_full_speed(compiled: bool) -> None:
    world = build([floor()], compiled=compiled)
    entity = world.spawn("box", (0, 0, 0))
    world.step({entity: Input(10_000, -(10**9))})
    assert world.velocity(entity) == (3, -3, 0)
    world.step({entity: JUMP})
    assert world.velocity(entity)[2] > 0
