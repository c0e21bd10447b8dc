"""Worlds with many walkers for the benchmarks, and a timer that measures pieces of work in turn."""

import dataclasses
import gc
import time
from collections.abc import Callable, Mapping

import numpy as np

from shared.inputs import Input, make_input
from shared.scene import Scene, load_scene
from shared.units import SEGMENT
from shared.world import World

Samples = dict[str, list[float]]


def hills(segments: int = 16, *, pairs: bool = True) -> Scene:
    """Returns a scene of hills with `segments` segments along each side."""
    return dataclasses.replace(load_scene("hills"), size=(segments, segments, 1), entity_collision=pairs)


def crowd(scene: Scene, count: int, *, compiled: bool | None = None) -> World:
    """Returns a world with `count` players on a square grid on its ground, all at rest."""
    world = World(scene, compiled=compiled)
    world.load_terrain()
    side = int(np.ceil(np.sqrt(count)))
    spacing = scene.size[0] * SEGMENT / side
    at = np.floor(np.arange(side) * spacing + spacing / 2)
    x, y = (part.reshape(-1)[:count] for part in np.meshgrid(at, at))
    spots = np.column_stack((x + 0.5, y + 0.5, _heights(world)[y.astype(int), x.astype(int)]))
    world.spawn_many(scene.player, spots)
    for _ in range(3):
        world.step()
    assert world.awake_count == 0
    return world


def wishes(world: World, seed: int, share: float = 1.0) -> dict[int, Input]:
    """Returns random inputs for the first `share` of the entities. A world keeps an input until the next one."""
    ids = sorted(world.states()[:, 0].tolist())
    moves = np.random.default_rng(seed).uniform(-1, 1, (round(share * len(ids)), 2)).tolist()
    return {entity: make_input(x, y) for entity, (x, y) in zip(ids, moves, strict=False)}


def take_turns(
    work: Mapping[str, Callable[[], float]], rounds: int, between: Callable[[int], None] | None = None
) -> Samples:
    """Times each piece of work once per round, in turn. Returns samples in seconds per unit.

    A disturbance of the machine affects all pieces alike, so ratios hold.

    Args:
        work: functions by name, each of which returns the number of units that it did.
        between: called with the number of the round before each round.
    """
    samples: Samples = {name: [] for name in work}
    gc.collect()
    gc.disable()
    try:
        for number in range(rounds):
            if between is not None:
                between(number)
            for name, task in work.items():
                task()  # warms the caches, which the other pieces have used meanwhile
                start = time.perf_counter()
                units = task()
                samples[name].append((time.perf_counter() - start) / units)
    finally:
        gc.enable()
    return samples


def _heights(world: World) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Returns the z of the ground in every column of a world that is one segment high, [y, x]."""
    nx, ny, _ = world.scene.size
    heights = np.zeros((ny * SEGMENT, nx * SEGMENT))
    for i, j, k in world.blocks:
        ground = (world.blocks.segment((i, j, k)) != 0).sum(axis=0)
        heights[j * SEGMENT : (j + 1) * SEGMENT, i * SEGMENT : (i + 1) * SEGMENT] = ground + k * SEGMENT
    return heights
