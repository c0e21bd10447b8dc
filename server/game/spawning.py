"""Where players appear, and appear again."""

from collections.abc import Iterator

import numpy as np

from shared.blocks import AIR
from shared.checks import Vec
from shared.layout import ID, TEMPLATE, X, Y
from shared.units import BLOCK, BLOCK_SHIFT, to_position
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
        self._boxes = [template.row()[:6] for template in world.scene.templates]
        self._full: tuple[int, int, int] | None = None

    def spawn(self) -> int | None:
        """A new player's entity; None: there is no room."""
        player = self._world.scene.player
        for place in self._places(self._world.scene.index_of[player]):
            try:
                return self._world.spawn(player, place)
            except OverlapError:
                continue
        return None

    def put_back(self, entity: int) -> bool:
        """Puts an entity at a spawn, at rest; False: there is no room."""
        for place in self._places(self._world.state(entity)[TEMPLATE]):
            try:
                self._world.place(entity, place)
            except OverlapError:
                continue
            self._world.set_velocity(entity, (0.0, 0.0, 0.0))
            return True
        return False

    def _places(self, kind: int) -> Iterator[Vec]:
        """Where to try for an entity of a template: the scene's spawns in turn, then ever wider around one of them.

        Where somebody is, is tried last: a crowd of 360 at the spawn made a join cost 40 ms otherwise. Where a block
        is, nothing is tried: spawns that players had walled up made it cost 180 ms (now 16). And that there is no room
        is found once a tick, not by everybody who needs some.
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
        for order in (False, True):
            for i, j in OFFSETS:
                place = x + APART * i, y + APART * j, z
                if ((i, j) in taken) is order and not self._built(kind, place):
                    yield place
        self._full = now

    def _built(self, kind: int, place: Vec) -> bool:
        """Whether a block is in the way of an entity there, or none is known."""
        box = self._boxes[kind]
        low = [to_position(part, "spawn") + reach for part, reach in zip(place, box, strict=False)]
        spans = [
            range(a >> BLOCK_SHIFT, (a + side - 1 >> BLOCK_SHIFT) + 1) for a, side in zip(low, box[3:], strict=True)
        ]
        return any(self._world.blocks.get(x, y, z) != AIR for z in spans[2] for y in spans[1] for x in spans[0])

    def _taken(self, x: float, y: float) -> set[tuple[int, int]]:
        """The offsets from a spawn next to which there is somebody, at whatever height."""
        matrix = self._world.matrix
        places = matrix[matrix[:, ID] != 0][:, (X, Y)]
        offsets = np.rint((places / BLOCK - (x, y)) / APART)
        near = offsets[(np.abs(offsets) < RINGS).all(axis=1)].astype(int)
        return set(map(tuple, near.tolist()))
