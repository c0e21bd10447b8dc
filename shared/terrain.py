"""What the ground is made of before anyone edits it: pure functions of the scene and the segment."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shared.blocks import Kinds
from shared.checks import Cell, SceneError, whole
from shared.units import SEGMENT

PARAMETER_MAX = 1 << 31
STONE, SOIL, GRASS, WALL = 1, 2, 3, 4

Ints = npt.NDArray[np.int64]
Generator = Callable[..., Kinds]


def generate(terrain: Mapping[str, Any], segment: Cell) -> Kinds:
    """[32768] block kinds of one segment, index z << 10 | y << 5 | x.

    Raises:
        SceneError: no such generator, or a parameter it does not take.
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
    """Solid ground whose top is at z = `height`."""
    columns = np.full((SEGMENT, SEGMENT), height)
    return _ground(segment, columns)


def hills(segment: Cell, seed: int = 1, base: int = 12, relief: int = 10, scale: int = 24) -> Kinds:
    """Rolling ground: two octaves of value noise in whole numbers, the same on every machine."""
    x, y = _columns(segment)
    height = base * 4096 + relief * (3 * _noise(x, y, scale, seed) + _noise(x, y, max(scale // 4, 1), seed + 1)) // 4
    return _ground(segment, height >> 12)


def boxes(segment: Cell, fill: list[list[int]]) -> Kinds:
    """Boxes of one kind, later ones over earlier ones: `fill` lists [x0, y0, z0, x1, y1, z1, kind], upper corners
    excluded.

    Raises:
        SceneError: an entry is something else.
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


def _columns(segment: Cell) -> tuple[Ints, Ints]:
    """World x and y of every column of a segment, [y, x]."""
    at = np.arange(SEGMENT, dtype=np.int64)
    x, y = np.meshgrid(at + segment[0] * SEGMENT, at + segment[1] * SEGMENT)
    return x, y


def _ground(segment: Cell, height: Ints) -> Kinds:
    """Stone, two blocks of soil, grass on top; `height` [y, x] is the z of the surface."""
    z = np.arange(SEGMENT)[:, None, None] + segment[2] * SEGMENT
    depth = height[None] - z
    return np.select([depth <= 0, depth == 1, depth <= 3], [0, GRASS, SOIL], STONE).astype(np.uint8)


def _noise(x: Ints, y: Ints, scale: int, seed: int) -> Ints:
    """Value noise in -4096..4096, smooth between lattice points `scale` blocks apart."""
    i, j = x // scale, y // scale
    # Position within the lattice square in 1/4096, eased by t^2 (3 - 2t).
    u, v = _eased(x % scale, scale), _eased(y % scale, scale)
    south = _lattice(i, j, seed) * (4096 - u) + _lattice(i + 1, j, seed) * u
    north = _lattice(i, j + 1, seed) * (4096 - u) + _lattice(i + 1, j + 1, seed) * u
    return ((south >> 12) * (4096 - v) + (north >> 12) * v) >> 12


def _eased(t: Ints, scale: int) -> Ints:
    t = (t << 12) // scale
    return (t * t >> 12) * (3 * 4096 - 2 * t) >> 12


def _lattice(i: Ints, j: Ints, seed: int) -> Ints:
    """A number in -4096..4096 for each lattice point."""
    h = (i * 374761393 + j * 668265263 + seed * 2147483647) & 0xFFFFFFFF
    h = (h ^ (h >> 13)) * 1274126177 & 0xFFFFFFFF
    return (h ^ (h >> 16)) % 8193 - 4096
