"""The view of the blocks, from the south-east and above: projection, and a cached picture of each segment.

    screen x = (x + y) * HALF            north-west is up, north-east is right
    screen y = (x - y) * QUARTER - z * RISE

A picture is drawn again when its blocks, or the blocks that cast shadows on them, have changed. The faces of each block
are kept beside the picture, so that a block can be drawn again over a figure that stands behind it.
"""

import zlib
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pygame

from shared.blocks import AIR, Blocks
from shared.checks import Cell
from shared.terrain import GRASS, SOIL, STONE, WALL
from shared.units import SEGMENT
from sovereign_netcode.examples.tag import LEAVES, TRUNK

HALF, QUARTER, RISE = 24, 12, 26
"""Half the width and half the height of a block's top, and the height of its sides, in pixels."""
AROUND = 6
"""Distance up to which blocks outside a segment cast shadows on it, in blocks."""
SUN = [(round(-0.45 * step), round(-0.21 * step), round(0.6 * step)) for step in range(1, 11)]
"""Offsets from a block towards the sun, within `AROUND`. A block at one of them casts its shadow on the first."""
SKY = (1, 2, 3)
"""Transparent colour of the pictures."""

Colour = tuple[int, int, int]
Point = tuple[float, float]
Bytes = npt.NDArray[np.uint8]

PALETTE: dict[int, Colour] = {
    STONE: (132, 138, 150), SOIL: (156, 116, 80), GRASS: (128, 190, 92), WALL: (206, 192, 168),
    TRUNK: (124, 90, 62), LEAVES: (78, 152, 88),
}  # fmt: skip
CHOICE: tuple[Colour, ...] = (
    (226, 122, 84), (240, 196, 96), (96, 172, 214), (154, 124, 206), (236, 236, 232), (84, 92, 110),
)  # fmt: skip
"""Colours of the kinds that players place: those from `FIRST_KIND` on, in turn."""
FIRST_KIND = 7


class Face(NamedTuple):
    """A quadrangle, relative to the picture's origin, and its colour."""

    points: tuple[Point, ...]
    colour: Colour


def project(x: float, y: float, z: float) -> Point:
    """Converts a position in blocks to a point of the picture plane in pixels."""
    return (x + y) * HALF, (x - y) * QUARTER - z * RISE


def unproject(px: float, py: float, z: float) -> Point:
    """Returns the x and y, in blocks, of the position at height `z` that appears at a pixel."""
    a, b = px / HALF, (py + z * RISE) / QUARTER
    return (a + b) / 2, (a - b) / 2


def colour_of(kind: int) -> Colour:
    """Returns the colour of a kind of block in full light."""
    return PALETTE.get(kind) or CHOICE[(kind - FIRST_KIND) % len(CHOICE)]


def mixed(colour: Sequence[int], share: float, other: Sequence[int] = (0, 0, 0)) -> Colour:
    """Returns a mixture of `share` of a colour and `1 - share` of another."""
    r, g, b = (min(255, max(0, round(a * share + c * (1 - share)))) for a, c in zip(colour, other, strict=True))
    return r, g, b


class Picture(NamedTuple):
    """The picture of a segment."""

    check: int
    """CRC-32 of the blocks that the picture shows, with those around it."""
    surface: pygame.Surface
    corner: Point
    """The picture's upper left corner, on the plane that `project` maps to."""
    faces: dict[Cell, list[Face]]


