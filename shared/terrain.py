"""Terrain generators: the blocks of a segment before any edit, computed from the scene and the segment's index."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shared.blocks import Kinds
from shared.checks import Cell, SceneError, whole
from shared.units import SEGMENT

PARAMETER_MAX = 1 << 31
"""Greatest value of a generator's parameter, and the least one with a minus."""
STONE, SOIL, GRASS, WALL = 1, 2, 3, 4
"""Kinds of blocks that generators and built-in scenes use."""

Ints = npt.NDArray[np.int64]
Generator = Callable[..., Kinds]
"""A function of a segment's index and parameters that returns kinds of blocks, [z, y, x]."""


def generate(terrain: Mapping[str, Any], segment: Cell) -> Kinds:
    """Returns the [32768] kinds of blocks of a segment, by index z << 10 | y << 5 | x.

    Args:
        terrain: name of the generator under "generator", and its parameters (`Scene.terrain`).
        segment: index of the segment.

    Raises:
        SceneError: there is no such generator, or a parameter is unknown or not valid.
    """
    name = terrain["generator"]
    if name not in GENERATORS:
        raise SceneError(f"terrain.generator = {name!r}: no such generator (there are {', '.join(GENERATORS)})")
    parameters = {key: value for key, value in terrain.items() if key != "generator"}
    for key in parameters.keys() - {"fill"}:
        whole(parameters[key], f"terrain.{key}", 1 if key == "scale" else -PARAMETER_MAX, PARAMETER_MAX)
    try:
        return np.ascontiguousarray(GENERATORS[name](segment, **parameters)).reshape(-1)
    except (TypeError, ValueError) as error:
        raise SceneError(f"terrain: {error}") from error


def flat(segment: Cell, height: int = 8) -> Kinds:
    """Returns flat ground whose top is at z = `height`."""
    columns = np.full((SEGMENT, SEGMENT), height)
    return _ground(segment, columns)


def hills(segment: Cell, seed: int = 1, base: int = 12, relief: int = 10, scale: int = 24) -> Kinds:
    """Returns rolling ground: two octaves of value noise in whole numbers, equal on every machine.

    Args:
        segment: index of the segment.
        seed: seed of the noise.
        base: mean height of the ground, in blocks.
        relief: greatest height above and below `base`, in blocks.
        scale: distance between two points of the coarse noise, in blocks.
    """
    x, y = _columns(segment)
    height = base * 4096 + relief * (3 * _noise(x, y, scale, seed) + _noise(x, y, max(scale // 4, 1), seed + 1)) // 4
    return _ground(segment, height >> 12)


def boxes(segment: Cell, fill: list[list[int]]) -> Kinds:
    """Returns air with boxes of blocks in it; a later box overwrites an earlier one.

    Args:
        segment: index of the segment.
        fill: a list of [x0, y0, z0, x1, y1, z1, kind]: lower corner, upper corner (excluded), kind of the blocks.

    Raises:
        SceneError: an entry of `fill` is something else.
    """
    kinds = np.zeros((SEGMENT, SEGMENT, SEGMENT), np.uint8)
    for number, entry in enumerate(fill):
        if len(entry) != 7 or not all(type(part) is int for part in entry) or not 0 <= entry[6] <= 255:
            raise SceneError(
                f"terrain.fill[{number}] = {entry!r}: must be [x0, y0, z0, x1, y1, z1, kind], whole numbers"
            )
        low, high = entry[:3], entry[3:6]
        spans = [
            slice(max(a - k * SEGMENT, 0), max(b - k * SEGMENT, 0)) for a, b, k in zip(low, high, segment, strict=True)
        ]
        kinds[spans[2], spans[1], spans[0]] = entry[6]
    return kinds


GENERATORS: dict[str, Generator] = {"flat": flat, "hills": hills, "boxes": boxes}
"""Generators by name."""


def _columns(segment: Cell) -> tuple[Ints, Ints]:
    """Returns x and y in the world of every column of a segment, each [y, x], in blocks."""
    at = np.arange(SEGMENT, dtype=np.int64)
    x, y = np.meshgrid(at + segment[0] * SEGMENT, at + segment[1] * SEGMENT)
    return x, y


def _ground(segment: Cell, height: Ints) -> Kinds:
    """Returns ground with grass on top, two blocks of soil below it, and stone below the soil.

    Args:
        segment: index of the segment.
        height: z of the surface of every column, [y, x], in blocks.
    """
    z = np.arange(SEGMENT)[:, None, None] + segment[2] * SEGMENT
    depth = height[None] - z
    return np.select([depth <= 0, depth == 1, depth <= 3], [0, GRASS, SOIL], STONE).astype(np.uint8)


def _noise(x: Ints, y: Ints, scale: int, seed: int) -> Ints:
    """Returns value noise in -4096..4096, smooth between lattice points that are `scale` blocks apart."""
    i, j = x // scale, y // scale
    # Position within the lattice square, in 1/4096, smoothed by t^2 (3 - 2t).
    u, v = _eased(x % scale, scale), _eased(y % scale, scale)
    south = _lattice(i, j, seed) * (4096 - u) + _lattice(i + 1, j, seed) * u
    north = _lattice(i, j + 1, seed) * (4096 - u) + _lattice(i + 1, j + 1, seed) * u
    return ((south >> 12) * (4096 - v) + (north >> 12) * v) >> 12


def _eased(t: Ints, scale: int) -> Ints:
    t = (t << 12) // scale
    return (t * t >> 12) * (3 * 4096 - 2 * t) >> 12


def _lattice(i: Ints, j: Ints, seed: int) -> Ints:
    """Returns a pseudo-random number in -4096..4096 for each lattice point."""
    h = (i * 374761393 + j * 668265263 + seed * 2147483647) & 0xFFFFFFFF
    h = (h ^ (h >> 13)) * 1274126177 & 0xFFFFFFFF
    return (h ^ (h >> 16)) % 8193 - 4096
