"""Entities that carry what stands on them: exact, in the same tick, in any order of ids, and never into a block."""

import contextlib
import random
from typing import Any

import pytest

from shared.checks import SceneError
from shared.inputs import NEUTRAL, Input, clamp
from shared.layout import TEMPLATE, X
from shared.scene import SCENES, Scene, Template, load_scene
from shared.units import BLOCK
from shared.world import OverlapError, World
from tests.lengths import long
from tests.mirrored import Mirrored
from tests.worlds import EAST, TEMPLATES, WEST, box, build, floor, steps

LIFT = Template("lift", (0, 0, 0), (4, 4, 1), gravity=0, carries=True)
BOAT = Template("boat", (0, 0, 0), (2, 2, 0.5), gravity=0, carries=True, walk_speed=2)
SLED = Template("sled", (0, 0, 0), (2, 2, 0.5), carries=True, friction=3)
ORDERS = pytest.mark.parametrize("carrier_first", [True, False])


def world_of(fill: Any = (), **changes: Any) -> World:
    return build(fill, templates=(*TEMPLATES, LIFT, BOAT, SLED), **changes)


def aboard(world: World, carrier_first: bool, *names: str, at: tuple[float, float, float] = (1, 1, 3)) -> list[int]:
    """Spawns a lift at (0, 0, 2) and a pile on it. Returns the lift and the pile, lowest first."""
    lift = world.spawn("lift", (0, 0, 2)) if carrier_first else 0
    pile, z = [], at[2]
    for name in names:
        pile.append(world.spawn(name, (at[0], at[1], z)))
        z += next(template.box_size[2] for template in world.scene.templates if template.name == name)
    if not carrier_first:
        lift = world.spawn("lift", (0, 0, 2))
    steps(world, 3)
    assert not any(world.falling(entity) for entity in (lift, *pile))
    return [lift, *pile]


def offsets(world: World, ids: list[int]) -> list[list[int]]:
    """Returns the positions of entities relative to the first one's, in grid steps."""
    places = [world.state(entity)[X : X + 3] for entity in ids]
    return [[a - b for a, b in zip(place, places[0], strict=True)] for place in places]


@ORDERS
@pytest.mark.parametrize(
    "velocity",
    [(2, 0, 0), (0, -2, 0), (0, 0, 1), (0, 0, -1), (1.3, -0.7, 1.1), (-3, 2.9, -1.7), (0, 0, -30), (0, 0, 20)],
)
def test_a_stack_of_riders_moves_as_one_with_the_carrier(
    velocity: tuple[float, float, float], carrier_first: bool, compiled: bool
) -> None:
    world = world_of(compiled=compiled, tick_rate=60)
    ids = aboard(world, carrier_first, "box", "stone", "cube")
    before = offsets(world, ids)
    start = world.position(ids[0])
    world.set_velocity(ids[0], velocity)
    for _ in range(30):
        world.step()
        assert offsets(world, ids) == before
    assert world.position(ids[0]) != start
    world.set_velocity(ids[0], (0, 0, 0))
    steps(world, 3)
    assert world.awake_count == 0
    assert offsets(world, ids) == before
    assert all(world.velocity(entity) == (0, 0, 0) for entity in ids)


@ORDERS
def test_an_elevator_stops_under_a_ceiling_that_its_rider_reaches(carrier_first: bool, compiled: bool) -> None:
    world = world_of([[-5, -5, 9, 9, 9, 10, 1]], compiled=compiled)
    lift, rider, top = aboard(world, carrier_first, "box", "stone")
    world.set_velocity(lift, (0, 0, 5))
    steps(world, 200)
    assert world.position(top)[2] == 9 - 7 / 4
    assert world.position(rider)[2] == 9 - 7 / 2
    assert world.position(lift)[2] == 9 - 7 / 2 - 1
    assert world.velocity(lift) == (0, 0, 0), "it was stopped"


