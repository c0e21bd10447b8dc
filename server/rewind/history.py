"""Lag compensation: the world as a player saw it, for the check of a shot.

Theory of operation. A client draws other entities a little in the past, between two ticks. When its shot arrives, they
are elsewhere. Therefore the server keeps the past of the last `Limits.rewind_s` seconds (0.5 by default), as undo data
of each tick: the former contents of the rows of the world's matrix and of the blocks that the tick changed. A `Past`
starts from the newest tick and undoes one tick after the other. Its cost depends on the number of changes; sleeping
entities cost nothing. Positions between two ticks are computed with the same float operations as in
`client_sdk.interpolation`, so a target is exactly where its shooter drew it. Blocks are those of the earlier of the two
ticks: an edit takes effect when its tick is over.

Acts of the rules (place, remove, change, spawn) take effect at the end of their tick: until then a placed entity is at
its former position. A client that was not sent every tick interpolates between two ticks that are further apart. Its
*gaps* are these pairs of ticks. All acts within a gap take effect at its second tick.
"""

import math
from collections import deque
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from shared import layout
from shared.between import between
from shared.checks import Cell, Vec, finite
from shared.hits import Hit as Hit
from shared.hits import Targets, boxes_of
from shared.kernels import Kernel
from shared.layout import ID, TEMPLATE, Int64s, X
from shared.units import SEGMENT_SHIFT
from shared.world import World

WINDOW_S = 0.5
"""Seconds that a query can look back by default."""
KEPT = [ID, TEMPLATE, X, X + 1, X + 2]
"""Columns of a row that are kept."""
ROOM_MIN = 16
"""Number of rows for which undo data may have room beyond four times the rows they need."""
Floats = npt.NDArray[np.float64]


class _Undo:
    """The undo data of one tick. They are used again for a later tick.

    Args:
        kernel: the kernel that writes the rows.
        room: number of rows for which there is room.
    """

    __slots__ = ("blocks", "gone", "lent", "n", "placed", "room")

    def __init__(self, kernel: Kernel, room: int) -> None:
        self.room = np.empty((room, 1 + len(KEPT)), np.int64)
        self.lent = kernel.lent(self.room)
        self.n = 0
        """Number of the rows in `room`."""
        self.gone: Int64s | None = None
        """Further rows: those of removed entities."""
        self.blocks: dict[Cell, int] = {}
        """Former kinds of the changed blocks."""
        self.placed: set[int] = set()
        """Entities that the rules placed in the tick."""

    @property
    def rows(self) -> Int64s:
        """The number of each changed row of the matrix and its former contents, [n, 6]."""
        rows: Int64s = self.room[: self.n]
        return rows if self.gone is None else np.concatenate((rows, self.gone))


