"""The changes of a world between two steps, without checks of their arguments, and the observer that they report to.

The methods of `shared.world.World` check their arguments and call these. An observer, if there is one, is notified of
each change and of each step: a recording consists of these calls. A change that is part of another one (a block pushes
an entity aside) is not reported by itself.
"""

from array import array
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from shared import blocks, layout
from shared.aim import NO_AIM
from shared.arrays import np
from shared.checks import Cell, SceneError, shown
from shared.extras import RESERVED
from shared.free_places import OverlapError, box_at, free_place, overlapping
from shared.inputs import BUTTONS_MAX, MOVE_PART_MAX, Input, checked_input
from shared.layout import FALLING, FLAGS, ID, TEMPLATE, Int64s, X
from shared.states import ID_MAX, STATES
from shared.units import BLOCK, SEGMENT
from shared.world_state import WorldState

LISTS = ("_awake", layout.N_AWAKE), ("_woken", layout.N_WOKEN), ("_changed", layout.N_CHANGED), ("_fell", layout.N_FELL)
"""Names of the lists that a world keeps between two steps, with the place of each list's length in `_lengths`."""


class Observer(Protocol):
    """The target of the reports of a world's changes. Each method is called after the change unless it says otherwise.

    `World.follow` and a new `next_id` are not reported.
    """

    def touching(self, low: Cell, high: Cell) -> None:
        """Is called before blocks of the segments from index `low` to index `high` (included) may change."""

    def filled(self, low: Cell, high: Cell, kind: int, push: bool) -> None:
        """Is called after `fill` or `set_block`. It may have raised `OverlapError`, which changes no block."""

    def loaded(self, world: WorldState, segment: Cell) -> None:
        """Is called after a segment was loaded or replaced."""

    def unloaded(self, segment: Cell) -> None:
        """Is called after a segment was unloaded."""

    def wrote_blocks(self, segment: Cell, offsets: list[int], kinds: list[int]) -> None:
        """Is called after blocks of a segment were written."""

    def put(self, states: Int64s) -> None:
        """Is called before states ([n, 12]) are written, and after `spawn_many`. The array may be used again later."""

    def removed(self, entity: int) -> None:
        """Is called after an entity was removed."""

    def rebased(self, tick: int) -> None:
        """Is called after the tick was set without a step."""

    def restoring(self) -> None:
        """Is called before the world becomes equal to another. It may raise, and then nothing changes."""

    def stepped(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        """Is called after a step with its inputs."""


class UncheckedWorld(WorldState):
    """A world without checks of arguments. Games use `shared.world.World`, which checks them."""

    observer: Observer | None = None
    """Target of the reports of all changes; None: there is none."""

    def _load(self, index: Cell, kinds: blocks.Kinds) -> None:
        """Adds or replaces a segment, and wakes the entities that overlap or touch it."""
        observer = self.observer
        if observer is not None:
            observer.touching(index, index)
        if self.blocks.load(index, kinds):
            self._bind()
        if self._lengths[layout.N_HOMELESS]:
            self.kernel.relink_range(self.bound, 0, self._rows)
        self._wake_segment(index)
        if observer is not None:
            observer.loaded(self, index)

    def _unload(self, index: Cell) -> None:
        """Removes a segment without entities.

        Raises:
            MissingError: the segment is not loaded.
        """
        observer = self.observer
        if observer is not None:
            observer.touching(index, index)
        self.blocks.unload(index)
        self._wake_segment(index)  # below the scene's floor, a segment that is not loaded is void, so things may fall
        if observer is not None:
            observer.unloaded(index)

    def _fill(self, low: Cell, high: Cell, kind: int, push: bool) -> int:
        """Sets every block of a box (`high` excluded), or none. Returns the number of blocks that changed.

        Raises:
            OverlapError: a solid entity is in the way (and, with `push`, cannot be pushed out of it).
            SceneError: a segment is not loaded.
        """
        observer = self.observer
        if observer is None:
            return self._set_box(low, high, kind, push)
        x, y, z = high
        observer.touching(blocks.segment_of(*low), blocks.segment_of(x - 1, y - 1, z - 1))
        try:
            changed = self._set_box(low, high, kind, push)
        except OverlapError:
            observer.filled(low, high, kind, push)  # entities may have been woken
            raise
        observer.filled(low, high, kind, push)
        return changed

    def _set_box(self, low: Cell, high: Cell, kind: int, push: bool) -> int:
        changed = self.blocks.different(low, high, kind)
        in_the_way: list[int] = []
        stops = self.blocks.stops
        if stops[kind]:
            in_the_way = overlapping(self, -1, [part * BLOCK for part in (*low, *high)])
            if in_the_way and not push:
                raise OverlapError(f"blocks {low} to {high}: entity {in_the_way[0]} is there")
        for (x, y, z), before in changed:
            self.blocks.set(x, y, z, kind)
            self.editing.setdefault((x, y, z), before)
            if stops[before] and not stops[kind]:
                face = (x * BLOCK, y * BLOCK, (x + 1) * BLOCK, (y + 1) * BLOCK, (z + 1) * BLOCK)
                self.kernel.wake_on(self.bound, -1, *face)
        if not in_the_way:
            return len(changed)
        states, placing = self.states_of(in_the_way), set(self.placing)
        try:
            for entity in in_the_way:
                self._store(np.array([self._placed(entity, self.position(entity), push=True)], np.int64))
                self.placing.add(entity)
        except OverlapError:
            for cell, before in changed:
                self.blocks.set(*cell, before)
            self._store(states)
            self.placing = placing
            raise
        return len(changed)

    def _write_blocks(self, segment: Cell, offsets: list[int], kinds: list[int]) -> None:
        """Changes blocks of a loaded segment (by index z << 10 | y << 5 | x) without a look for entities in the way."""
        observer = self.observer
        if observer is not None:
            observer.touching(segment, segment)
        for at, kind in zip(offsets, kinds, strict=True):
            x, y, z = (
                part * SEGMENT + ((at >> shift) & (SEGMENT - 1))
                for part, shift in zip(segment, (0, 5, 10), strict=True)
            )
            self.editing.setdefault((x, y, z), self.blocks.get(x, y, z) or blocks.AIR)
            self.blocks.set(x, y, z, kind)
            self.kernel.wake_on(self.bound, -1, x * BLOCK, y * BLOCK, (x + 1) * BLOCK, (y + 1) * BLOCK, (z + 1) * BLOCK)
        if observer is not None:
            observer.wrote_blocks(segment, offsets, kinds)

    def _placed(self, entity: int, position: object, *, push: bool) -> tuple[int, ...]:
        """Returns the state of an entity as it would be at a free place: at the position, or with `push` near it.

        Raises:
            MissingError: there is no such entity.
            OverlapError: the place is occupied (and, with `push`, so are the places near it).
            SceneError: the position is not finite or out of range.
        """
        row = self._row_at(entity)
        state = list(self.state(entity))
        state[X : X + 3] = free_place(self, row, state[TEMPLATE], position, push)
        return tuple(state)

    def _put(self, states: Iterable[tuple[int, ...]] | Int64s) -> None:
        """Writes states; ids that are not known become new entities."""
        new = np.asarray(states if isinstance(states, np.ndarray) else list(states), np.int64)
        width = new.shape[-1] if self.extras.count and new.size else STATES
        new = self.extras.widened(new.reshape(-1, width))
        if self.observer is not None:
            self.observer.put(new)
        self._store(new)

    def _store(self, new: Int64s) -> None:
        """Writes states ([n, 12], and the extra columns of the scene) without a report."""
        ids = new[:, ID].tolist()
        known = list(map(self._row_of.get, ids))
        rows = np.array([self._row(entity) for entity in ids] if None in known else known, np.int64)
        extras = self.extras
        if extras.count:
            self._extra[rows] = new[:, STATES:]
            for entity, alive in zip(ids, new[:, STATES + extras.alive].tolist(), strict=True) if extras.spawns else ():
                if alive & RESERVED:
                    self._next_id = max(self._next_id, entity + 1 + extras.spawns)
            if self.turns is not None:
                self.turns.rows = None
            new = np.ascontiguousarray(new[:, :STATES])
        self.kernel.store(self.bound, self.kernel.lent(rows), self.kernel.lent(new), len(rows), self.tick + 1)

    def add(self, template: int, position: Iterable[int], velocity: Sequence[int] = (0, 0, 0)) -> int:
        """Adds an entity at a place that is free, in grid steps and velocity steps, and returns its id."""
        entity, extras, observer = self._next_id, self.extras, self.observer
        if entity + extras.blocks[template] > ID_MAX:
            raise SceneError("ids: used up")
        state = entity, template, self._thrown(template, velocity[2]), *position, *velocity, 0, 0, 0
        if extras.count:
            self._put([(*state, *extras.new[template].tolist())])
            return entity
        self._one_state[:] = array("q", state)
        if observer is not None:
            observer.put(self._one)
        self._one_row[0] = self._row(entity)
        self.kernel.store(self.bound, *self._adding, 1, self.tick + 1)
        return entity

    def _settle(self, template: int, positions: Int64s) -> int:
        """Adds entities at rest, in order, until one has no room. Returns how many have room; then it removes them all.

        Args:
            template: number of the entities' template.
            positions: [n, 3] in grid steps.
        """
        n, first = len(positions), self._next_id
        ids = self._new_ids(template, n)
        states = np.zeros((n, STATES), np.int64)
        states[:, ID] = ids
        states[:, TEMPLATE] = template
        states[:, X : X + 3] = positions
        rows = np.array([self._row(entity) for entity in ids], np.int64)
        if self.extras.count:
            self._extra[rows] = self.extras.new[template]
        self._next_id = ids.stop
        if self.turns is not None:
            self.turns.rows = None
        settled: int = self.kernel.settle(
            self.bound, self.kernel.lent(rows), self.kernel.lent(states), n, self.tick + 1
        )
        if settled < n:
            for entity in ids[settled:]:
                self._free.append(self._row_of.pop(entity))
                self._ordered = None
            for entity in ids[:settled]:
                self._take_out(entity)
            self._next_id = first
        elif n and self.observer is not None:
            self.observer.put(self.states_of(ids))
        return settled

    def _new_ids(self, template: int, n: int) -> range:
        """Returns the ids of `n` new entities of a template; between them are the ids that belong to each of them."""
        step = 1 + self.extras.blocks[template]
        return range(self._next_id, self._next_id + n * step, step)

    def _remove(self, entity: int) -> None:
        """Removes an entity, and wakes the entities that stood on it."""
        self._disown(entity)
        self._take_out(entity)
        if self.observer is not None:
            self.observer.removed(entity)

    def _take_out(self, entity: int) -> None:
        """Removes an entity without a report."""
        row = self._row_of.pop(entity)
        self._ordered = None
        if self.turns is not None:
            self.turns.rows = None
        self._leave(row)
        self.kernel.unlink(self.bound, row)
        self._entities[row, ID] = 0
        (self._limbo if self._entities[row, FLAGS] & layout.AWAKE else self._free).append(row)

    def owner(self, entity: int) -> int | None:
        """Returns the entity whose behaviour has spawned an entity; None if there is none, or it is gone."""
        extras = self.extras
        for owner in range(entity - extras.spawns, entity) if extras.spawns else ():
            row = self._row_of.get(owner)
            if row is not None and int(self._extra[row, extras.alive]) & 1 << entity - owner - 1:
                return owner
        return None

    def _disown(self, entity: int) -> None:
        """Notes that an entity is about to be removed, in the entity that has spawned it, if there is one."""
        owner = self.owner(entity)
        if owner is not None:
            alive = self.extras.alive
            self._extra[self._row_of[owner], alive] &= ~(1 << entity - owner - 1)
            self.note_fields(owner, 1 << alive)

    def note_fields(self, entity: int, mask: int) -> None:
        """Notes that extra columns of an entity were set in its row in memory."""
        self._fields_setting[entity] = self._fields_setting.get(entity, 0) | mask

    def _thrown(self, template: int, speed: int) -> int:
        """Returns the flags for a vertical speed: an entity that moves up falls, even if something supports it.

        Args:
            template: number of the entity's template.
            speed: vertical speed in velocity steps.
        """
        return FALLING if speed > 0 and self.templates[template, layout.WEIGHT] else 0

    def _wake_segment(self, index: Cell) -> None:
        """Wakes the entities that overlap or touch a segment."""
        low = [part * SEGMENT * BLOCK for part in index]
        self.kernel.wake_in(self.bound, *low, *(part + SEGMENT * BLOCK for part in low))

    def _leave(self, row: int) -> None:
        """Wakes the entities that stand on an entity that is about to be removed or changed."""
        box = box_at(self, int(self._entities[row, TEMPLATE]), self._entities[row, X : X + 3].tolist())
        self.kernel.wake_on(self.bound, row, box[0], box[1], box[3], box[4], box[5])

    def _told_of(self, inputs: Mapping[int, Input]) -> list[int]:
        """Returns inputs as the kernel takes them: row, move_x, move_y and buttons for each.

        In a scene with aim, the aims must have been checked before.
        """
        told: list[int] = []
        rows, most, aims = self._row_of, MOVE_PART_MAX, self.scene.aim
        try:
            for entity, (x, y, buttons, aim) in inputs.items():
                if not (
                    type(x) is type(y) is type(buttons) is int
                    and -most <= x <= most >= y >= -most
                    and 0 <= buttons <= BUTTONS_MAX
                    and (aims or aim is NO_AIM)
                ):
                    raise ValueError
                told += (rows[entity], x, y, buttons)
        except (KeyError, TypeError, ValueError):  # one of them has an aim, is wrong, or has numbers of numpy
            told = []
            for entity, given in inputs.items():
                input_ = checked_input(given, f"inputs[{entity}]")
                self.scene.check_aim(input_.aim, f"inputs[{entity}].aim")
                told += (self._row_at(entity), *input_[:3])
        return told

    def _rebase(self, tick: int) -> None:
        """Sets the tick without a step."""
        self._entities[: self._rows, layout.CHANGED] = -1  # the new tick may be an earlier one
        self._lengths[layout.N_CHANGED] = self._lengths[layout.N_FELL] = 0
        self._arrive(tick)
        if self.observer is not None:
            self.observer.rebased(tick)

    def _arrive(self, tick: int) -> None:
        """Sets the tick and forgets what changed before it."""
        self.tick = tick
        self.editing, self.edited = {}, {}
        self.placing, self.placed = set(), set()
        self._fields_setting, self.fields_set = {}, {}
        if self._limbo:
            for name, length in (("_awake", layout.N_AWAKE), ("_woken", layout.N_WOKEN)):
                keys = getattr(self, name)[: self._lengths[length]]
                alive = np.sort(keys[self._entities[keys & 0xFFFFFFFF, ID] == keys >> 32])
                getattr(self, name)[: len(alive)] = alive
                self._lengths[length] = len(alive)
            self._free += self._limbo
            self._limbo.clear()

    def restore(self, other: WorldState) -> None:
        """Makes this world equal to `other`, a world of the same scene. Cheap if few segments differ.

        Raises:
            SceneError: `other` is not a world of the same scene.
        """
        if self.observer is not None:
            self.observer.restoring()
        source: object = other
        if not isinstance(source, WorldState):
            raise SceneError(f"other = {shown(source)}: must be a `World`")
        theirs, mine = other.scene, self.scene
        if theirs is not mine and theirs.fingerprint != mine.fingerprint:
            differ = sorted(name for name, digest in mine.digests.items() if theirs.digests[name] != digest)
            raise SceneError(f"other = a world of {theirs.name!r}: its scene differs in {', '.join(differ)}")
        before, moved = self._rows, len(self._entities) != len(other._entities)
        if moved:
            self._allocate(len(other._entities))
        self.editing, self.edited = dict(other.editing), dict(other.edited)
        self.placing, self.placed = set(other.placing), set(other.placed)
        self.tick, self._next_id, self._rows = other.tick, other._next_id, other._rows
        self._row_of, self._free, self._limbo = dict(other._row_of), list(other._free), list(other._limbo)
        self._ordered, self._dense = other._ordered, other._dense
        n = self._rows
        self._entities[:n] = other._entities[:n]
        if self.extras.count:
            self._extra[:n] = other._extra[:n]
            self._fields_setting, self.fields_set = dict(other._fields_setting), dict(other.fields_set)
            if self.turns is not None:
                self.turns.rows = None
        if before > n:
            self._entities[n:before, ID] = 0
        self._lengths[:] = other._lengths
        for name, length in LISTS:
            count = int(self._lengths[length])
            getattr(self, name)[:count] = getattr(other, name)[:count]
        moved |= self.blocks.restore(other.blocks)
        if moved:
            self._bind()
