"""Two worlds with the same inputs are equal at every tick: in two processes, compiled and plain, and after copies."""

import random
from collections.abc import Iterator

import pytest

from shared import kernels
from shared.inputs import Input
from shared.scene import load_scene
from shared.world import World
from tests.kernels import chains
from tests.lengths import contained, long

TICKS = chains.TICKS
PLAYERS = 6


def start(compiled: bool) -> World:
    scene = load_scene("arena")
    world = World(scene, compiled=compiled)
    world.load_terrain()
    for place in scene.spawns[:PLAYERS]:
        world.spawn("player", place)
    return world


def inputs(seed: int) -> Iterator[dict[int, Input]]:
    """Yields the inputs of six players for each tick; some of the time they walk into walls and into each other."""
    rng = random.Random(seed)
    while True:
        yield {
            entity: Input(rng.randint(-90, 90), rng.randint(-90, 90), rng.choice((0, 0, 1)))
            for entity in range(1, PLAYERS + 1)
            if rng.random() < 0.05
        }


@pytest.mark.parametrize(
    ("scene", "ticks"), [*contained((chains.SCENES[0], 2_000)), *long(*((scene, TICKS) for scene in chains.SCENES))]
)
def test_two_processes_compiled_and_plain_agree_at_every_tick(scene: str, ticks: int) -> None:
    other = chains.elsewhere(scene, ticks, kernels.PLAIN)
    assert f"{kernels.PLAIN} {chains.chain(scene, ticks, compiled=True)}" == other


@pytest.mark.parametrize("ticks", [*contained(2_000), *long(TICKS)])
def test_a_copy_and_a_restored_world_go_on_alike(ticks: int) -> None:
    world, other = start(True), start(True)
    rng = random.Random(3)
    for tick, wishes in zip(range(ticks), inputs(7), strict=False):
        if tick % 500 == 0:
            other = world.copy()
        elif rng.random() < 0.01:  # diverge, then come back
            other.step({1: Input(127, 0, 1), 2: Input(0, -127, 0)})
            other.step()
            other.restore(world)
        world.step(wishes)
        other.step(wishes)
        assert world.state_hash() == other.state_hash(), tick


@pytest.mark.parametrize("ticks", [*contained(800), *long(3_000)])
def test_going_back_eight_ticks_every_tick_and_replaying_changes_nothing(ticks: int) -> None:
    world, restless = start(True), start(True)
    past: list[tuple[World, dict[int, Input]]] = []
    for tick, wishes in zip(range(ticks), inputs(11), strict=False):
        past.append((restless.copy(), wishes))
        del past[:-8]
        restless.restore(past[0][0])
        for _, again in past:
            restless.step(again)
        world.step(wishes)
        assert world.state_hash() == restless.state_hash(), tick
