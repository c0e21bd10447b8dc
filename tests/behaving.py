"""A scene whose behaviours use every ability of `shared.body`, and players who press its buttons at random."""

import random
from typing import Any

from client_sdk.core import Core
from server.rules import Rules
from shared.behaviours import Behaviour
from shared.inputs import Input, make_input
from shared.scene import Scene, Template
from shared.world import World
from tests.acrobat import CLASSES as CLASSES
from tests.acrobat import Acrobat as Acrobat
from tests.acrobat import Crate as Crate
from tests.acrobat import Shot as Shot

BUTTONS = ("jump", "dash", "fire", "build", "grow", "recall")


def scene(classes: tuple[type[Behaviour], ...] = CLASSES, **changes: Any) -> Scene:
    """Returns a scene of four segments with some walls, and with the behaviours of this module."""
    fill = [[0, 0, 0, 64, 64, 2, 1], [10, 10, 2, 12, 54, 4, 2], [40, 8, 2, 44, 12, 3, 3], [20, 50, 2, 50, 51, 3, 2]]
    walker = Template("player", walk_speed=5.0, jump_speed=8.0)
    values: dict[str, Any] = {
        "templates": (
            walker,
            Template("dashing", walk_speed=12.0, jump_speed=4.0, acceleration=60.0, friction=4.0),
            Template("tall", (-0.3, -0.3, 0.0), (0.6, 0.6, 3.2), walk_speed=2.0),
            Template("shot", (-0.1, -0.1, -0.1), (0.2, 0.2, 0.2), solid=False),
            Template("crate", (-0.5, -0.5, 0.0), (1.0, 1.0, 1.0)),
            Template("barrel", (-0.4, -0.4, 0.0), (0.8, 0.8, 1.5)),
        ),
        "size": (2, 2, 1),
        "spawns": ((31.0, 31.0, 3.0), (35.0, 29.0, 3.0), (28.0, 36.0, 3.0)),
        "terrain": {"generator": "boxes", "fill": fill},
        "buttons": BUTTONS,
        "aim": True,
        "chance": 1234,
    }
    return Scene("behaving", **(values | changes)).with_behaviours(classes)


_scene = scene


class Playground(Rules):
    """Rules with the behaviours of this module and some crates."""

    behaviours = CLASSES
    crates = ((26.5, 26.5, 2.0), (33.5, 36.5, 2.0), (38.5, 30.5, 2.0))

    def prepare(self, scene: Scene) -> Scene:
        return _scene(())

    def on_start(self) -> None:
        for place in self.crates:
            self.game.spawn("crate", place)


def pressed(rng: random.Random) -> Input:
    """Returns a random input."""
    held = {name: rng.random() < 0.3 for name in BUTTONS}
    walk = rng.choice(((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.5, -0.5), (-0.7, 0.7)))
    aim = (rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(0, 1)) if rng.random() < 0.5 else None
    bits = sum(1 << k for k, name in enumerate(BUTTONS) if held[name])
    return make_input(*walk, buttons=bits, aim=aim)


class Presser:
    """A policy that presses buttons at random, holds them for some ticks, and rests at times."""

    def __init__(self, most: int = 12) -> None:
        self._most, self._left, self._input = most, 0, Input()

    def __call__(self, core: Core, rng: random.Random) -> Input:
        return self.next(rng)

    def next(self, rng: random.Random) -> Input:
        """Returns the next input."""
        self._left -= 1
        if self._left < 0:
            self._left = rng.randrange(self._most)
            self._input = pressed(rng) if rng.random() < 0.8 else Input()
            if rng.random() < 0.1:
                self._left = 40
        return self._input


def populated(players: int = 3, *, compiled: bool | None = None, **changes: Any) -> tuple[World, list[int]]:
    """Returns a world of the scene with players and crates, and the players' numbers."""
    world = World(scene(**changes), compiled=compiled)
    world.load_terrain()
    for place in Playground.crates:
        world.spawn("crate", place)
    spots = [(16.0 + 3 * (k % 10), 16.0 + 3 * (k // 10), 3.0) for k in range(players)]
    return world, [world.spawn("player", spot) for spot in spots]
