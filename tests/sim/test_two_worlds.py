"""Two worlds that are told the same are the same, at every tick: in two processes, compiled and not, across copies."""

import hashlib
import random
import subprocess
import sys
from collections.abc import Iterator

from shared.inputs import Input
from shared.scene import load_scene
from shared.world import World

TICKS = 20_000
PLAYERS = 6


def start(compiled: bool) -> World:
    scene = load_scene("arena")
    world = World(scene, compiled=compiled)
    world.load_terrain()
    for place in scene.spawns[:PLAYERS]:
        world.spawn("player", place)
    return world


def inputs(seed: int) -> Iterator[dict[int, Input]]:
    """What six players press, tick by tick, some of the time into walls and into each other."""
    rng = random.Random(seed)
    while True:
        yield {
            entity: Input(rng.randint(-90, 90), rng.randint(-90, 90), rng.choice((0, 0, 1)))
            for entity in range(1, PLAYERS + 1)
            if rng.random() < 0.05
        }


def chain(compiled: bool, ticks: int) -> str:
    """The hash of the hashes of every tick."""
    world, total = start(compiled), hashlib.sha256()
    for _, wishes in zip(range(ticks), inputs(7), strict=False):
        world.step(wishes)
        total.update(world.state_hash())
    return total.hexdigest()


def test_two_processes_compiled_and_plain_agree_at_every_tick() -> None:
    script = f"from tests.sim.test_two_worlds import chain; print(chain(False, {TICKS}))"
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert chain(True, TICKS) == other.stdout.strip()


def test_a_copy_and_a_restored_world_go_on_alike() -> None:
    world, other = start(True), start(True)
    rng = random.Random(3)
    for tick, wishes in zip(range(TICKS), inputs(7), strict=False):
        if tick % 500 == 0:
            other = world.copy()
        elif rng.random() < 0.01:  # diverge, then come back
            other.step({1: Input(127, 0, 1), 2: Input(0, -127, 0)})
            other.step()
            other.restore(world)
        world.step(wishes)
        other.step(wishes)
        assert world.state_hash() == other.state_hash(), tick


def test_going_back_eight_ticks_every_tick_and_replaying_changes_nothing() -> None:
    world, restless = start(True), start(True)
    past: list[tuple[World, dict[int, Input]]] = []
    for tick, wishes in zip(range(3000), inputs(11), strict=False):
        past.append((restless.copy(), wishes))
        del past[:-8]
        restless.restore(past[0][0])
        for _, again in past:
            restless.step(again)
        world.step(wishes)
        assert world.state_hash() == restless.state_hash(), tick
