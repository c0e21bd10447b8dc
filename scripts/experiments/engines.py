"""The engines of the accuracy report: the product's world and the variants behind one interface."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from scripts.experiments import variants
from scripts.experiments.slabs import Slabs
from shared.inputs import JUMP, MOVE_MAX, Input
from shared.jit import second_instance
from shared.layout import FLAGS, MOVE_X, VX, X
from shared.scene import Scene
from shared.units import BLOCK, SEGMENT, SPEED, rounded
from shared.world import World

Floats = npt.NDArray[np.float64]
Kinds = npt.NDArray[np.uint8]
Moves = npt.NDArray[np.int64]

GRAVITY, TERMINAL, JUMP_SPEED, WALK = 18.0, 16.0, 8.0, 3.0
LOW = np.array([-0.3, -0.3, 0.0])
SIDES = np.array([0.6, 0.6, 1.8])

FORMATS = {"float32": (np.float32, 0), "float64": (np.float64, 0)} | {
    f"grid 2^-{bits}": (np.float64, bits) for bits in (16, 20, 24)
}
INTEGRATORS = {"semi": variants.SEMI, "explicit": variants.EXPLICIT, "mean": variants.MEAN}
MOVERS = {"clamp": variants.CLAMP, "rewind": variants.REWIND, "impact": variants.IMPACT}
OBSTACLES = {"cells": variants.CELLS, "slabs": variants.SLABS}


@dataclass(frozen=True)
class Choice:
    """The choices of one row. The defaults are those of the product."""

    format: str = "grid 2^-24"
    integrator: str = "mean"
    tick_rate: int = 32
    mover: str = "clamp"
    obstacles: str = "cells"
    executor: str = "compiled"
    product: bool = False


class Engine(Protocol):
    """Some players, each of whom meets only blocks, and no other player."""

    def wish(self, moves: Moves, jumps: npt.NDArray[np.bool_]) -> None:
        """Sets the inputs from now on: [n, 2] directions of -127..127, and [n] whether to jump."""

    def step(self) -> None: ...

    def places(self) -> Floats:
        """Returns the positions [n, 3], in blocks from the corner of the map."""

    def boxes(self) -> tuple[Floats, Floats]:
        """Returns the low and high corners of the boxes as the engine itself computes them, [n, 3] in blocks."""

    def state(self) -> npt.NDArray[Any]:
        """Returns the state [n, m] that must be equal on another machine, bit for bit."""

    def correct(self, rows: npt.NDArray[np.bool_], other: "Engine") -> None:
        """Copies the state of these rows from another engine of the same kind."""


class Variant:
    """An engine of `variants`. `fast` selects the build that stands for another machine."""

    def __init__(self, choice: Choice, kinds: Kinds, spots: Floats, shift: int = 0, *, fast: bool = False) -> None:
        self._module = _fast() if fast else variants
        self._type, bits = FORMATS[choice.format]
        grid = SPEED if bits else 0
        self._shift = np.array([shift, 0, 0])
        origin = self._shift.astype(np.int64)
        rectangles, starts = slabs_of(kinds)
        self.terrain = (kinds, rectangles, starts, origin)
        f = np.zeros(variants.NUMBERS)
        f[variants.GRAVITY] = _on(GRAVITY / choice.tick_rate, grid)
        f[variants.TERMINAL], f[variants.JUMP] = TERMINAL, JUMP_SPEED
        f[variants.STEP], f[variants.HALF], f[variants.SCALE] = 1 / choice.tick_rate, 0.5, 2.0**bits if bits else 0
        f[variants.LO : variants.LO + 3] = [_on(part, 2.0**bits if bits else 0) for part in LOW]
        f[variants.SIZE : variants.SIZE + 3] = [_on(part, 2.0**bits if bits else 0) for part in SIDES]
        self._f = f.astype(self._type)
        self._walk = np.array([_on(WALK * move / MOVE_MAX, grid) for move in range(-MOVE_MAX, MOVE_MAX + 1)])
        self._switches = np.array(
            [INTEGRATORS[choice.integrator], MOVERS[choice.mover], OBSTACLES[choice.obstacles]], np.int64
        )
        quantised = np.round(spots * 2.0**bits) / 2.0**bits if bits else spots
        self._places = (quantised + self._shift).astype(self._type)
        self._speeds = np.zeros_like(self._places)
        self._falling = np.ones(len(spots), np.bool_)
        self._hit, self._scratch = np.zeros(3, np.bool_), np.zeros((6, 3), self._type)
        self.wish(np.zeros((len(spots), 2), np.int64), np.zeros(len(spots), np.bool_))

    def wish(self, moves: Moves, jumps: npt.NDArray[np.bool_]) -> None:
        self._wishes = self._walk[moves + MOVE_MAX].astype(self._type)
        self._jumps = jumps

    def step(self) -> None:
        self._module.step(
            self.terrain, self._f, self._switches, self._places, self._speeds, self._falling, self._wishes, self._jumps,
            self._hit, self._scratch,
        )  # fmt: skip

    def places(self) -> Floats:
        places: Floats = self._places.astype(np.float64) - self._shift
        return places

    def boxes(self) -> tuple[Floats, Floats]:
        low = self._places + self._f[variants.LO : variants.LO + 3]
        high = low + self._f[variants.SIZE : variants.SIZE + 3]
        return low.astype(np.float64), high.astype(np.float64)

    def state(self) -> npt.NDArray[Any]:
        return np.hstack((self._places, self._speeds))

    def correct(self, rows: npt.NDArray[np.bool_], other: Engine) -> None:
        assert isinstance(other, Variant)
        self._places[rows], self._speeds[rows] = other._places[rows], other._speeds[rows]
        self._falling[rows] = other._falling[rows]


class Product:
    """The product's own world. `fast` selects the other executor, which stands for another machine."""

    def __init__(self, choice: Choice, kinds: Kinds, spots: Floats, shift: int = 0, *, fast: bool = False) -> None:
        compiled = (choice.executor == "compiled") != fast
        nz, ny, nx = (side // SEGMENT for side in kinds.shape)
        at = shift // SEGMENT
        scene = Scene(
            "report",
            tick_rate=choice.tick_rate,
            integrator=choice.integrator,
            entity_collision=False,
            origin=(at, 0, 0),
            size=(nx, ny, nz),
            gravity=GRAVITY,
            terminal_speed=TERMINAL,
        )
        self.world = World(scene, compiled=compiled)
        for i, j, k in np.ndindex(nx, ny, nz):
            part = kinds[k * 32 : k * 32 + 32, j * 32 : j * 32 + 32, i * 32 : i * 32 + 32]
            self.world.load_segment((at + i, j, k), np.ascontiguousarray(part).reshape(-1))
        self._shift = np.array([shift * BLOCK, 0, 0])
        self._ids = list(self.world.spawn_many("player", spots + np.array([shift, 0, 0])))
        self._inputs: dict[int, Input] = {}

    def wish(self, moves: Moves, jumps: npt.NDArray[np.bool_]) -> None:
        buttons = np.where(jumps, JUMP, 0).tolist()
        self._inputs = {
            entity: Input(x, y, button)
            for entity, (x, y), button in zip(self._ids, moves.tolist(), buttons, strict=True)
        }

    def step(self) -> None:
        self.world.step(self._inputs)
        self._inputs = {}

    def places(self) -> Floats:
        places: Floats = (self.world.states()[:, X : X + 3] - self._shift) / BLOCK
        return places

    def boxes(self) -> tuple[Floats, Floats]:
        template = self.world.scene.templates[0].row()
        low = self.world.states()[:, X : X + 3] + np.array(template[:3])
        return low / BLOCK, (low + np.array(template[3:6])) / BLOCK

    def state(self) -> npt.NDArray[Any]:
        states = self.world.states()
        states[:, MOVE_X:] = 0  # inputs are sent, not computed
        return states[:, FLAGS : VX + 3]

    def correct(self, rows: npt.NDArray[np.bool_], other: Engine) -> None:
        assert isinstance(other, Product)
        self.world.put(other.world.states()[rows])


def engine(choice: Choice, kinds: Kinds, spots: Floats, shift: int = 0, *, fast: bool = False) -> Engine:
    kind = Product if choice.product else Variant
    return kind(choice, kinds, spots, shift, fast=fast)


def slabs_of(kinds: Kinds) -> tuple[Moves, Moves]:
    """Merges a map [z, y, x]. Returns the slabs [n, 4] in cells, and where each layer of each segment starts."""
    return Slabs.merged(kinds != 0)


def _on(value: float, scale: float) -> float:
    """Returns `value` rounded to whole steps of 1 / scale; unchanged if `scale` is 0."""
    return rounded(value * scale) / scale if scale else value


@cache
def _fast() -> ModuleType:
    return second_instance(Path(variants.__file__), "scripts.experiments.variants_fast")
