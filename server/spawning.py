"""Where players appear, and appear again."""

from collections.abc import Iterator

import numpy as np

from shared.checks import Vec
from shared.layout import ID, X, Y
from shared.units import BLOCK
from shared.world import OverlapError, World

RINGS = 24
"""Where a spawn is taken, others are tried in rings around it, so many blocks apart:"""
APART = 2
OFFSETS = tuple(
    (i, j)
    for ring in range(1, RINGS)
    for i in range(-ring, ring + 1)
    for j in range(-ring, ring + 1)
    if max(abs(i), abs(j)) == ring
)


class Spawns:
    """The free places at and around the spawns of a world's scene."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._turn = 0

    def spawn(self) -> int | None:
        """A new player's entity; None: there is no room."""
        for place in self._places():
            try:
                return self._world.spawn(self._world.scene.player, place)
            except OverlapError:
                continue
        return None

    def put_back(self, entity: int) -> bool:
        """Puts an entity at a spawn, at rest; False: there is no room."""
        for place in self._places():
            try:
                self._world.place(entity, place)
            except OverlapError:
                continue
            self._world.set_velocity(entity, (0.0, 0.0, 0.0))
            return True
        return False

    def _places(self) -> Iterator[Vec]:
        """Where to try: the scene's spawns in turn, then ever wider around one of them.

        Where somebody is, is tried last: a crowd of 360 at the spawn made a join cost 40 ms otherwise.
        """
        self._turn += 1
        spawns = self._world.scene.spawns
        turn = self._turn % len(spawns)
        yield from spawns[turn:] + spawns[:turn]
        x, y, z = spawns[turn]
        taken = self._taken(x, y)
        for order in (False, True):
            for offset in OFFSETS:
                if (offset in taken) is order:
                    yield x + APART * offset[0], y + APART * offset[1], z

    def _taken(self, x: float, y: float) -> set[tuple[int, int]]:
        """The offsets from a spawn next to which there is somebody, at whatever height."""
        matrix = self._world.matrix
        places = matrix[matrix[:, ID] != 0][:, (X, Y)]
        offsets = np.rint((places / BLOCK - (x, y)) / APART)
        near = offsets[(np.abs(offsets) < RINGS).all(axis=1)].astype(int)
        return set(map(tuple, near.tolist()))
