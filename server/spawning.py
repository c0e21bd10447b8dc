"""Where players appear, and appear again."""

from collections.abc import Iterator

from shared.checks import Vec
from shared.world import OverlapError, World

RINGS = 24
"""Where a spawn is taken, others are tried in rings around it, two blocks apart."""


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
        """Where to try: the scene's spawns in turn, then ever wider around one of them."""
        self._turn += 1
        spawns = self._world.scene.spawns
        turn = self._turn % len(spawns)
        yield from spawns[turn:] + spawns[:turn]
        x, y, z = spawns[turn]
        for ring in range(1, RINGS):
            for i in range(-ring, ring + 1):
                for j in range(-ring, ring + 1):
                    if max(abs(i), abs(j)) == ring:
                        yield x + 2 * i, y + 2 * j, z
