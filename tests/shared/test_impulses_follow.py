"""Templates with gravity, acceleration, friction and air control of their own: a follower computes the stepped world.

The follower gets events and rows only (`tests.mirrored`). Every tick and every bit is compared.
"""

import contextlib
import random

import pytest

from shared.checks import SceneError
from shared.inputs import Input, clamp
from shared.scene import Scene, Template
from shared.world import OverlapError, World
from tests.lengths import long
from tests.mirrored import Mirrored

TEMPLATES = (
    Template("player", walk_speed=4, jump_speed=8, acceleration=30, friction=15, air_control=0.3),
    Template("skater", walk_speed=6, jump_speed=8, acceleration=7, friction=0.5),
    Template("glider", walk_speed=5, jump_speed=9, acceleration=20, air_control=0, gravity=4),
    Template("ghost", walk_speed=3, jump_speed=8, acceleration=9, solid=False),
    Template("knocked", walk_speed=3, jump_speed=8, friction=12),
    Template("drone", (-0.4, -0.4, 0), (0.8, 0.8, 0.8), walk_speed=5, acceleration=6, friction=2, gravity=0),
    Template("crate", (-0.5, -0.5, 0), (1, 1, 1), friction=6),
    Template("puck", (-0.25, -0.25, 0), (0.5, 0.5, 0.5), friction=3, gravity=0, air_control=1),
    Template("walker", walk_speed=3, jump_speed=8),
    Template("stone", (-0.5, -0.5, 0), (1, 1, 1)),
)


def pit(tick_rate: int, integrator: str, gravity: float) -> Scene:
    """A pit of 64 x 64 blocks with walls, steps, pillars and a ceiling in one corner, around a border of segments."""
    fill = [
        [-32, -32, -3, 32, 32, 0, 1],
        *([x, -32, 0, x + 1, 32, 6, 2] for x in (-32, 31)),
        *([-32, y, 0, 32, y + 1, 6, 2] for y in (-32, 31)),
        *([-30 + 7 * i, -30 + 5 * i, 0, -28 + 7 * i, -28 + 5 * i, 1 + i % 3, 3] for i in range(9)),
        [-12, -2, 3, 2, 9, 4, 4],
        [4, -8, -3, 8, -4, 0, 0],
    ]
    return Scene(
        "pit", TEMPLATES, tick_rate, gravity=gravity, integrator=integrator, size=(2, 2, 2), origin=(-1, -1, -1),
        terrain={"generator": "boxes", "fill": fill}, spawns=((0.0, 0.0, 5.0),),
    )  # fmt: skip


def disturb(world: World, rng: random.Random) -> None:
    """Makes one random change of the kinds that rules and players make."""
    ids = world.states()[:, 0].tolist()
    entity = rng.choice(ids)
    x, y, z = world.position(entity)
    force = rng.choice((2, 9, 30, 400, 1024))
    match rng.randrange(16):
        case 0 | 1 | 2 | 3:
            world.add_velocity(entity, [rng.uniform(-force, force) for _ in range(3)])  # type: ignore[arg-type]
        case 4 | 5:
            world.add_velocity(entity, (rng.uniform(-12, 12), rng.uniform(-12, 12), 0))
        case 6:
            world.set_velocity(entity, (rng.uniform(-9, 9), rng.uniform(-9, 9), rng.uniform(-9, 9)))
        case 7:
            world.place(entity, (rng.uniform(-20, 20), rng.uniform(-20, 20), 3))
        case 8 | 9:
            world.set_template(entity, rng.choice(TEMPLATES).name)
        case 10 | 11:
            world.set_block(int(x // 1), int(y // 1), int(z // 1) - 1, 0)
        case 12 | 13:
            world.set_block(int(x // 1) + rng.choice((-1, 1)), int(y // 1), int(z // 1), 1)
        case 14:
            world.remove(entity)
        case 15:
            world.spawn(rng.choice(TEMPLATES).name, (rng.uniform(-20, 20), rng.uniform(-20, 20), 2))


def run(ticks: int, rate: int, integrator: str, gravity: float, compiled: bool, seed: int) -> Mirrored:
    """Steps a crowd and lets the follower follow, with a comparison at every tick."""
    rng = random.Random(seed)
    world = World(pit(rate, integrator, gravity), compiled=compiled)
    world.load_terrain()
    while len(world) < 24:
        try:
            world.spawn(TEMPLATES[len(world) % len(TEMPLATES)].name, (rng.uniform(-9, 9), rng.uniform(-9, 9), 1))
        except OverlapError:
            continue
    mirrored = Mirrored(world)
    for _ in range(ticks):
        for fallen in world.fell:
            world.place(fallen, (0, 0, 5), push=True)
        if rng.random() < 0.3:
            with contextlib.suppress(SceneError):  # no room there, or the place is outside
                disturb(world, rng)
        ids = world.states()[:, 0].tolist()
        wishes = {
            entity: clamp(Input(rng.randint(-127, 127), rng.randint(-127, 127), int(rng.random() < 0.3)))
            if rng.random() < 0.7
            else Input()
            for entity in ids
            if rng.random() < 0.04
        }
        world.step(wishes)
        mirrored.send()
        mirrored.check()
    return mirrored


@pytest.mark.parametrize(
    ("rate", "integrator", "gravity"),
    [
        (32, "mean", 18.0), (128, "semi", 18.0),
        *long((20, "semi", 18.0), (60, "mean", 0.0), (1, "mean", 18.0), (30, "mean", 18.0), (64, "semi", 5.0)),
        *long((240, "mean", 18.0)),
    ],
)  # fmt: skip
def test_a_follower_computes_every_bit(rate: int, integrator: str, gravity: float, compiled: bool) -> None:
    ticks = 2500 if compiled else 120
    mirrored = run(ticks, rate, integrator, gravity, compiled, rate)
    assert mirrored.turns > ticks
    assert mirrored.sent_turns < 0.6 * mirrored.turns


@pytest.mark.slow
def test_a_follower_computes_every_bit_for_long(compiled: bool) -> None:
    run(20_000 if compiled else 2_000, 32, "mean", 18.0, compiled, 7)


def test_compiled_and_plain_kernels_agree() -> None:
    worlds = [run(200, 30, "mean", 18.0, compiled, 5).world for compiled in (True, False)]
    assert worlds[0].state_hash() == worlds[1].state_hash()