class Ground:
    """The pictures of all loaded segments."""

    def __init__(self) -> None:
        self.pictures: dict[Cell, Picture] = {}
        self._seen: dict[Cell, tuple[int, ...]] = {}

    def refresh(self, blocks: Blocks, pictures_max: int) -> None:
        """Draws at most `pictures_max` of the pictures that are missing or out of date, the furthest first."""
        for segment in self.pictures.keys() - blocks.rows.keys():
            del self.pictures[segment], self._seen[segment]
        for segment in sorted(blocks, key=_depth):
            seen = tuple(blocks.version(other) if other in blocks else -1 for other in _neighbours(segment))
            if seen == self._seen.get(segment):
                continue
            kinds = _surroundings(blocks, segment)
            check, old = zlib.crc32(kinds.tobytes()), self.pictures.get(segment)
            if old is None or old.check != check:
                if pictures_max == 0:
                    return
                pictures_max -= 1
                self.pictures[segment] = _drawn(kinds, segment, check)
            self._seen[segment] = seen

    def draw(self, target: pygame.Surface, camera: Point) -> None:
        """Draws all pictures. `camera` is the point of the plane at the target's upper left corner."""
        for segment in sorted(self.pictures, key=_depth):
            picture = self.pictures[segment]
            place = round(picture.corner[0] - camera[0]), round(picture.corner[1] - camera[1])
            target.blit(picture.surface, place)

    def cover(self, target: pygame.Surface, camera: Point, low: Sequence[float], high: Sequence[float]) -> bool:
        """Draws again all faces in front of a box, so that they cover the figure in it. Returns whether there are any.

        Args:
            target: what to draw on; the caller clips it to the figure's outline.
            low, high: corners of the box, in blocks.
        """
        left, right = project(low[0], low[1], 0)[0], project(high[0], high[1], 0)[0]
        top, bottom = project(low[0], high[1], high[2])[1], project(high[0], low[1], low[2])[1]
        found = False
        for cell in self._ahead(low, high):
            x, y = project(*cell)
            if x + 2 * HALF <= left or x >= right or y + QUARTER <= top or y - QUARTER - RISE >= bottom:
                continue
            picture = self.pictures.get((cell[0] // SEGMENT, cell[1] // SEGMENT, cell[2] // SEGMENT))
            for points, colour in picture.faces.get(cell, ()) if picture else ():
                found = True
                shown = [(round(px) - round(camera[0]), round(py) - round(camera[1])) for px, py in points]
                pygame.draw.polygon(target, colour, shown)
        return found

    def _ahead(self, low: Sequence[float], high: Sequence[float]) -> Iterable[Cell]:
        """Returns the cells that may hide a box, the furthest first: cells on the line of sight and next to it."""
        x0, y0, z0 = (int(part // 1) for part in low)
        cells = []
        for step in range(7):
            for i in (-1, 0, 1):
                for j in (-1, 0, 1):
                    for k in (-1, 0, 1, 2):
                        cell = x0 + step + i, y0 - step + j, z0 + step + k
                        if cell[0] >= high[0] or cell[1] + 1 <= low[1] or cell[2] >= high[2]:
                            cells.append(cell)
        return sorted(set(cells), key=_depth)


def target_of(blocks: Blocks, at: Point, height: float) -> tuple[Cell, Cell] | None:
    """Returns the visible block at a point of the plane, and the free cell in front of it; None if there is none.

    Args:
        height: the search covers 9 blocks above this height, and 11 below it.
    """
    before: Cell | None = None
    for step in range(500):
        z = height + 9 - step * 0.04
        x, y = unproject(*at, z)
        cell = int(x // 1), int(y // 1), int(z // 1)
        if cell == before:
            continue
        kind = blocks.get(*cell)
        if kind and before is not None:
            return cell, before
        before = cell if kind is not None else None
    return None


def top_of(cell: Cell) -> tuple[Point, ...]:
    """Returns the corners of a block's top on the plane: the left, bottom, right and top one on the screen."""
    x, y, z = cell
    return project(x, y, z + 1), project(x + 1, y, z + 1), project(x + 1, y + 1, z + 1), project(x, y + 1, z + 1)


def _depth(cell: Cell) -> tuple[int, int, int, int]:
    """Returns the sort key of the drawing order: cells that are further away come first."""
    x, y, z = cell
    return x - y + z, x, -y, z


def _neighbours(segment: Cell) -> list[Cell]:
    x, y, z = segment
    return [(x + i, y + j, z + k) for k in (0, 1) for j in (-1, 0, 1) for i in (-1, 0, 1)]


def _surroundings(blocks: Blocks, segment: Cell) -> Bytes:
    """Returns the kinds of a segment and of `AROUND` more blocks at each side and above, [z, y, x]; 0 if not loaded."""
    wide = SEGMENT + 2 * AROUND
    kinds = np.zeros((SEGMENT + AROUND, wide, wide), np.uint8)
    for other in _neighbours(segment):
        if other in blocks:
            here, there = zip(*(_overlap(other[k] - segment[k], k == 2) for k in (2, 1, 0)), strict=True)
            kinds[here] = blocks.segment(other)[there]
    return kinds


def _overlap(way: int, upright: bool) -> tuple[slice, slice]:
    """Returns the part of the surroundings that a neighbour fills along one axis, and which part of the neighbour.

    Args:
        way: the neighbour's distance, in segments: -1, 0 or 1.
        upright: the axis is z, where the surroundings have nothing below the segment.
    """
    before = 0 if upright else AROUND
    start, end = before + way * SEGMENT, before + (way + 1) * SEGMENT
    low, high = max(start, 0), min(end, before + SEGMENT + AROUND)
    return slice(low, high), slice(low - start, high - start)


def _drawn(kinds: Bytes, segment: Cell, check: int) -> Picture:
    inner = slice(AROUND, AROUND + SEGMENT)
    solid = kinds != AIR
    here = solid[:SEGMENT, inner, inner]
    shade = _light(solid)
    seen = np.stack(
        (
            here & ~solid[1 : SEGMENT + 1, inner, inner],
            here & ~solid[:SEGMENT, AROUND - 1 : AROUND + SEGMENT - 1, inner],
            here & ~solid[:SEGMENT, inner, AROUND + 1 : AROUND + SEGMENT + 1],
        )
    )
    faces: dict[Cell, list[Face]] = {}
    origin = tuple(part * SEGMENT for part in segment)
    for z, y, x in np.argwhere(seen.any(axis=0)).tolist():
        cell = (origin[0] + x, origin[1] + y, origin[2] + z)
        kind = int(kinds[z, y + AROUND, x + AROUND])
        faces[cell] = _faces(cell, kind, seen[:, z, y, x].tolist(), float(shade[z, y, x]))
    points = np.array([point for each in faces.values() for face in each for point in face.points] or [(0, 0)])
    left, top = points.min(axis=0) - 1
    width, height = (points.max(axis=0) - (left, top) + 2).astype(int).tolist()
    surface = pygame.Surface((width, height)).convert()
    surface.fill(SKY)
    for cell in sorted(faces, key=_depth):
        for face in faces[cell]:
            shown = [(round(x - left), round(y - top)) for x, y in face.points]
            pygame.draw.polygon(surface, face.colour, shown)
    surface.set_colorkey(SKY, pygame.RLEACCEL)
    return Picture(check, surface, (float(left), float(top)), faces)


def _light(solid: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """Returns the brightness of each block's top: lower in the sun's shadow and in corners that see less of the sky."""
    deep, wide = solid.shape[0], SEGMENT + 2 * AROUND
    dark = np.zeros((SEGMENT, SEGMENT, SEGMENT))
    for i, j, k in SUN:
        ahead = solid[k : SEGMENT + k, AROUND + j : AROUND + j + SEGMENT, AROUND + i : AROUND + i + SEGMENT]
        dark[: len(ahead)] = np.maximum(dark[: len(ahead)], ahead)
    above = np.zeros((SEGMENT, wide, wide))
    above[: deep - 1] = solid[1 : SEGMENT + 1]
    near = sum(
        above[:, AROUND + j : AROUND + j + SEGMENT, AROUND + i : AROUND + i + SEGMENT]
        for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j
    )  # fmt: skip
    height = np.arange(SEGMENT)[:, None, None] / SEGMENT
    light: npt.NDArray[np.float64] = (0.86 + 0.34 * height) * (1 - 0.26 * dark) * (1 - 0.045 * near)
    return light


def _faces(cell: Cell, kind: int, seen: Sequence[bool], light: float) -> list[Face]:
    """Returns the faces of a block that can be seen: of top, south and east those that `seen` selects."""
    x, y, z = cell
    grain = 1 + ((x * 73 ^ y * 151 ^ z * 57) * 2654435761 >> 7) % 16 / 200 - 0.04
    base = mixed(colour_of(kind), grain)
    side = mixed(colour_of(SOIL), grain) if kind == GRASS else base
    corner = (x + 1, y)
    faces = []
    for shows, a, b, shade, rim in (
        (seen[1], (x, y), corner, 0.84, 0.8),
        (seen[2], corner, (x + 1, y + 1), 0.64, 0.64),
    ):
        if shows:
            faces.append(_upright(a, b, z, 1.0, mixed(side, shade)))
            if kind == GRASS:
                faces.append(_upright(a, b, z, 0.3, mixed(base, rim), 0.7))
    if seen[0]:
        faces.append(Face(top_of(cell), mixed(base, light) if light <= 1 else mixed(base, 2 - light, (255, 255, 220))))
    return faces


def _upright(a: Point, b: Point, z: float, height: float, colour: Colour, above: float = 0.0) -> Face:
    """Returns a strip of a side between two corners, of the given height, `above` the block's lower edge."""
    low, high = z + above, z + above + height
    return Face((project(*a, low), project(*b, low), project(*b, high), project(*a, high)), colour)
