"""The runs behind `physics.json`: a scene, a script, and the hash at some ticks; without random numbers of a
library."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

from shared.inputs import Input, clamp
from shared.scene import Scene, Template, load_scene
from shared.world import OverlapError, World

TICKS = 2000
MARKS = (1, 100, 500, 1000, TICKS)


class Script(NamedTuple):
    """A scene, the number of entities, whether the world is edited on the way, and whether entities are pushed."""

    scene: Callable[[], Scene]
    entities: int
    edits: bool = False
    pushes: bool = False


def crowd_scene(integrator: str = "mean", tick_rate: int = 32) -> Scene:
    """Returns a pit of 64 x 64 blocks with all kinds of entities, far from the origin."""
    templates = (
        Template("player", walk_speed=3.0, jump_speed=8.0),
        Template("crate", (-0.5, -0.5, 0), (1, 1, 1)),
        Template("ghost", walk_speed=5.5, jump_speed=6.0, solid=False),
        Template("plank", (0.25, 0, 0), (3.3, -0.7, 0.2)),
    )
    x, y = 10**6, -(10**7)
    fill = [
        [x - 32, y - 32, -3, x + 32, y + 32, 0, 1],
        *([x - 32 + 7 * i, y - 32 + 5 * i, 0, x - 30 + 7 * i, y - 30 + 5 * i, 1 + i % 3, 2] for i in range(9)),
    ]
    return Scene(
        "crowd", templates, tick_rate, integrator=integrator, size=(2, 2, 2),
        origin=(x // 32 - 1, y // 32 - 1, -1), terrain={"generator": "boxes", "fill": fill}, spawns=((x, y, 4),),
    )  # fmt: skip


def impulse_scene() -> Scene:
    """The crowd's pit with entities that speed up, slow down, float, and fall by a gravity of their own."""
    scene = crowd_scene(tick_rate=60)
    templates = (
        Template("player", walk_speed=4.0, jump_speed=8.0, acceleration=30.0, friction=14.0, air_control=0.3),
        Template("crate", (-0.5, -0.5, 0), (1, 1, 1), friction=6.0),
        Template("glider", walk_speed=5.5, jump_speed=6.0, acceleration=9.0, gravity=5.0, air_control=0.0),
        Template("drone", (-0.4, -0.4, 0), (0.8, 0.8, 0.8), walk_speed=6.0, acceleration=7.0, friction=1.0, gravity=0),
        Template("knocked", walk_speed=3.0, jump_speed=8.0, friction=11.0, solid=False),
    )
    return replace(scene, templates=templates)


SCRIPTS = {
    "arena": Script(lambda: load_scene("arena"), 20),
    "flat": Script(lambda: load_scene("flat"), 40),
    "hills": Script(lambda: load_scene("hills"), 40),
    "topdown": Script(lambda: load_scene("topdown"), 20),
    "crowd": Script(crowd_scene, 60),
    "edits": Script(lambda: crowd_scene("semi", 20), 30, edits=True),
    "impulses": Script(impulse_scene, 50, pushes=True),
}


class Dice:
    """A linear congruential generator, which is the same on every machine and Python version."""

    def __init__(self, seed: int) -> None:
        self.state = seed

    def below(self, n: int) -> int:
        self.state = (self.state * 6364136223846793005 + 1442695040888963407) % (1 << 64)
        return (self.state >> 33) % n


def run(name: str, *, compiled: bool, ticks: int = TICKS) -> Iterator[tuple[int, str]]:
    """Plays a script. Yields each mark and the hash of the whole world there."""
    script = SCRIPTS[name]
    scene = script.scene()
    world = World(scene, compiled=compiled)
    world.load_terrain()
    dice = Dice(len(name))
    for number in range(script.entities):
        _spawn(world, dice, number)
    for tick in range(1, ticks + 1):
        if script.edits and tick % 5 == 0:
            _edit(world, dice)
        if script.pushes and tick % 3 == 0:
            ids = _entities(world)
            push = (dice.below(257) - 128) / 8, (dice.below(257) - 128) / 8, (dice.below(65) - 32) / 4
            world.add_velocity(ids[dice.below(len(ids))], push)
        inputs = {}
        for entity in _entities(world):
            if dice.below(30) == 0:
                inputs[entity] = clamp(Input(dice.below(255) - 127, dice.below(255) - 127, int(dice.below(3) == 0)))
        world.step(inputs)
        for entity in world.fell:
            world.remove(entity)
        if tick in MARKS:
            yield tick, world.state_hash().hex()


def _place(world: World, dice: Dice) -> tuple[float, float, float]:
    x, y, z = world.scene.spawns[dice.below(len(world.scene.spawns))]
    return x + dice.below(161) / 8 - 10, y + dice.below(161) / 8 - 10, z + dice.below(40) / 8


def _spawn(world: World, dice: Dice, number: int) -> None:
    templates = world.scene.templates
    speed = (dice.below(65) - 32) / 4, (dice.below(65) - 32) / 4, float(dice.below(9))
    with contextlib.suppress(OverlapError):
        world.spawn(templates[number % len(templates)].name, _place(world, dice), speed, push=True)


def _entities(world: World) -> list[int]:
    entities: list[int] = world.states()[:, 0].tolist()
    return entities


def _edit(world: World, dice: Dice) -> None:
    x, y, z = (int(part // 1) for part in _place(world, dice))
    low, high = (x, y, z - 6), (x + 1 + dice.below(3), y + 1 + dice.below(3), z - 5 + dice.below(3))
    with contextlib.suppress(OverlapError):
        world.fill(low, high, (0, 0, 1, 2)[dice.below(4)], push=dice.below(2) == 0)
    if dice.below(4) == 0:
        _spawn(world, dice, dice.below(4))
    entities = _entities(world)
    if len(entities) > 20 and dice.below(4) == 0:
        world.remove(entities.pop(dice.below(len(entities))))
    if entities:
        with contextlib.suppress(OverlapError):
            world.place(entities[dice.below(len(entities))], _place(world, dice), push=True)
