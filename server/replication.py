"""What changed, by tick and by segment, and its bytes: encoded once, shared by all who see the segment.

A client is sent what changed since the last snapshot it was sent. Most were sent the previous tick's, so one
encoding serves them all; one that skipped some gets the union of those ticks; one that is more than `HISTORY`
ticks behind, or has just begun to see the segment, gets a keyframe. Nothing is computed per entity and client.
"""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from server.faults import Faults
from shared.blocks import offset_of, pack, segment_of
from shared.checks import Cell
from shared.layout import ID, X
from shared.ring import Ring
from shared.snapshot import KEYFRAME, ROW, checksum, encode_part, encode_rows, join_part
from shared.units import BLOCK_SHIFT, SEGMENT_SHIFT
from shared.world import World

HISTORY = 64
"""Ticks for which changes are kept."""
CHECK_TICKS = 32
"""How often a segment in which something changes is sent with its checksum."""


class _Tick:
    """One tick's changes."""

    def __init__(self) -> None:
        self.changed: dict[Cell, list[int]] = defaultdict(list)  # ids by segment
        self.gone: dict[Cell, list[int]] = defaultdict(list)
        self.edited: dict[Cell, set[int]] = defaultdict(set)  # block offsets by segment
        self.acted: set[int] = set()  # ids that the rules placed or threw
        self.said: dict[Cell, set[int]] = defaultdict(set)  # ids whose attributes are news in the segment

    def segments(self) -> set[Cell]:
        return self.changed.keys() | self.gone.keys() | self.edited.keys() | self.said.keys()


class _Parts(dict[Cell, bytes]):
    """The encoded changes after one tick, each made when it is asked for first."""

    def __init__(self, log: "ChangeLog", since: int) -> None:
        self._log, self._since = log, since

    def __missing__(self, segment: Cell) -> bytes:
        try:
            part = self._log.encode(segment, self._since)
        except Exception:  # a mistake of ours about one segment leaves that one out; its checksum will find it missing
            self._log.faults.report(f"encoding segment {segment}")
            part = b""
        self[segment] = part
        return part


