"""Spawning: finds free places at and around the spawn points for players that join and entities that fell out."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from shared.checks import Vec
from shared.free_places import box_at, taken
from shared.layout import FLOOR, ID, TEMPLATE, X, Y
from shared.units import BLOCK, BLOCK_SHIFT, to_position
from shared.world import World

RINGS = 24
"""Number of rings of places that are tried around a spawn point, including the point itself."""
APART = 2
"""Distance of neighbouring places and rings, in blocks."""
OFFSETS = tuple(
    (i, j)
    for ring in range(1, RINGS)
    for i in range(-ring, ring + 1)
    for j in range(-ring, ring + 1)
    if max(abs(i), abs(j)) == ring
)
"""Offsets of the places around a spawn point in steps of `APART` blocks, the nearest rings first."""
SIDE = 2 * RINGS + 1
"""Number of places along each axis, with one more at each end, which stands for all that are further away."""
ORDER = np.full(SIDE * SIDE, len(OFFSETS))
"""Number of each of `OFFSETS` (i, j), at the index i * `SIDE` + j. Other places have the number after the last."""
ORDER[[i * SIDE + j for i, j in OFFSETS]] = range(len(OFFSETS))
ALONG = np.array((SIDE, 1.0))
"""Factors of an offset (i, j) in this index."""

Bools = npt.NDArray[np.bool_]


class Spawns:
    """The free places at and around the spawn points of a world's scene."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._turn = 0
        self._full: tuple[int, int, int] | None = None

    def spawn(self) -> int | None:
        """Adds the entity of a new player and returns its number; None: there is no room."""
        world = self._world
        kind = world.scene.index_of[world.scene.player]
        place = next(self._places(kind, -1), None)
        return None if place is None else world.add(kind, place)

    def put_back(self, entity: int) -> bool:
        """Puts an entity at a spawn point, at rest. Returns False if there is no room."""
        world = self._world
        place = next(self._places(world.state(entity)[TEMPLATE], world.row_of(entity)), None)
        if place is None:
            return False
        x, y, z = place
        world.place(entity, (x / BLOCK, y / BLOCK, z / BLOCK))
        world.set_velocity(entity, (0.0, 0.0, 0.0))
        return True

    def _places(self, kind: int, row: int) -> Iterator[list[int]]:
        """Yields the free places for an entity, in grid steps: at the spawn points in turn, then around one of them.

        Places near other entities are tried last; without that, a join cost 40 ms in a crowd of 360 at the spawn point.
        Places in blocks are not tried; without that, it cost 180 ms (now 16 ms) at spawn points that players had walled
        up. If there is no room at all, that is found out only once per tick.

        Args:
            kind: index of the entity's template.
            row: row of the entity, which is not in its own way; -1: it is a new one.
        """
        world = self._world
        now = (world.tick, len(world), kind)
        if now == self._full:
            return
        self._turn += 1
        spawns = world.scene.spawns
        turn = self._turn % len(spawns)
        for spawn in spawns[turn:] + spawns[:turn]:
            place = in_steps(spawn)
            if not taken(world, row, kind, box_at(world, kind, place)):
                yield place
        x, y, z = spawns[turn]
        occupied = self._taken(x, y).tobytes()
        for near in (b"\0", b"\1"):
            at = occupied.find(near)
            while at >= 0:
                i, j = OFFSETS[at]
                place = in_steps((x + APART * i, y + APART * j, z))
                box = box_at(world, kind, place)
                if not (self._built(box) or taken(world, row, kind, box)):
                    yield place
                at = occupied.find(near, at + 1)
        self._full = now

    def _built(self, box: list[int]) -> bool:
        """Returns whether a block, or a segment that is not loaded, is in the way of a box."""
        world = self._world
        below = (box[5] - 1) >> BLOCK_SHIFT < world.parameters[FLOOR]
        return bool(below or world.kernel.blocks_in(world.bound, *box))

    def _taken(self, x: float, y: float) -> Bools:
        """Returns which of the places `OFFSETS` around a spawn point have an entity nearby, at any height."""
        world = self._world
        matrix = world.matrix
        if len(matrix) > len(world):
            matrix = matrix[matrix[:, ID] != 0]
        steps = matrix.T[X : Y + 1] - np.array(((x * BLOCK,), (y * BLOCK,)))
        steps /= APART * BLOCK
        np.rint(steps, out=steps)
        np.maximum(steps, -RINGS, out=steps)
        np.minimum(steps, RINGS, out=steps)
        near = np.zeros(len(OFFSETS) + 1, bool)
        near[ORDER[(ALONG @ steps).astype(np.int64)]] = True
        return near[:-1]


def in_steps(place: Vec) -> list[int]:
    """Returns a place in grid steps."""
    return [to_position(part, "spawn") for part in place]
