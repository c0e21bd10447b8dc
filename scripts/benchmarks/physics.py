"""The measurements of `bench.py physics`. Every function returns samples in seconds per unit, taken in turn."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from scripts.benchmarks import step_c
from scripts.benchmarks.crowds import Samples, crowd, hills, take_turns, wishes
from scripts.experiments.slabs import Slabs, boxes_on, dense_hits
from shared.scene import Scene, Template
from shared.units import SEGMENT
from shared.world import World

WALKERS = 10_000
TICKS = 2
"""Ticks per sample. A sample is short, so that most are not interrupted by other processes."""
ROUNDS_PER_WISH = 5

Found = tuple[Samples, dict[str, Any]]


def _run(world: World, ticks: int = TICKS) -> float:
    """Steps a world. Returns the number of entity-steps: one per tick and awake entity, none for a sleeping one."""
    turns = 0
    for _ in range(ticks):
        turns += world.awake_count
        world.step()
    return turns


def _run_in_c(world: World, ticks: int = TICKS) -> float:
    turns = world.awake_count * ticks
    step_c.run(world, ticks)
    return turns


def walk(rounds: int, *, pairs: bool) -> Found:
    """Measures 10,000 walkers on hills, all awake: the product and the same step in C. Compares their hashes."""
    ours = crowd(hills(pairs=pairs), WALKERS, compiled=True)
    worlds, work = [ours], {"ours": lambda: _run(ours)}
    if step_c.available():
        step_c.library()
        theirs = ours.copy()
        worlds.append(theirs)
        work["c"] = lambda: _run_in_c(theirs)

    def between(number: int) -> None:
        if number % ROUNDS_PER_WISH == 0:
            for world in worlds:
                world.step(wishes(world, number))

    samples = take_turns(work, rounds, between)
    return samples, {"hash_equal": len({world.state_hash() for world in worlds}) == 1, "c": len(worlds) == 2}


def rest(rounds: int) -> Samples:
    """Measures 10,000 sleeping entities: the time of a whole tick, divided by their number."""
    world = crowd(hills(), WALKERS, compiled=True)

    def tick() -> float:
        for _ in range(50):
            world.step()
        return 50.0 * WALKERS

    return take_turns({"rest": tick}, rounds)


def million(rounds: int, count: int = 1_000_000) -> Found:
    """Measures a million solid entities on 2 x 2 km of hills, one per cent of which walk, in seconds per tick."""
    start = time.perf_counter()
    world = crowd(hills(64), count, compiled=True)
    seconds = time.perf_counter() - start

    def tick() -> float:
        for _ in range(TICKS):
            world.step()
        return TICKS

    def between(number: int) -> None:
        if number % ROUNDS_PER_WISH == 0:
            world.step(wishes(world, number, 0.01))

    samples = take_turns({"million": tick}, rounds, between)
    return samples, {"spawn_s": seconds, "awake": world.awake_count, "entities": len(world)}


def scenes(rounds: int) -> Samples:
    """Measures 10,000 walkers on a plain, and how much each ability that a scene leaves out saves."""
    full = Scene("plain", size=(16, 16, 1))
    alone = replace(full, entity_collision=False)
    weightless = replace(alone, gravity=0.0)
    worlds = {"full": full, "no entity collision": alone, "and no gravity": weightless}
    crowds = {name: crowd(scene, WALKERS, compiled=True) for name, scene in worlds.items()}
    empty = crowd(replace(weightless, terrain={"generator": "boxes", "fill": []}), WALKERS, compiled=True)
    crowds["and no blocks"] = empty

    def between(number: int) -> None:
        if number % ROUNDS_PER_WISH == 0:
            for world in crowds.values():
                world.step(wishes(world, number))

    return take_turns({name: _task(world) for name, world in crowds.items()}, rounds, between)


def _task(world: World) -> Callable[[], float]:
    return lambda: _run(world)


def edits(rounds: int) -> Samples:
    """Measures setting a block in the air and below a sleeping entity, and filling a cube of 8 x 8 x 8 blocks."""
    world = crowd(hills(), WALKERS, compiled=True)
    x, y, z = (int(part // 1) for part in world.position(1))

    def one() -> float:
        for kind in (1, 0) * 50:
            world.set_block(300, 300, 30, kind)
        return 100

    def under() -> float:
        for kind in (0, 1) * 50:
            world.set_block(x, y, z - 1, kind)
        return 100

    def cube() -> float:
        for kind in (1, 0):
            world.fill((300, 300, 23), (308, 308, 31), kind)
        return 2 * 512

    return take_turns({"set_block": one, "set_block under a sleeper": under, "fill, per block": cube}, rounds)


def obstacles(rounds: int) -> Found:
    """Measures look-ups of solid blocks in a box, and edits: dense cells against greedily merged xy slabs."""
    world = crowd(hills(4), 4, compiled=True)
    slabs = Slabs.of(world.blocks)
    boxes = boxes_on(world, 20_000)
    layer = np.ascontiguousarray(world.blocks.segment((1, 1, 0))[12] != 0)
    answers = dense_hits(world, boxes), slabs.hits(boxes)

    def dense() -> float:
        dense_hits(world, boxes)
        return len(boxes)

    def merged() -> float:
        slabs.hits(boxes)
        return len(boxes)

    def dense_edit() -> float:
        for kind in (1, 0) * 50:
            world.blocks.set(40, 40, 30, kind)
        return 100

    def merged_edit() -> float:
        for _ in range(5):
            slabs.merge_layer(layer)
        return 5

    work = {"dense look-up": dense, "slab look-up": merged, "dense edit": dense_edit, "slab edit": merged_edit}
    return take_turns(work, rounds), {"same_answers": bool((answers[0] == answers[1]).all()), "slabs": len(slabs)}


def calls(rounds: int) -> Samples:
    """Measures a client's calls, with 50 players around it in 27 segments, and an entity-step without Numba."""
    scene = Scene("plain", size=(3, 3, 3), templates=(Template("player", walk_speed=3.0, jump_speed=8.0),))
    nine = replace(scene, size=(3, 3, 1))
    world, plain = crowd(nine, 50, compiled=True), crowd(nine, 50, compiled=False)
    above = [(i, j, k) for k in (1, 2) for j in range(3) for i in range(3)]
    world.load_terrain(above)
    one = crowd(nine, 1, compiled=True)
    twin = world.copy()
    input_, wish_one = wishes(world, 1), wishes(one, 1)

    def repeat(times: int, call: Callable[[], object]) -> Callable[[], float]:
        def task() -> float:
            for _ in range(times):
                call()
            return times

        return task

    def restore() -> None:
        world.step(input_)
        twin.restore(world)

    plain.step(wishes(plain, 1))
    work = {
        "step, 1 player and its input": repeat(100, lambda: one.step(wish_one)),
        "step, 50 players": repeat(100, world.step),
        "step, 50 players and their inputs": repeat(100, lambda: world.step(input_)),
        "the same, and restore of a copy": repeat(100, restore),
        "copy, 50 players in 27 segments": repeat(5, world.copy),
        "one turn without Numba": lambda: _run(plain, 1),
    }
    assert len(world.blocks.rows) == 27
    assert SEGMENT == 32
    return take_turns(work, rounds)