@ORDERS
def test_a_rider_against_a_wall_stays_and_falls_when_the_carrier_is_gone(carrier_first: bool, compiled: bool) -> None:
    world = world_of([[5, -9, 3, 6, 9, 8, 1], floor(0)], compiled=compiled)
    lift, rider = aboard(world, carrier_first, "stone", at=(3, 1, 3))
    world.set_velocity(lift, (2, 0, 0))
    steps(world, 32 * 2)
    assert world.position(lift)[0] == 2
    assert world.position(rider) == (5 - 5 / 8, 1, 3)
    steps(world, 32 * 6)
    assert world.position(lift)[0] == 8
    assert world.position(rider) == (5 - 5 / 8, 1, 0)


@pytest.mark.parametrize("velocity", [(3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -3, 0)])
def test_riders_side_by_side_keep_touching_and_queue_at_a_wall(velocity: Any, compiled: bool) -> None:
    """The foremost is moved first, so nobody is held back by a neighbour that has yet to move."""
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        world = world_of(compiled=compiled)
        lift = world.spawn("lift", (0, 0, 2))
        riders = {i: world.spawn("cube", (0.5 + i, 0.5 + i, 3)) for i in order}
        again = {i: world.spawn("cube", (0.5 + i, 0.5 + (i + 1) % 3, 3)) for i in order}
        ids = [lift, *riders.values(), *again.values()]
        before = offsets(world, ids)
        world.set_velocity(lift, velocity)
        for _ in range(50):
            world.step()
            assert offsets(world, ids) == before


@ORDERS
def test_a_rider_walks_and_jumps_on_a_moving_carrier(carrier_first: bool, compiled: bool) -> None:
    world = world_of(compiled=compiled)
    lift, rider = aboard(world, carrier_first, "box")
    world.set_velocity(lift, (1, 0, 0))
    world.step()
    x = world.position(rider)[0]
    world.step({rider: WEST})
    assert world.position(rider)[0] - x == (1 - 3) / 64
    world.step({rider: EAST})
    world.step({rider: EAST._replace(buttons=1)})
    assert world.velocity(rider)[2] > 0
    world.step({rider: NEUTRAL})
    x = world.position(rider)[0]
    world.step()
    assert world.position(rider)[0] == x, "in the air it is not carried"
    steps(world, 100)
    assert not world.falling(rider)
    gap = offsets(world, [lift, rider])
    steps(world, 10)
    assert offsets(world, [lift, rider]) == gap


@pytest.mark.parametrize("swapped", [True, False])
def test_who_stands_on_two_carriers_is_carried_once(swapped: bool, compiled: bool) -> None:
    world = world_of(compiled=compiled)
    places = [(0.0, 0.0, 2.0), (4.0, 0.0, 2.0)]
    first, second = (world.spawn("lift", place) for place in (places[::-1] if swapped else places))
    rider = world.spawn("cube", (3.5, 1, 3))
    for velocity in ((0, 1, 0), (0, 0, 1), (0, 0, -1), (0, -2, 0)):
        before = offsets(world, [first, second, rider])
        for lift in (first, second):
            world.set_velocity(lift, velocity)
        steps(world, 32)
        assert offsets(world, [first, second, rider]) == before


@pytest.mark.parametrize("order", [("lift", "boat", "box"), ("box", "boat", "lift"), ("boat", "lift", "box")])
def test_a_carrier_on_a_carrier_adds_its_own_motion(order: tuple[str, ...], compiled: bool) -> None:
    world = world_of(compiled=compiled)
    at = {"lift": (0.0, 0.0, 2.0), "boat": (0.5, 0.5, 3.0), "box": (1.0, 1.0, 3.5)}
    ids = {name: world.spawn(name, at[name]) for name in order}
    world.step()
    world.set_velocity(ids["lift"], (0, 1, 0))
    steps(world, 32, {ids["boat"]: Input(64, 0)})
    boat = round(2 * 65536 * 64 / 127) / 65536
    assert world.position(ids["lift"]) == (0, 0.5, 2)
    assert world.position(ids["boat"]) == (0.5 + boat / 2, 1, 3)
    assert world.position(ids["box"]) == (1 + boat / 2, 1.5, 3.5)