class ChangeLog:
    """The changes of one world. Record each tick once, after its step; then ask for parts.

    Args:
        attributes: what the game's rules say of entities, by id; whoever changes it calls `note_attributes`.
        faults: told of a segment that could not be encoded.
    """

    def __init__(
        self,
        world: World,
        attributes: Mapping[int, Mapping[str, Any]] | None = None,
        faults: Faults | None = None,
    ) -> None:
        self.faults = faults or Faults()
        self._world = world
        self._attributes = {} if attributes is None else attributes
        self._said: set[int] = set()
        self._ticks: Ring[_Tick] = Ring(HISTORY)
        self._now = _Tick()
        states = world.states()
        homes = (states[:, X : X + 3] >> (BLOCK_SHIFT + SEGMENT_SHIFT)).tolist()
        self._home: dict[int, Cell] = {
            entity: (x, y, z) for entity, (x, y, z) in zip(states[:, ID].tolist(), homes, strict=True)
        }
        self._changed: dict[int, set[Cell] | None] = {}
        self._parts: dict[int, _Parts] = {}
        self._packed: dict[Cell, tuple[int, bytes]] = {}
        self._latest: dict[Cell, bytes] | None = None
        """The packed rows of the entities that the newest tick changed, until something is removed."""

    def segment(self, entity: int) -> Cell:
        """Where an entity was at the end of the latest recorded tick."""
        return self._home[entity]

    def note_edit(self, x: int, y: int, z: int) -> None:
        """A block has changed, ahead of the coming step."""
        self._now.edited[segment_of(x, y, z)].add(offset_of(x, y, z))

    def note_act(self, entity: int) -> None:
        """The rules have placed or thrown an entity, ahead of the coming step."""
        self._now.acted.add(entity)

    def note_attributes(self, entity: int) -> None:
        """The attributes of an entity have changed, ahead of the coming step."""
        self._said.add(entity)

    def note_removal(self, entity: int) -> None:
        """An entity has been removed, ahead of the coming step."""
        self._latest = None
        home = self._home.pop(entity, None)
        if home is not None:
            self._now.gone[home].append(entity)

    def record(self) -> None:
        """Takes in what the step has changed: all of it is packed at once, in the order of segments.

        So a part of the newest tick, which nearly all are, is a slice of that: 4.9 us per client and tick became 1.7.
        """
        now, rows, homes = self._now, self._world.changed, self._home
        cells = rows[:, X : X + 3] >> (BLOCK_SHIFT + SEGMENT_SHIFT)
        order = np.lexsort((rows[:, ID], *cells.T))
        rows, cells = rows[order], cells[order]
        ids, packed = rows[:, ID].tolist(), encode_rows(rows, now.acted)
        starts = np.flatnonzero(np.any(cells[1:] != cells[:-1], axis=1)) + 1
        bounds = [0, *starts.tolist(), len(ids)] if ids else [0]
        self._latest = {}
        for start, stop, cell in zip(bounds, bounds[1:], cells[bounds[:-1]].tolist(), strict=False):
            segment = (cell[0], cell[1], cell[2])
            here = now.changed[segment] = ids[start:stop]
            self._latest[segment] = packed[start * ROW.itemsize : stop * ROW.itemsize]
            for entity in here:
                home = homes.get(entity)
                if home != segment:
                    if home is not None:
                        now.gone[home].append(entity)
                    homes[entity] = segment
                    if entity in self._attributes:
                        now.said[segment].add(entity)
        for entity in self._said & homes.keys():
            now.said[homes[entity]].add(entity)
        self._said.clear()
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

    def since(self, since: int) -> Mapping[Cell, bytes]:
        """Each segment's encoded changes after tick `since`, `KEYFRAME` or at most `HISTORY` ago; empty: none."""
        parts = self._parts.get(since)
        if parts is None:
            parts = self._parts[since] = _Parts(self, since)
        return parts

    def encode(self, segment: Cell, since: int) -> bytes:
        """A part, made anew: ask `since` for one that is shared."""
        if since == KEYFRAME:
            return self._keyframe(segment)
        changed = self.changed_segments(since)
        assert changed is not None, "lost track"
        return self._changes(segment, since) if segment in changed else b""

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
            rows = self._world.in_segment(segment)
        else:
            strays = [entity for entity, home in self._home.items() if home == segment]
            rows = self._world.rows(sorted(strays))
        return encode_part(segment, KEYFRAME, rows, attributes=self._of(rows[:, ID].tolist()))

    def _changes(self, segment: Cell, since: int) -> bytes:
        ticks = self._since(since)
        assert ticks is not None
        gone = {entity for tick in ticks for entity in tick.gone.get(segment, ()) if self._home.get(entity) != segment}
        edited = {offset for tick in ticks for offset in tick.edited.get(segment, ())}
        due = (self._world.tick + hash(segment)) % CHECK_TICKS == 0 and segment in self._world.blocks
        check = checksum(self._world, segment) if due else 0
        kinds = self._kinds(segment, sorted(edited))
        said = {entity for tick in ticks for entity in tick.said.get(segment, ()) if self._home.get(entity) == segment}
        rows = self._rows(segment, since, ticks)
        return join_part(segment, since, rows, sorted(gone), kinds, check, self._of(sorted(said)))

    def _of(self, entities: list[int]) -> list[Any]:
        """The attributes of these entities, for the wire."""
        if not self._attributes:
            return []
        return [
            part for entity in entities if (all_ := self._attributes.get(entity)) is not None for part in (entity, all_)
        ]

    def _rows(self, segment: Cell, since: int, ticks: list[_Tick]) -> bytes:
        """What changed and is still there, packed."""
        if self._latest is not None and since == self._world.tick - 1:
            return self._latest.get(segment, b"")
        here = {
            entity for tick in ticks for entity in tick.changed.get(segment, ()) if self._home.get(entity) == segment
        }
        acted = {entity for tick in ticks for entity in tick.acted if entity in here}
        return encode_rows(self._world.rows(sorted(here)), acted)

    def _kinds(self, segment: Cell, offsets: list[int]) -> list[tuple[int, int]]:
        if not offsets:
            return []
        kinds = self._world.blocks.segment(segment).reshape(-1)
        return [(offset, int(kinds[offset])) for offset in offsets]
