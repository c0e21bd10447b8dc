"""Behaviours that put solid boxes and blocks into each other at the same ticks."""

import random

from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.scene import Scene
from shared.world import World
from tests.behaving import scene


class Piler(Behaviour):
    """Spawns crates at one place, changes blocks there, and dashes around."""

    templates = ("player", "tall")
    spawns = 6

    def turn(self, me: Body) -> None:
        if me.pressed("fire"):
            me.spawn("crate", (32.0, 32.0, 2.0 + me.chance(3)), (0.0, 0.0, 5.0 * me.chance(2)))
        if me.pressed("build"):
            me.edit(32, 32, 2 + me.chance(3), 4 * me.chance(2))
        if me.pressed("grow"):
            me.become("tall" if me.template == "player" else "player")
        if me.pressed("dash"):
            me.velocity = (me.chance(40) - 20.0, me.chance(40) - 20.0, 5.0)


class Piled(Behaviour):
    """Changes its size at random, and vanishes after a while."""

    templates = ("crate", "barrel")
    age = field(bits=16)

    def turn(self, me: Body) -> None:
        me.age += 1
        me.wake(me.tick + 3)
        if me.chance(8) == 0:
            me.become("barrel" if me.template == "crate" else "crate")
        if me.age > 30 + me.chance(30):
            me.remove()


class Piles(Rules):
    """The rules of these behaviours."""

    behaviours = (Piler, Piled)

    def prepare(self, scene: Scene) -> Scene:
        return piles(())


def piles(classes: tuple[type[Behaviour], ...] = Piles.behaviours) -> Scene:
    """Returns the scene, in which players reach far."""
    return scene(classes, reach=30.0, spawns=tuple((30.0 + k % 4, 29.0 + k // 4, 2.0) for k in range(6)))


def piled(players: int, *, compiled: bool) -> tuple[World, list[int]]:
    """Returns a world of the scene with players, and their numbers."""
    world = World(piles(), compiled=compiled)
    world.load_terrain()
    return world, [world.spawn("player", world.scene.spawns[k]) for k in range(players)]


def shuffled(rng: random.Random, ids: list[int]) -> list[int]:
    """Returns the ids in another order, in which a step gets its inputs."""
    return rng.sample(ids, len(ids))