def test_ghosts_and_scenes_without_collisions_have_no_riders(compiled: bool) -> None:
    world = world_of([floor(0)], compiled=compiled)
    lift, ghost = world.spawn("lift", (0, 0, 0)), world.spawn("ghost", (1, 1, 0))
    world.set_velocity(lift, (1, 0, 0))
    steps(world, 20)
    assert world.position(ghost) == (1, 1, 0)
    world = world_of([floor(0)], compiled=compiled, entity_collision=False)
    lift, other = world.spawn("lift", (0, 0, 0)), world.spawn("box", (1, 1, 1))
    world.set_velocity(lift, (1, 0, 0))
    steps(world, 100)
    assert world.position(other) == (1, 1, 0)


def test_a_carrier_has_to_be_solid_and_scenes_without_one_keep_their_bytes() -> None:
    with pytest.raises(SceneError, match=r"^templates\.lift\.carries = True: needs solid = True"):
        Template("lift", carries=True, solid=False)
    with pytest.raises(SceneError, match=r"^templates\.lift\.carries"):
        Template("lift", carries=1)  # type: ignore[arg-type]
    for file in SCENES.glob("*.toml"):
        assert all("carries" not in template for template in load_scene(file.stem).to_table()["templates"])
    made = Scene("test", (LIFT,), player="lift")
    assert Scene.from_table(made.to_table()) == made
    assert made.to_table()["templates"][0]["carries"] is True


# -- a client ------------------------------------------------------------------------------------------------


@ORDERS
def test_a_rider_at_rest_costs_nine_bytes_and_its_part_and_one_that_walks_a_row(
    carrier_first: bool, compiled: bool
) -> None:
    world = world_of(compiled=compiled)
    lift, rider = aboard(world, carrier_first, "box", at=(1, 1, 3))
    world.set_velocity(lift, (1, 0, 0))
    world.step()
    mirrored = Mirrored(world)
    for ticks, wish, most in ((50, None, 18), (1, EAST, 46), (40, None, 46)):
        before = mirrored.bytes
        for _ in range(ticks):
            world.step({rider: wish} if wish else None)
            mirrored.send()
            mirrored.check()
        assert (mirrored.bytes - before) / ticks <= most


def crowd(rate: int, compiled: bool, rng: random.Random) -> World:
    """A room around a border of segments with lifts, boats and sleds, and many who stand on them."""
    fill = [
        [-20, -20, -3, 20, 20, 0, 1],
        *([x, -20, 0, x + 1, 20, 12, 2] for x in (-20, 19)),
        *([-20, y, 0, 20, y + 1, 12, 2] for y in (-20, 19)),
        [-20, -20, 12, 20, 20, 13, 2],
        *([-18 + 5 * i, -16 + 4 * i, 0, -16 + 5 * i, -15 + 4 * i, 1 + i, 3] for i in range(7)),
    ]
    world = world_of(fill, compiled=compiled, tick_rate=rate)
    names = ["lift", "boat", "sled", "box", "stone", "cube", "runner", "person", "ghost", "box", "person"]
    while len(world) < 40:
        with contextlib.suppress(OverlapError):
            x, y, z = rng.uniform(-17, 13), rng.uniform(-17, 13), rng.choice((0.0, 0.0, 2.0, 4.0))
            world.spawn(names[len(world) % len(names)], (x, y, z))
    return world


