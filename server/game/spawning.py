"""Spawning: finds free places at and around the spawn points for players that join and entities that fell out."""

from array import array
from collections.abc import Iterator

from server.game.fast_rows import Arguments, lent
from shared.checks import Vec
from shared.free_places import box_at, taken
from shared.layout import FLOOR, TEMPLATE
from shared.places import APART, RINGS
from shared.units import BLOCK, BLOCK_SHIFT, to_position
from shared.world import World

OFFSETS = tuple(
    (i, j)
    for ring in range(1, RINGS)
    for i in range(-ring, ring + 1)
    for j in range(-ring, ring + 1)
    if max(abs(i), abs(j)) == ring
)
"""Offsets of the places around a spawn point in steps of `APART` blocks, the nearest rings first."""
NO_PLACE = len(OFFSETS)
"""Number that stands for the spawn point itself, and for everything beyond the rings."""
NUMBERS = {offset: number for number, offset in enumerate(OFFSETS)}
"""Number of each place, by its offset."""
_ACROSS = range(-RINGS, RINGS + 1)
ORDER = array("i", (NUMBERS.get((i, j), NO_PLACE) for i in _ACROSS for j in _ACROSS))
"""Number of the place at each offset, as `places.mark_near` takes them."""
NOTHING_NEAR = bytes(NO_PLACE + 1)
"""Marks of the places, and of `NO_PLACE`, if there is no entity."""


class Spawns:
    """The free places at and around the spawn points of a world's scene."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._turn = 0
        self._full: tuple[int, int, int] | None = None
        self._floor = int(world.parameters[FLOOR])
        self._points = [in_steps(spawn) for spawn in world.scene.spawns]
        self._spawn = Arguments(world.kernel, "d", 2)
        self._order = lent(world.kernel, ORDER, "i")
        self._near = Arguments(world.kernel, "B", len(NOTHING_NEAR))

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
        points = self._points
        turn = self._turn % len(points)
        for at in range(turn, turn + len(points)):
            place = points[at % len(points)]
            if not taken(world, row, kind, box_at(world, kind, place)):
                yield place
        x, y, _ = world.scene.spawns[turn]
        height = points[turn][2]
        occupied = self._occupied(x, y)
        for near in (b"\0", b"\1"):
            at = occupied.find(near)
            while at >= 0:
                i, j = OFFSETS[at]
                place = [to_position(x + APART * i, "spawn"), to_position(y + APART * j, "spawn"), height]
                box = box_at(world, kind, place)
                if not (self._built(box) or taken(world, row, kind, box)):
                    yield place
                at = occupied.find(near, at + 1)
        self._full = now

    def _built(self, box: list[int]) -> bool:
        """Returns whether a block, or a segment that is not loaded, is in the way of a box."""
        world = self._world
        below = (box[5] - 1) >> BLOCK_SHIFT < self._floor
        return below or bool(world.kernel.blocks_in(world.bound, *box))

    def _occupied(self, x: float, y: float) -> bytes:
        """Returns for each of the places `OFFSETS` around a spawn point whether an entity is near it, at any height."""
        world, spawn, near = self._world, self._spawn.values, self._near
        spawn[0], spawn[1] = x * BLOCK, y * BLOCK
        near.values[:] = NOTHING_NEAR
        world.kernel.mark_near(world.arrays.entities, self._spawn.lent, self._order, near.lent)
        return bytes(near.values[:NO_PLACE])


def in_steps(place: Vec) -> list[int]:
    """Returns a place in grid steps."""
    return [to_position(part, "spawn") for part in place]
