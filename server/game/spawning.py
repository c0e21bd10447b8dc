"""Spawning: finds free places at and around the spawn points for players that join and entities that fell out."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from shared.checks import Vec
from shared.free_places import box_at
from shared.layout import FLOOR, ID, TEMPLATE, X, Y
from shared.units import BLOCK, BLOCK_SHIFT, to_position
from shared.world import OverlapError, World

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
SIDE = 2 * RINGS - 1
"""Number of places along each axis."""
PLACES = np.array([i * SIDE + j for i, j in OFFSETS])
"""Index of each of `OFFSETS` in a table of `SIDE` times `SIDE` places whose middle has the index 0."""

Bools = npt.NDArray[np.bool_]


class Spawns:
    """The free places at and around the spawn points of a world's scene."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._turn = 0
        self._full: tuple[int, int, int] | None = None

    def spawn(self) -> int | None:
        """Adds the entity of a new player and returns its number; None: there is no room."""
        player = self._world.scene.player
        for place in self._places(self._world.scene.index_of[player]):
            try:
                return self._world.spawn(player, place)
            except OverlapError:
                continue
        return None

    def put_back(self, entity: int) -> bool:
        """Puts an entity at a spawn point, at rest. Returns False if there is no room."""
        for place in self._places(self._world.state(entity)[TEMPLATE]):
            try:
                self._world.place(entity, place)
            except OverlapError:
                continue
            self._world.set_velocity(entity, (0.0, 0.0, 0.0))
            return True
        return False

    def _places(self, kind: int) -> Iterator[Vec]:
        """Yields the places to try for an entity: the spawn points in turn, then rings around one of them.

        Places near other entities are tried last; without that, a join cost 40 ms in a crowd of 360 at the spawn point.
        Places in blocks are not tried; without that, it cost 180 ms (now 16 ms) at spawn points that players had walled
        up. If there is no room at all, that is found out only once per tick.

        Args:
            kind: index of the entity's template.
        """
        now = (self._world.tick, len(self._world), kind)
        if now == self._full:
            return
        self._turn += 1
        spawns = self._world.scene.spawns
        turn = self._turn % len(spawns)
        yield from spawns[turn:] + spawns[:turn]
        x, y, z = spawns[turn]
        taken = self._taken(x, y)
        for order in (~taken, taken):
            for at in np.flatnonzero(order):
                i, j = OFFSETS[at]
                place = x + APART * i, y + APART * j, z
                if not self._built(kind, place):
                    yield place
        self._full = now

    def _built(self, kind: int, place: Vec) -> bool:
        """Returns whether a block, or a segment that is not loaded, is in the way of an entity at a place."""
        world = self._world
        box = box_at(world, kind, [to_position(part, "spawn") for part in place])
        below = (box[5] - 1) >> BLOCK_SHIFT < world.parameters[FLOOR]
        return bool(below or world.kernel.blocks_in(world.bound, *box))

    def _taken(self, x: float, y: float) -> Bools:
        """Returns which of the places `OFFSETS` around a spawn point have an entity nearby, at any height."""
        matrix, step = self._world.matrix, APART * BLOCK
        i, j = (np.rint((matrix[:, column] - at * BLOCK) / step) for column, at in ((X, x), (Y, y)))
        near = (np.maximum(np.abs(i), np.abs(j)) < RINGS) & (matrix[:, ID] != 0)
        taken = np.zeros(SIDE * SIDE, bool)
        taken[np.where(near, i * SIDE + j, 0).astype(np.int64)] = True  # 0 is the spawn point, which is not asked for
        found: Bools = taken[PLACES]
        return found
