"""The measurements of the accuracy report for one engine. Every figure of the table is measured, none is a constant."""

import statistics
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from scripts.experiments import variants
from scripts.experiments.engines import (
    GRAVITY,
    JUMP_SPEED,
    LOW,
    SIDES,
    WALK,
    Choice,
    Engine,
    Floats,
    Kinds,
    engine,
    slabs_of,
)
from shared.inputs import MOVE_MAX
from shared.terrain import generate

Bools = npt.NDArray[np.bool_]
Moves = npt.NDArray[np.int64]

FLOOR = 8
FAR = (1_000_000, 10_000_000)
"""Distances from the origin in blocks: whole segments, so that the same map lies there."""


def plain(length: int = 256) -> Kinds:
    """Returns a map with a floor at z = 8, 32 blocks wide."""
    kinds = np.zeros((32, 32, length), np.uint8)
    kinds[:FLOOR] = 1
    return kinds


def walled(apart: int = 4, length: int = 128) -> Kinds:
    """Returns the map of `plain` with walls across it, one block thick."""
    kinds = plain(length)
    kinds[FLOOR : FLOOR + 4, :, ::apart] = 1
    return kinds


def ground() -> Kinds:
    """Returns a map of 64 x 64 blocks of the hills, with a few pillars for their corners."""
    kinds = np.zeros((32, 64, 64), np.uint8)
    for j in (0, 1):
        for i in (0, 1):
            part = generate({"generator": "hills", "seed": 1, "relief": 6}, (i, j, 0)).reshape(32, 32, 32)
            kinds[:, j * 32 : j * 32 + 32, i * 32 : i * 32 + 32] = part
    kinds[:28, 5::9, 7::11] = 1
    return kinds


def _nothing() -> None:
    pass


def spots(kinds: Kinds, count: int) -> Floats:
    """Returns positions on the ground of a map, in the middle of columns, the same for every engine."""
    rng = np.random.default_rng(5)
    x = rng.integers(1, kinds.shape[2] - 1, count)
    y = rng.integers(1, kinds.shape[1] - 1, count)
    return np.column_stack((x + 0.5, y + 0.5, (kinds != 0).sum(axis=0)[y, x]))


def play(machines: list[Engine], count: int, ticks: int, each: Callable[[], None], *, jumps: bool = True) -> None:
    """Steps all machines with the same inputs. Each player walks in a new direction about every half second.

    Args:
        each: called after every step.
        jumps: whether players jump, too.
    """
    rng = np.random.default_rng(11)
    moves, hops = np.zeros((count, 2), np.int64), np.zeros(count, np.bool_)
    for tick in range(ticks):
        if tick % 16 == 0:
            angles = rng.uniform(0, 2 * np.pi, count)
            moves = (MOVE_MAX * np.column_stack((np.cos(angles), np.sin(angles)))).astype(np.int64)
            hops = rng.random(count) < (0.3 if jumps else 0.0)
        for machine in machines:
            machine.wish(moves, hops)
            machine.step()
        each()


def jump(choice: Choice) -> tuple[float, float]:
    """Returns a jump's errors against the closed form at the same ticks: the apex in blocks, the landing in ms."""
    it = engine(choice, plain(64), np.array([[32.5, 16.5, FLOOR]]))
    none = np.zeros((1, 2), np.int64)
    for _ in range(3):
        it.step()
    h = 1 / choice.tick_rate
    heights, closed = [], []
    for tick in range(1, 2 * choice.tick_rate):
        it.wish(none, np.array([tick == 1]))
        it.step()
        heights.append(it.places()[0, 2] - FLOOR)
        closed.append(JUMP_SPEED * tick * h - GRAVITY * (tick * h) ** 2 / 2)
    landed = next((tick for tick, height in enumerate(heights[1:], 2) if height <= 0), len(heights))
    ideal = next(tick for tick, height in enumerate(closed[1:], 2) if height <= 0)
    return max(heights) - max(closed), (landed - ideal) * h * 1e3


def minute(choice: Choice) -> float:
    """Returns the worst error of a position, in blocks, after a minute of walking and jumping on a plain."""
    moves = np.array([[127, 0], [101, 53], [-88, 12], [-127, 0], [60, 0], [-17, 1]])
    starts = np.array([[8.5 if x > 0 else 247.5, 2.5, FLOOR] for x, _ in moves.tolist()])
    moves[:, 1] = 0  # along the plain, however wide it is
    it = engine(choice, plain(), starts)
    it.step()
    start = it.places()
    for tick in range(60 * choice.tick_rate):
        it.wish(moves, np.full(len(moves), tick % choice.tick_rate == 0))
        it.step()
    gone = it.places()[:, 0] - start[:, 0]
    return float(np.abs(gone - moves[:, 0] * (60 * WALK / MOVE_MAX)).max())


