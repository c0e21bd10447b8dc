"""What changed, by tick and by segment, and its bytes: encoded once, shared by all who see the segment.

A client is sent what changed since the last snapshot it was sent. Most were sent the previous tick's, so one
encoding serves them all; one that skipped some gets the union of those ticks; one that is more than `HISTORY`
ticks behind, or has just begun to see the segment, gets a keyframe. Nothing is computed per entity and client.
"""

from collections import defaultdict
from collections.abc import Iterable

from shared.blocks import pack, segment_of
from shared.checks import Cell
from shared.layout import ID, Int64s, X
from shared.ring import Ring
from shared.snapshot import checksum, encode_part
from shared.units import BLOCK_SHIFT, SEGMENT, SEGMENT_SHIFT
from shared.world import World

HISTORY = 64
"""Ticks for which changes are kept."""
CHECK_TICKS = 32
"""How often a segment in which something changes is sent with its checksum."""
KEYFRAME = -1
"""The `since` of a part that holds everything."""


class _Tick:
    """One tick's changes."""

    def __init__(self) -> None:
        self.changed: dict[Cell, list[int]] = defaultdict(list)  # ids by segment
        self.gone: dict[Cell, list[int]] = defaultdict(list)
        self.edited: dict[Cell, set[int]] = defaultdict(set)  # block offsets by segment
        self.acted: set[int] = set()  # ids that the rules placed or threw

    def segments(self) -> set[Cell]:
        return self.changed.keys() | self.gone.keys() | self.edited.keys()


class ChangeLog:
    """The changes of one world. Record each tick once, after its step; then ask for parts."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ticks: Ring[_Tick] = Ring(HISTORY)
        self._now = _Tick()
        self._home: dict[int, Cell] = {}
        self._changed: dict[int, set[Cell] | None] = {}
        self._parts: dict[tuple[Cell, int], bytes] = {}
        self._packed: dict[Cell, tuple[int, bytes]] = {}

    def segment(self, entity: int) -> Cell:
        """Where an entity was at the end of the latest recorded tick."""
        return self._home[entity]

    def note_edit(self, x: int, y: int, z: int) -> None:
        """A block has changed, ahead of the coming step."""
        inside = SEGMENT - 1
        self._now.edited[segment_of(x, y, z)].add((z & inside) << 10 | (y & inside) << 5 | (x & inside))

    def note_act(self, entity: int) -> None:
        """The rules have placed or thrown an entity, ahead of the coming step."""
        self._now.acted.add(entity)

    def note_removal(self, entity: int) -> None:
        """An entity has been removed, ahead of the coming step."""
        home = self._home.pop(entity, None)
        if home is not None:
            self._now.gone[home].append(entity)

    def record(self) -> None:
        """Takes in what the step has changed."""
        now, rows = self._now, self._world.changed
        segments = rows[:, X : X + 3] >> (BLOCK_SHIFT + SEGMENT_SHIFT)
        for entity, segment in zip(rows[:, ID].tolist(), map(tuple, segments.tolist()), strict=True):
            home = self._home.get(entity)
            if home != segment:
                if home is not None:
                    now.gone[home].append(entity)
                self._home[entity] = segment
            now.changed[segment].append(entity)
        self._ticks.put(self._world.tick, now)
        self._now = _Tick()
        self._parts.clear()
        self._changed.clear()

    def changed_segments(self, since: int) -> set[Cell] | None:
        """The segments in which anything changed after tick `since`; None: too long ago to tell."""
        if since not in self._changed:
            ticks = self._since(since)
            self._changed[since] = None if ticks is None else set().union(*(tick.segments() for tick in ticks))
        return self._changed[since]

    def part(self, segment: Cell, since: int) -> bytes:
        """The encoded changes of a segment after tick `since`, which is `KEYFRAME` or at most `HISTORY` ago."""
        key = (segment, since)
        part = self._parts.get(key)
        if part is None:
            part = self._parts[key] = self._keyframe(segment) if since == KEYFRAME else self._changes(segment, since)
        return part

    def packed(self, segment: Cell) -> bytes:
        """A segment's blocks as they are, packed."""
        digest = self._world.blocks.digest(segment)
        known = self._packed.get(segment)
        if known is None or known[0] != digest:
            known = self._packed[segment] = (digest, pack(self._world.blocks.segment(segment)))
        return known[1]

    def _since(self, since: int) -> list[_Tick] | None:
        if self._world.tick - since > HISTORY:
            return None
        ticks = [self._ticks.get(tick) for tick in range(since + 1, self._world.tick + 1)]
        return [tick for tick in ticks if tick is not None]

    def _keyframe(self, segment: Cell) -> bytes:
        if segment in self._world.blocks:
            return encode_part(segment, KEYFRAME, self._world.in_segment(segment))
        strays = [entity for entity, home in self._home.items() if home == segment]
        return encode_part(segment, KEYFRAME, self._world.rows(sorted(strays)))

    def _changes(self, segment: Cell, since: int) -> bytes:
        ticks = self._since(since)
        assert ticks is not None
        here = {
            entity for tick in ticks for entity in tick.changed.get(segment, ()) if self._home.get(entity) == segment
        }
        gone = {entity for tick in ticks for entity in tick.gone.get(segment, ()) if self._home.get(entity) != segment}
        edited = {offset for tick in ticks for offset in tick.edited.get(segment, ())}
        acted = {entity for tick in ticks for entity in tick.acted if entity in here}
        due = (self._world.tick + hash(segment)) % CHECK_TICKS == 0 and segment in self._world.blocks
        check = checksum(self._world, segment) if due else 0
        kinds = self._kinds(segment, sorted(edited))
        return encode_part(segment, since, self._rows(here), sorted(gone), kinds, acted=acted, check=check)

    def _rows(self, entities: Iterable[int]) -> Int64s:
        return self._world.rows(sorted(entities))

    def _kinds(self, segment: Cell, offsets: list[int]) -> list[tuple[int, int]]:
        if not offsets:
            return []
        kinds = self._world.blocks.segment(segment).reshape(-1)
        return [(offset, int(kinds[offset])) for offset in offsets]