class Rewind:
    """The recent past of one world. Call `record` once per tick, after the step.

    Args:
        world: the world; other code steps it.
        window_s: seconds that are kept. Each change of an entity in a tick takes 48 bytes.
    """

    def __init__(self, world: World, window_s: float = WINDOW_S) -> None:
        self._world = world
        self._reach = window_s * world.scene.tick_rate
        self._kept = math.ceil(self._reach)
        self._undo: deque[_Undo] = deque()
        self._spare: _Undo | None = None
        """Undo data that are no longer needed."""
        self._placed_at = -math.inf
        """Newest tick in which an entity was placed."""
        self._boxes = np.array(boxes_of(world.scene)).reshape(-1, 2, 3)
        self._tick = -1
        self._alive = 0
        self._now = np.zeros((0, len(KEPT)), np.int64)
        self._begin()

    def record(self) -> None:
        """Records the undo data of the latest step."""
        world = self._world
        if world.tick != self._tick + 1:  # the world was set to another tick
            self._begin()
            return
        w = world.arrays
        more = (len(w.entities) >> layout.WIDTH_SHIFT) - len(self._now)
        if more > 0:
            self._now = np.concatenate((self._now, np.zeros((more, len(KEPT)), np.int64)))
            self._now_lent = world.kernel.lent(self._now)
        n = int(w.lengths[layout.N_CHANGED])
        undo = self._spare
        if undo is None or not n <= len(undo.room) <= 4 * n + ROOM_MIN:
            undo = _Undo(world.kernel, n + n // 2 + ROOM_MIN // 2)
        self._spare = None
        undo.n, undo.gone, undo.blocks, undo.placed = n, None, world.edited, world.placed
        self._alive += world.kernel.recall(w.entities, w.changed, self._now_lent, undo.lent, n)
        if self._alive != len(world):  # some have been removed
            matrix = world.matrix
            gone = np.flatnonzero(self._now[: len(matrix), 0] != matrix[:, ID])
            undo.gone = np.column_stack((gone, self._now[gone]))
            self._now[gone] = 0
            self._alive = len(world)
        self._undo.append(undo)
        self._tick = world.tick
        if world.placed:
            self._placed_at = world.tick
        # A query within the reach may be in a gap of up to the same length, which begins that much earlier.
        kept = self._kept if self._tick - self._placed_at > 2 * self._kept else 2 * self._kept
        while len(self._undo) > kept:
            self._spare = self._undo.popleft()

    def at(self, seen: float, own: int = 0, gaps: Iterable[tuple[int, int]] = ()) -> "Past":
        """Returns the world at a moment. A moment outside of what is kept is moved to its nearest end.

        Args:
            seen: the moment in ticks of server time, with a fraction.
            own: an entity that no query finds: that of the player for whom the query is.
            gaps: pairs of ticks between which the player's client was sent no snapshot.

        Raises:
            SceneError: `seen` is not a finite number.
        """
        kept = self._tick - len(self._undo)
        seen = min(max(finite(seen, "seen"), self._tick - self._reach, kept), float(self._tick))
        tick = math.floor(seen)
        first, last = next((gap for gap in gaps if gap[0] <= seen < gap[1]), (tick, tick + 1))
        first = max(first, kept)
        states = after = self._now.copy()
        blocks = dict(self._world.editing)
        placed: set[int] = set()
        for undone in range(self._tick, first, -1):
            undo = self._undo[undone - self._tick - 1]
            if undone == last:
                after = states.copy()
            if undone <= last:
                placed |= undo.placed
            rows = undo.rows
            states[rows[:, 0]] = rows[:, 1:]
            if undone > tick:
                blocks |= undo.blocks
        entities = _between(states, after, (seen - first) / (last - first), placed)
        return Past(self._world, seen, entities, self._boxes, blocks, own)

    def _begin(self) -> None:
        """Starts over with the present state and no past."""
        self._undo.clear()
        self._tick = self._world.tick
        self._now = np.ascontiguousarray(self._world.matrix[:, KEPT])
        self._now_lent = self._world.kernel.lent(self._now)
        self._alive = len(self._world)


class Past(Targets):
    """The world at one moment of the recent past, with its queries. Valid until the next tick.

    Attributes:
        seen: the moment, in ticks of server time, after it was limited to what is kept.
    """

    def __init__(
        self,
        world: World,
        seen: float,
        entities: tuple[Int64s, Floats],
        boxes: Floats,
        blocks: dict[Cell, int],
        own: int,
    ) -> None:
        self.seen = seen
        states, places = entities
        box = boxes[states[:, 1]]
        low = places + box[:, 0]
        super().__init__(states[:, 0], low, low + box[:, 1], own)
        self._places, self._world, self._blocks = places, world, blocks
        self._floor = world.scene.origin[2] << SEGMENT_SHIFT

    def __contains__(self, entity: int) -> bool:
        return bool((self._ids == entity).any())

    def position(self, entity: int) -> Vec:
        """Returns the position of an entity at that moment, in blocks.

        Raises:
            KeyError: the entity did not exist.
        """
        found = np.flatnonzero(self._ids == entity)
        if not len(found):
            raise KeyError(entity)
        x, y, z = self._places[found[0]].tolist()
        return x, y, z

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block at that moment; None if its segment is not loaded now.

        Loading and unloading of whole segments is not undone.
        """
        kind = self._blocks.get((x, y, z))
        return self._world.blocks.get(x, y, z) if kind is None else kind

    def solid(self, cell: Cell) -> bool:
        kind = self.block(*cell)
        return cell[2] >= self._floor if kind is None else self._world.blocks.stops[kind]


def _between(old: Int64s, new: Int64s, share: float, placed: set[int]) -> tuple[Int64s, Floats]:
    """Interpolates between two ticks.

    Args:
        old: the kept columns of all rows at the first tick.
        new: the same at the second tick.
        share: the moment between them, from 0 to 1.
        placed: entities that the rules placed; they stay at their positions of the first tick.

    Returns:
        The rows of `old` with an entity, and their positions in blocks.
    """
    ids = old[:, 0]
    places = between(ids, old[:, 2:], new[:, 2:], ids == new[:, 0], placed, share)
    there = ids != 0
    return old[there], places[there]