def disturb(world: World, rng: random.Random) -> None:
    ids = world.states()[:, 0].tolist()
    entity = rng.choice(ids)
    template = world.scene.templates[world.state(entity)[TEMPLATE]]
    x, y, z = world.position(entity)
    match rng.randrange(8):
        case 0 | 1 | 2 if template.carries:
            world.set_velocity(entity, tuple(rng.choice((-2.5, -1, 0, 0, 1, 2.5)) for _ in range(3)))  # type: ignore[arg-type]
        case 3:
            world.add_velocity(entity, (rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(0, 5)))
        case 4 | 5 if template.carries:
            top = z + template.box_size[2]
            world.place(rng.choice(ids), (x + rng.uniform(0, 1.5), y + rng.uniform(0, 1.5), top))
        case 6:
            world.set_block(
                int(x // 1) + rng.randint(-2, 2), int(y // 1) + rng.randint(-2, 2), int(z // 1), rng.randint(0, 1)
            )
        case 7 if rng.random() < 0.2:
            world.remove(entity)
            world.spawn(template.name, (rng.uniform(-9, 9), rng.uniform(-9, 9), 5), push=True)


def overlapping(world: World) -> list[tuple[int, int]]:
    """Returns the pairs of solid entities whose boxes overlap."""
    solid = [
        (entity, box(world, entity))
        for entity in world.states()[:, 0].tolist()
        if world.scene.templates[world.state(entity)[TEMPLATE]].solid
    ]
    return [
        (one, other)
        for i, (one, a) in enumerate(solid)
        for other, b in solid[:i]
        if all(a[k] < b[k + 3] and a[k + 3] > b[k] for k in range(3))
    ]


def in_blocks(world: World) -> list[int]:
    """Returns the solid entities that overlap a block. A block may be placed where one is that is not solid."""
    return [
        entity
        for entity in world.states()[:, 0].tolist()
        if world.scene.templates[world.state(entity)[TEMPLATE]].solid
        and any(
            world.blocks.get(x, y, z)
            for low in [box(world, entity)]
            for z in range(low[2] // BLOCK, -(-low[5] // BLOCK))
            for y in range(low[1] // BLOCK, -(-low[4] // BLOCK))
            for x in range(low[0] // BLOCK, -(-low[3] // BLOCK))
        )
    ]


def run(ticks: int, rate: int, compiled: bool, seed: int) -> Mirrored:
    rng = random.Random(seed)
    world = crowd(rate, compiled, rng)
    mirrored = Mirrored(world)
    for tick in range(ticks):
        if rng.random() < 0.4:
            with contextlib.suppress(SceneError):  # no room there, or it is outside
                disturb(world, rng)
        wishes = {
            entity: clamp(Input(rng.randint(-127, 127), rng.randint(-127, 127), int(rng.random() < 0.2)))
            if rng.random() < 0.5
            else NEUTRAL
            for entity in world.states()[:, 0].tolist()
            if rng.random() < 0.03
        }
        world.step(wishes)
        mirrored.send()
        mirrored.check()
        if tick % 10 == 0:
            assert overlapping(world) == []
            assert in_blocks(world) == []
    return mirrored


@pytest.mark.parametrize(("rate", "seed"), [(32, 1), (20, 2), *long((60, 3), (64, 4), (128, 5), (30, 6))])
def test_a_crowd_on_carriers_is_followed_to_the_bit_and_nothing_overlaps(rate: int, seed: int, compiled: bool) -> None:
    run(1500 if compiled else 100, rate, compiled, seed)


@pytest.mark.slow
def test_a_crowd_on_carriers_is_followed_for_20_000_ticks() -> None:
    run(20_000, 32, True, 7)


def test_compiled_and_plain_kernels_agree_and_a_restored_world_goes_on_equally() -> None:
    worlds = [run(150, 30, compiled, 5).world for compiled in (True, False)]
    assert worlds[0].state_hash() == worlds[1].state_hash()
    again = World(worlds[0].scene, compiled=True)
    again.load_terrain()
    again.put(worlds[0].states()[::-1].copy())
    for index in worlds[0].blocks:
        again.load_segment(index, worlds[0].blocks.segment(index).reshape(-1).copy())
    again.rebase(worlds[0].tick)
    for _ in range(200):
        for world in (again, worlds[0]):
            world.step()
        assert again.states().tolist() == worlds[0].states().tolist()