def inside(choice: Choice, count: int, ticks: int) -> tuple[float, float]:
    """Returns the share of samples inside a block, and the greatest depth in blocks."""
    kinds = ground()
    it = engine(choice, kinds, spots(kinds, count))
    rectangles, starts = slabs_of(kinds)
    terrain = (kinds, rectangles, starts, np.zeros(3, np.int64))
    found: list[Floats] = []

    def look() -> None:
        depths = np.zeros(count)
        low, high = it.boxes()
        variants.depths(terrain, low, high, depths)
        found.append(depths)

    play([it], count, ticks, look)
    depths = np.concatenate(found)
    return float((depths > 0).mean()), float(depths.max())


def along_walls(choice: Choice) -> float:
    """Returns the share of the motion along a wall that is lost by pressing into it at 45 degrees, over many walls."""
    kinds = walled()
    faces = np.arange(4, 124, 4)
    east = faces - LOW[0] - SIDES[0] - 0.25
    west = faces + 1 - LOW[0] + 0.25
    starts = np.array([[x, 2.5, FLOOR] for x in np.concatenate((east, west))])
    it = engine(choice, kinds, starts)
    it.step()
    before = it.places()
    push = np.repeat([[90, 90], [-90, 90]], len(faces), axis=0)
    it.wish(push, np.zeros(len(push), np.bool_))
    ticks = 4 * choice.tick_rate
    for _ in range(ticks):
        it.step()
    gone = it.places()[:, 1] - before[:, 1]
    return float(1 - gone.mean() / (90 * WALK / MOVE_MAX * ticks / choice.tick_rate))


def far(choice: Choice, count: int, ticks: int) -> list[float]:
    """Returns the greatest change of a final position, in blocks, if the world is 10^6 or 10^7 blocks further east."""
    kinds = ground()
    here = spots(kinds, count)
    machines = [engine(choice, kinds, here, shift) for shift in (0, *FAR)]
    play(machines, count, ticks, _nothing)
    near, *others = (machine.places() for machine in machines)
    return [float(np.abs(other - near).max()) for other in others]


def corrections(choice: Choice, count: int, ticks: int) -> float:
    """Returns the number of corrections per player and minute: two machines differ in a bit, and one is corrected."""
    kinds = ground()
    here = spots(kinds, count)
    machines = [engine(choice, kinds, here), engine(choice, kinds, here, fast=True)]
    total = 0

    def compare() -> None:
        nonlocal total
        server, client = machines
        differ = (server.state() != client.state()).any(axis=1)
        if differ.any():
            client.correct(differ, server)
            total += int(differ.sum())

    play(machines, count, ticks, compare)
    return total / (count * ticks / choice.tick_rate / 60)


def ns(choices: list[Choice], count: int, rounds: int, ticks: int = 2) -> list[list[float]]:
    """Returns samples of each choice in ns per entity-step, taken in turn; short ones, so that few are interrupted."""
    kinds = ground()
    here = spots(kinds, count)
    machines = [
        engine(choice, kinds, here if choice.executor == "compiled" else here[: count // 20]) for choice in choices
    ]
    samples: list[list[float]] = [[] for _ in machines]
    rng = np.random.default_rng(7)
    for _ in range(rounds):
        moves = rng.integers(-90, 91, (count, 2))
        for machine, found in zip(machines, samples, strict=True):
            n = len(machine.places())
            machine.wish(moves[:n], np.zeros(n, np.bool_))
            for _ in range(3):
                machine.step()
            start = time.perf_counter()
            for _ in range(ticks):
                machine.step()
            found.append((time.perf_counter() - start) / ticks / n * 1e9)
    return samples


def measure(choice: Choice, *, quick: bool) -> dict[str, float]:
    """Returns all columns of a row except for the time."""
    count, seconds = (48, 4) if quick else (400, 30)
    ticks = seconds * choice.tick_rate
    if choice.executor == "plain":
        count, ticks = 8, ticks // (2 if quick else 4)
    apex, landing = jump(choice)
    share, depth = inside(choice, count, ticks)
    at_1e6, at_1e7 = far(choice, min(count, 64), ticks // 2)
    return {
        "apex_error": apex,
        "landing_error_ms": landing,
        "minute_error": minute(choice),
        "inside_share": share,
        "inside_depth": depth,
        "tangential_lost": along_walls(choice),
        "error_1e6": at_1e6,
        "error_1e7": at_1e7,
        "corrections_per_minute": corrections(choice, min(count, 16), ticks),
    }


def middle(values: list[float]) -> float:
    return statistics.median(values)
