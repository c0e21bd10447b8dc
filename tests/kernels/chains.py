"""Long runs of one world whose states all go into one hash: `python -m tests.kernels.chains SCENE TICKS`."""

import hashlib
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from shared import kernels
from shared.inputs import Input
from shared.scene import load_scene
from shared.units import SEGMENT
from shared.world import OverlapError, World

ROOT = Path(__file__).parent.parent.parent
TICKS = 7_000
SCENES = ("arena", "hills", "topdown")
PLAYERS = 6


def chain(scene_name: str, ticks: int, *, compiled: bool) -> str:
    """Returns the hash of the states of every tick, and of all blocks at the end."""
    scene = load_scene(scene_name)
    world, total, rng = World(scene, compiled=compiled), hashlib.sha256(), random.Random(7)
    world.load_terrain()
    players = list(_players(world, rng))
    for tick in range(ticks):
        wishes = {
            entity: Input(rng.randint(-127, 127), rng.randint(-127, 127), rng.choice((0, 0, 1)))
            for entity in players
            if rng.random() < 0.05
        }
        world.step(wishes)
        total.update(world.states().tobytes())
        for entity in world.fell:
            world.place(entity, scene.spawns[0], push=True)
        if tick % 50 == 0:
            _dig(world, rng.choice(players), rng)
    total.update(world.state_hash())
    return total.hexdigest()


def elsewhere(scene_name: str, ticks: int, form: str, **environment: str) -> str:
    """Returns the form of the kernel in another process, and the hash of the same run there."""
    command = (sys.executable, "-m", "tests.kernels.chains", scene_name, str(ticks))
    variables = os.environ | {kernels.VARIABLE: form} | environment
    return subprocess.run(command, cwd=ROOT, env=variables, capture_output=True, text=True, check=True).stdout.strip()


def _players(world: World, rng: random.Random) -> Iterator[int]:
    """Yields players at the spawn points, and near them."""
    scene = world.scene
    while len(world) < PLAYERS:
        x, y, z = rng.choice(scene.spawns)
        near = (x + rng.uniform(-6, 6), y + rng.uniform(-6, 6), z + rng.uniform(0, 3))
        try:
            yield world.spawn(scene.player, near, push=True)
        except OverlapError:
            continue


def _dig(world: World, entity: int, rng: random.Random) -> None:
    """Removes or places a block near a player."""
    x, y, z = (int(part // 1) + rng.randint(-2, 2) for part in world.position(entity))
    if (x // SEGMENT, y // SEGMENT, z // SEGMENT) in world.blocks:
        try:
            world.set_block(x, y, z, 0 if world.blocks.get(x, y, z) else 1)
        except OverlapError:
            return


if __name__ == "__main__":
    print(kernels.get().form, chain(sys.argv[1], int(sys.argv[2]), compiled=kernels.get().compiled))
