"""A world: blocks, entities and a tick, and the one function that takes it to the next.

    world = World(load_scene("hills"))
    world.load_terrain()
    player = world.spawn("player", (64, 64, 30))
    world.step({player: make_input(1, 0, jump=True)})

The world changes only here: by the methods below between ticks, and by `step`. Two worlds of one scene that
are told the same in the same order have the same `state_hash()` at every tick, on every machine, compiled or not.
"""

import hashlib
import math
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shared import blocks, kernels, layout, terrain
from shared.checks import Cell, MissingError, SceneError, boolean, cell, shown, vector, whole
from shared.inputs import BUTTONS_MAX, WISH_MAX, Input, checked_input
from shared.layout import ENTITY, FALLING, FLAGS, ID, NEXT, PREV, TEMPLATE, VX, Arrays, X
from shared.scene import Scene
from shared.states import ID_MAX, STATES, checked_states
from shared.units import BLOCK, RANGE_BLOCKS, SEGMENT, SPEED, to_position, to_positions, to_velocity

HASH_BYTES = 20
"""Bytes of a world's hash."""
SEGMENT_MAX = RANGE_BLOCKS // SEGMENT
"""No index of a segment is further from 0 along an axis."""
FILL_MAX = 1 << 20
"""The most blocks that one `fill` sets."""
TICK_MAX = (1 << 53) - 1
COLLECT_MAX = 1024
"""Up to so many rows, the kernel sorts states by insertion: 1 us for some ten, instead of 9."""


class OverlapError(SceneError):
    """A place is taken: by a block, or by a solid entity."""


class World:
    """All of a scene's state at one tick.

    What names an entity raises `MissingError` (a `KeyError`) if there is none of that number. A wrong value raises
    `SceneError`, with the field and the value in its text, before anything has changed.

    Args:
        scene: the rules.
        compiled: run a compiled kernel, or the plain one; None: the one that `kernels` chooses.
    """

    def __init__(self, scene: Scene, *, compiled: bool | None = None) -> None:
        rules: object = scene
        if not isinstance(rules, Scene):
            raise SceneError(f"scene = {shown(rules)}: must be a `Scene`")
        self.scene = scene
        self.tick = 0
        """How many ticks have passed; see `rebase`."""
        self.blocks = blocks.Blocks()
        self.kernel = kernels.get(compiled)
        """What steps it; its functions are for all that works on this world."""
        self._templates, self._walk, self._parameters = scene.kernel_tables()
        self._row_of: dict[int, int] = {}
        self._next_id = 1
        self._rows = 0  # rows ever used
        self._free: list[int] = []
        self._limbo: list[int] = []  # freed since the last step: still in the kernel's lists
        self._lengths = np.zeros(layout.LENGTHS, np.int64)
        self.editing: dict[Cell, int] = {}
        """The blocks changed since the latest step, and their kinds until then."""
        self.edited: dict[Cell, int] = {}
        """The blocks changed between the latest step and the one before it, and their kinds until then."""
        self.placing: set[int] = set()
        """The entities placed since the latest step."""
        self.placed: set[int] = set()
        """The entities placed between the latest step and the one before it: they did not come here by moving."""
        self._inputs = np.zeros(32, np.int64)
        self._entities = np.zeros((0, len(layout.COLUMNS)), np.int64)
        self._awake = self._next_awake = self._woken = self._later = np.zeros(0, np.int64)
        self._changed = self._fell = np.zeros(0, np.int64)
        self._allocate(8)
        self._bind()
        self._told = self.kernel.lent(self._inputs)

    # -- reading -------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, entity: object) -> bool:
        return isinstance(entity, int | np.integer) and not isinstance(entity, bool) and entity in self._row_of

    @property
    def entities(self) -> np.ndarray[Any, np.dtype[Any]]:
        """Every entity as a structured array (`layout.ENTITY`, grid steps), in ascending order of id. A copy."""
        return self.rows(sorted(self._row_of)).view(ENTITY).reshape(-1)

    def rows(self, entities: Iterable[int]) -> layout.Int64s:
        """Some entities as an int64 matrix [n, 16] in the order asked for (columns as in `layout`). A copy."""
        asked = list(entities)
        try:
            rows = [self._row_of[entity] for entity in asked]
        except (KeyError, TypeError):
            rows = [self._row_at(entity) for entity in asked]
        return self._entities[rows]

    def states(self) -> layout.Int64s:
        """The whole states of all entities, [n, 12], ascending by id: equal worlds have equal ones. A copy."""
        if self.compiled and self._rows <= COLLECT_MAX:
            out = np.empty((self._rows, STATES), np.int64)
            return out[: self.kernel.collect(self._arrays.entities, self._rows, self.kernel.lent(out))]
        rows: layout.Int64s = self._entities[: self._rows, :STATES]
        rows = rows[rows[:, ID] != 0]
        rows = rows[np.argsort(rows[:, ID])]
        rows[:, FLAGS] &= FALLING
        return rows

    def state(self, entity: int) -> tuple[int, ...]:
        """The whole state of one entity as 12 whole numbers (the columns before `cell`)."""
        state = self._entities[self._row_at(entity), :STATES].copy()
        state[FLAGS] &= FALLING
        return tuple(state.tolist())

    def position(self, entity: int) -> tuple[float, float, float]:
        """Where an entity is, in blocks."""
        x, y, z = self._entities[self._row_at(entity), X : X + 3].tolist()
        return x / BLOCK, y / BLOCK, z / BLOCK

    def velocity(self, entity: int) -> tuple[float, float, float]:
        """How fast an entity is, in blocks/s."""
        x, y, z = self._entities[self._row_at(entity), VX : VX + 3].tolist()
        return x / SPEED, y / SPEED, z / SPEED

    def falling(self, entity: int) -> bool:
        """Whether the gravity flag of an entity is up: it falls, or rises."""
        return bool(self._entities[self._row_at(entity), FLAGS] & FALLING)

    def awake(self, entity: int) -> bool:
        """Whether an entity will have a turn in the next tick without an input."""
        return bool(self._entities[self._row_at(entity), FLAGS] & layout.AWAKE)

    @property
    def awake_count(self) -> int:
        """How many entities have a turn in the next tick."""
        return int(self._lengths[layout.N_AWAKE] + self._lengths[layout.N_WOKEN])

    @property
    def changed(self) -> layout.Int64s:
        """The entities that the latest step changed, or that were written since the one before it, [n, 16]. A copy."""
        rows: layout.Int64s = self._entities[self._changed[: self._lengths[layout.N_CHANGED]]]
        alive: layout.Int64s = rows[rows[:, ID] != 0]
        return alive

    @property
    def matrix(self) -> layout.Int64s:
        """Every row as it lies, [rows ever used, 16], free ones with id 0. A view, read-only."""
        view: layout.Int64s = self._entities[: self._rows]
        view.flags.writeable = False
        return view

    @property
    def compiled(self) -> bool:
        """Whether its kernel is a compiled one."""
        return self.kernel.compiled

    @property
    def arrays(self) -> Arrays:
        """All that the kernel works on, as it lies now: to be read, by other functions of it."""
        return self._arrays

    @property
    def next_id(self) -> int:
        """The id of the next entity to be spawned.

        Raises:
            SceneError: it was set to a lower one than it is, or to more than there are.
        """
        return self._next_id

    @next_id.setter
    def next_id(self, entity: int) -> None:
        self._next_id = whole(entity, "next_id", self._next_id, ID_MAX + 1)

    @property
    def fell(self) -> list[int]:
        """The entities that the latest step left below the scene's floor."""
        fell: list[int] = self._fell[: self._lengths[layout.N_FELL]].tolist()
        return fell

    def in_segment(self, index: Cell) -> layout.Int64s:
        """The entities whose position lies in a loaded segment, [n, 16], ascending by id. A copy.

        Raises:
            MissingError: the segment is not loaded.
        """
        row = self.blocks.row(index)
        found: list[int] = []
        heads = self.blocks.heads[row * layout.CELLS : (row + 1) * layout.CELLS]
        for head in heads[heads >= 0].tolist():
            while head >= 0:
                found.append(head)
                head = int(self._entities[head, NEXT])
        rows = self._entities[found]
        return rows[np.argsort(rows[:, ID])]

    def state_hash(self, entities: Iterable[int] | None = None) -> bytes:
        """20 bytes over the tick, all blocks and all entities (or just some, and then no blocks)."""
        if entities is None:
            self.blocks.freshen()
            rows = list(self.blocks.rows.values())
            return hash_of(self.tick, self.blocks.segments[rows], self.blocks.digests[rows], self.states())
        cells, digests = np.zeros((0, 3), np.int64), np.zeros((0, blocks.DIGEST_BYTES), np.uint8)
        states = self.rows(sorted(entities))[:, :STATES]
        states[:, FLAGS] &= FALLING
        return hash_of(self.tick, cells, digests, states)

    # -- blocks --------------------------------------------------------------------------------------------

    def load_terrain(self, indices: Iterable[Cell] | None = None) -> None:
        """Generates segments by the scene's generator (all of the scene's by default)."""
        for index in self.scene.segments() if indices is None else indices:
            segment = _segment(index)
            self._load(segment, terrain.generate(self.scene.terrain, segment))

    def load_segment(self, index: Cell, kinds: blocks.Kinds) -> None:
        """Adds or replaces a segment ([32768] kinds) and wakes what may stand on it or have waited for it."""
        self._load(_segment(index), blocks.checked_kinds(kinds))

    def _load(self, index: Cell, kinds: blocks.Kinds) -> None:
        if self.blocks.load(index, kinds):
            self._bind()
        if self._lengths[layout.N_HOMELESS]:
            self.kernel.relink_range(self._bound, 0, self._rows)
        self._wake_segment(index)

    def unload_segment(self, index: Cell) -> None:
        """Forgets a segment; it is solid from then on.

        Raises:
            MissingError: it is not loaded.
            OverlapError: entities are still in it.
        """
        segment = _segment(index)
        if len(self.in_segment(segment)):
            raise OverlapError(f"segment {segment}: entities are in it")
        self._unload(segment)

    def _unload(self, index: Cell) -> None:
        self.blocks.unload(index)
        self._wake_segment(index)  # below the scene's floor, what is not loaded is void

    def block(self, x: int, y: int, z: int) -> int | None:
        """The kind of a block; None where no segment is loaded."""
        return self.blocks.get(*_block(x, y, z))

    def set_block(self, x: int, y: int, z: int, kind: int, *, push: bool = False) -> bool:
        """Places (kind 1 to 255) or removes (0) a block; whether anything changed. Raises as `fill` does."""
        x, y, z = _block(x, y, z)
        kind, push = whole(kind, "kind", blocks.AIR, blocks.KIND_MAX), boolean(push, "push")
        return self._fill((x, y, z), (x + 1, y + 1, z + 1), kind, push) > 0

    def fill(self, low: Cell, high: Cell, kind: int, *, push: bool = False) -> int:
        """Sets every block of the box between two corners (`high` excluded), or none; returns how many changed.

        With `push`, solid entities in the way go to their nearest free places as in `place`, in ascending order of id.

        Raises:
            OverlapError: a solid entity is in the way (and, with `push`, cannot be pushed out of it).
            SceneError: not a kind, more than `FILL_MAX` blocks, or no segment is loaded there.
        """
        low, high = (cell(corner, at, -RANGE_BLOCKS, RANGE_BLOCKS) for corner, at in ((low, "low"), (high, "high")))
        kind, push = whole(kind, "kind", blocks.AIR, blocks.KIND_MAX), boolean(push, "push")
        sides = [b - a for a, b in zip(low, high, strict=True)]
        if min(sides) < 0:
            raise SceneError(f"high = {high}: must not be below low = {low} along any axis")
        if math.prod(sides) > FILL_MAX:
            raise SceneError(f"low = {low}, high = {high}: {math.prod(sides)} blocks; at most {FILL_MAX} at once")
        return self._fill(low, high, kind, push) if min(sides) else 0

    def _fill(self, low: Cell, high: Cell, kind: int, push: bool) -> int:
        changed = self.blocks.different(low, high, kind)
        in_the_way: list[int] = []
        if kind != blocks.AIR:
            in_the_way = self._overlapping(-1, [part * BLOCK for part in (*low, *high)])
            if in_the_way and not push:
                raise OverlapError(f"blocks {low} to {high}: entity {in_the_way[0]} is there")
        for (x, y, z), before in changed:
            self.blocks.set(x, y, z, kind)
            self.editing.setdefault((x, y, z), before)
            if kind == blocks.AIR:
                face = (x * BLOCK, y * BLOCK, (x + 1) * BLOCK, (y + 1) * BLOCK, (z + 1) * BLOCK)
                self.kernel.wake_on(self._bound, -1, *face)
        states, placing = [self.state(entity) for entity in in_the_way], set(self.placing)
        try:
            for entity in in_the_way:
                self.place(entity, self.position(entity), push=True)
        except OverlapError:
            for cell, before in changed:
                self.blocks.set(*cell, before)
            self._put(states)
            self.placing = placing
            raise
        return len(changed)

    # -- entities ------------------------------------------------------------------------------------------

    def spawn(
        self,
        template: str,
        position: tuple[float, float, float],
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        push: bool = False,
    ) -> int:
        """Adds an entity and returns its id; ids ascend and are never used again.

        Args:
            template: its name in the scene.
            position: in blocks, rounded to the grid.
            velocity: in blocks/s, rounded to the grid.
            push: if the place is taken, use the nearest free one, at most a block away along one axis.

        Raises:
            OverlapError: the place is taken (and, with `push`, so is everything near).
            SceneError: a value is not finite or out of range, or there is no such template.
        """
        kind = self.scene.template(template)
        at = self._free_place(-1, kind, position, boolean(push, "push"))
        speed = _velocity(velocity)
        if self._next_id > ID_MAX:
            raise SceneError("ids: used up")
        entity = self._next_id
        self._put([(entity, kind, self._thrown(speed[2]), *at, *speed, 0, 0, 0)])
        return entity

    def spawn_many(self, template: str, positions: npt.ArrayLike) -> range:
        """Adds entities at rest, all or none, as `spawn` would one after the other; their ids, in order.

        Args:
            template: its name in the scene.
            positions: [n, 3] in blocks, rounded to the grid.

        Raises:
            OverlapError: a place is taken, if only by an earlier one.
            SceneError: a value is not finite or out of range, or there is no such template.
        """
        kind = self.scene.template(template)
        at = to_positions(positions, "positions")
        n, first = len(at), self._next_id
        if first + n - 1 > ID_MAX:
            raise SceneError("ids: used up")
        ids = range(first, first + n)
        states = np.zeros((n, STATES), np.int64)
        states[:, ID] = ids
        states[:, TEMPLATE] = kind
        states[:, X : X + 3] = at
        rows = np.array([self._row(entity) for entity in ids], np.int64)
        settled = self.kernel.settle(self._bound, self.kernel.lent(rows), self.kernel.lent(states), n, self.tick + 1)
        if settled < n:
            for entity in ids[settled:]:
                self._free.append(self._row_of.pop(entity))
            for entity in ids[:settled]:
                self._remove(entity)
            self._next_id = first
            place = (at[settled] / BLOCK).tolist()
            raise OverlapError(f"positions[{settled}] = {place}: no room for a {template!r} there")
        return ids

    def place(self, entity: int, position: tuple[float, float, float], *, push: bool = False) -> None:
        """Teleports an entity, which keeps its velocity. Raises as `spawn` does, and `MissingError`."""
        row = self._row_at(entity)
        state = list(self.state(entity))
        state[X : X + 3] = self._free_place(row, state[TEMPLATE], position, boolean(push, "push"))
        self._put([tuple(state)])
        self.placing.add(state[ID])

    def set_velocity(self, entity: int, velocity: tuple[float, float, float]) -> None:
        """Throws an entity, in blocks/s; upwards raises its gravity flag. Raises as `place` does."""
        state = list(self.state(entity))
        state[VX : VX + 3] = _velocity(velocity)
        state[FLAGS] |= self._thrown(state[VX + 2])
        self._put([tuple(state)])

    def set_template(self, entity: int, template: str) -> None:
        """Changes what an entity is, and so its box. Raises as `place` does."""
        row = self._row_at(entity)
        state = list(self.state(entity))
        state[TEMPLATE] = self.scene.template(template)
        box = self._box_at(state[TEMPLATE], state[X : X + 3])
        if self._taken(row, state[TEMPLATE], box):
            raise OverlapError(f"entity {entity}: no room for the box of {template!r}")
        self._put([tuple(state)])

    def remove(self, entity: int) -> None:
        """Takes an entity out of the world and wakes what stood on it."""
        self._row_at(entity)
        self._remove(int(entity))

    def _remove(self, entity: int) -> None:
        row = self._row_of.pop(entity)
        self._leave(row)
        self.kernel.unlink(self._bound, row)
        self._entities[row, ID] = 0
        (self._limbo if self._entities[row, FLAGS] & layout.AWAKE else self._free).append(row)

    def put(self, states: Iterable[tuple[int, ...]] | layout.Int64s) -> None:
        """Writes whole states ([n, 12], as `state` gives them), new or known, as they are: nothing is in their way."""
        self._put(checked_states(states, len(self.scene.templates)))

    def write(self, states: layout.Int64s) -> None:
        """Writes whole states as `put` does, without its checks: for what `snapshot.decode_parts` has checked."""
        self._put(states)

    def _put(self, states: Iterable[tuple[int, ...]] | layout.Int64s) -> None:
        new = np.asarray(states if isinstance(states, np.ndarray) else list(states), np.int64).reshape(-1, STATES)
        ids = new[:, ID].tolist()
        known = list(map(self._row_of.get, ids))
        rows = np.array([self._row(entity) for entity in ids] if None in known else known, np.int64)
        self.kernel.store(self._bound, self.kernel.lent(rows), self.kernel.lent(new), len(rows), self.tick + 1)

    def write_blocks(self, segment: Cell, offsets: Iterable[int], kinds: Iterable[int]) -> None:
        """Changes blocks of a loaded segment (by index z << 10 | y << 5 | x), as they are: nothing is in their way.

        Raises:
            MissingError: the segment is not loaded.
        """
        where, what = list(offsets), list(kinds)
        if len(where) != len(what):
            raise SceneError(f"kinds: {len(what)} of them, for {len(where)} offsets")
        segment = _segment(segment)
        self.blocks.row(segment)
        where = [whole(at, f"offsets[{i}]", 0, blocks.BLOCKS - 1) for i, at in enumerate(where)]
        self._write_blocks(
            segment, where, [whole(kind, f"kinds[{i}]", 0, blocks.KIND_MAX) for i, kind in enumerate(what)]
        )

    def _write_blocks(self, segment: Cell, offsets: list[int], kinds: list[int]) -> None:
        for at, kind in zip(offsets, kinds, strict=True):
            x, y, z = (
                part * SEGMENT + ((at >> shift) & (SEGMENT - 1))
                for part, shift in zip(segment, (0, 5, 10), strict=True)
            )
            self.editing.setdefault((x, y, z), self.blocks.get(x, y, z) or blocks.AIR)
            self.blocks.set(x, y, z, kind)
            self.kernel.wake_on(
                self._bound, -1, x * BLOCK, y * BLOCK, (x + 1) * BLOCK, (y + 1) * BLOCK, (z + 1) * BLOCK
            )

    def follow(self, turns: layout.Int64s, ticks: int, tick: int) -> bool:
        """Takes a world that is written and never stepped on by some ticks, the last of which is `tick`: what has no
        turn in `turns` goes on as it did, with nothing in its way, but does not leave its segment.

        Args:
            turns: of those that do not, [n, 8]: id, events (`layout.STOP_X` ...), wish (3), position (3; only that
                within its segment, along axes where it stopped). Only where `ticks` is 1. Is written to.

        Returns:
            Whether there is an entity for every turn.
        """
        if turns.dtype != np.int64 or turns.ndim != 2 or turns.shape[1] != layout.TURN:
            raise SceneError(f"turns = {shown(turns)}: must be int64 rows of {layout.TURN}")
        if len(turns):
            row_of = self._row_of
            turns[:, 0] = [row_of.get(entity, -1) for entity in turns[:, 0].tolist()]
        there = self.kernel.follow(self._bound, self.kernel.lent(turns), len(turns), self._rows, ticks, self.tick + 1)
        self._rebased(tick)
        return bool(there)

    def rebase(self, tick: int) -> None:
        """Declares what has been written to be the world at the end of `tick`, without a step."""
        self._rebase(whole(tick, "tick", -1, TICK_MAX))

    def _rebase(self, tick: int) -> None:
        self._entities[: self._rows, layout.CHANGED] = -1  # it may be a tick that has been before
        self._lengths[layout.N_CHANGED] = self._lengths[layout.N_FELL] = 0
        self._rebased(tick)

    def _rebased(self, tick: int) -> None:
        self.tick = tick
        self.editing, self.edited = {}, {}
        self.placing, self.placed = set(), set()
        if self._limbo:
            for name, length in (("_awake", layout.N_AWAKE), ("_woken", layout.N_WOKEN)):
                keys = getattr(self, name)[: self._lengths[length]]
                alive = np.sort(keys[self._entities[keys & 0xFFFFFFFF, ID] == keys >> 32])
                getattr(self, name)[: len(alive)] = alive
                self._lengths[length] = len(alive)
            self._free += self._limbo
            self._limbo.clear()

    # -- time ----------------------------------------------------------------------------------------------

    def step(self, inputs: Mapping[int, Input] | None = None) -> None:
        """One tick: `inputs` by entity id; an entity without one goes on with its latest."""
        n = len(inputs) if inputs else 0
        if inputs:
            told = self._told_of(inputs)
            if len(told) > len(self._inputs):
                self._inputs = np.zeros(2 * len(told), np.int64)
                self._told = self.kernel.lent(self._inputs)
            self._inputs[: len(told)] = told
        self.tick += 1
        self.edited, self.editing = self.editing, {}
        if self.placing or self.placed:
            self.placed, self.placing = self.placing, set()
        self.kernel.step(self._bound, self._told, n, self.tick)
        if self._limbo:
            self._free += self._limbo
            self._limbo.clear()

    def _told_of(self, inputs: Mapping[int, Input]) -> list[int]:
        """Inputs as the kernel wants them: the row, the move intent and the buttons of each."""
        told: list[int] = []
        rows, most = self._row_of, WISH_MAX
        try:
            for entity, (x, y, buttons) in inputs.items():
                if not (
                    type(x) is type(y) is type(buttons) is int
                    and -most <= x <= most >= y >= -most
                    and 0 <= buttons <= BUTTONS_MAX
                ):
                    raise ValueError
                told += (rows[entity], x, y, buttons)
        except (KeyError, TypeError, ValueError):  # one of them is not right, or numpy's
            told = []
            for entity, wish in inputs.items():
                told += (self._row_at(entity), *checked_input(wish, f"inputs[{entity}]"))
        return told

    def copy(self) -> "World":
        """Another world in the same state."""
        other = World(self.scene, compiled=self.compiled)
        other.restore(self)
        return other

    def restore(self, other: "World") -> None:
        """Becomes equal to `other`, a world of the same scene; cheap where little differs.

        Raises:
            SceneError: it is not of the same scene.
        """
        source: object = other
        if not isinstance(source, World):
            raise SceneError(f"other = {shown(source)}: must be a `World`")
        theirs, mine = other.scene, self.scene
        if theirs is not mine and theirs.fingerprint != mine.fingerprint:
            differ = sorted(name for name, digest in mine.digests.items() if theirs.digests[name] != digest)
            raise SceneError(f"other = a world of {theirs.name!r}: its scene has another {', '.join(differ)}")
        cells = self._entities[: self._rows, layout.CELL]
        self.blocks.heads[cells[cells >= 0]] = -1
        moved = len(self._entities) != len(other._entities)
        if moved:
            self._allocate(len(other._entities))
        self.editing, self.edited = dict(other.editing), dict(other.edited)
        self.placing, self.placed = set(other.placing), set(other.placed)
        self.tick, self._next_id, self._rows = other.tick, other._next_id, other._rows
        self._row_of, self._free, self._limbo = dict(other._row_of), list(other._free), list(other._limbo)
        n = self._rows
        self._entities[:n] = other._entities[:n]
        self._entities[n:, ID] = 0
        self._lengths[:] = other._lengths
        for name, length in LISTS:
            count = int(self._lengths[length])
            getattr(self, name)[:count] = getattr(other, name)[:count]
        moved |= self.blocks.restore(other.blocks)
        rows = self._entities[:n]
        first = np.flatnonzero((rows[:, layout.CELL] >= 0) & (rows[:, PREV] < 0) & (rows[:, ID] != 0))
        self.blocks.heads[rows[first, layout.CELL]] = first
        if moved:
            self._bind()

    def use(self, kernel: kernels.Kernel) -> None:
        """Goes on with another kernel; the state stays the same."""
        self.kernel = kernel
        self._told = kernel.lent(self._inputs)
        self._bind()

    # -- inside --------------------------------------------------------------------------------------------

    def _allocate(self, rows: int) -> None:
        """Makes room for this many entities, keeping those there are."""
        self._entities = blocks.grown(self._entities, 0, rows)
        for name in ("_awake", "_next_awake", "_woken", "_later", "_changed", "_fell"):
            setattr(self, name, blocks.grown(getattr(self, name), 0, rows + 1))
        self._candidates = np.zeros((rows + 1, layout.CANDIDATE), np.int64)

    def _bind(self) -> None:
        """Hands the kernel the arrays as they lie now."""
        b = self.blocks
        arrays: tuple[np.ndarray[Any, Any], ...] = (
            self._entities, self._templates, self._walk, self._parameters, b.solid, b.segments, b.table, b.heads,
            self._awake, self._next_awake, self._woken, self._later, self._candidates, self._changed, self._fell,
            self._lengths, b.near,
        )  # fmt: skip
        self._arrays = Arrays(*map(self.kernel.lent, arrays))
        self._bound = self.kernel.bound(self._arrays)

    def _row_at(self, entity: int) -> int:
        """The row of an entity.

        Raises:
            MissingError: there is no such entity.
        """
        row = self._row_of.get(entity if type(entity) is int else whole(entity, "entity", 1, ID_MAX))
        if row is None:
            why = "has been removed" if 0 < entity < self._next_id else "there is no such entity"
            raise MissingError(f"entity = {entity}: {why}")
        return row

    def _row(self, entity: int) -> int:
        """The row of an entity, a new one if it is not known."""
        row = self._row_of.get(entity)
        if row is None:
            if self._free:
                row = self._free.pop()
            else:
                row = self._rows
                if row == len(self._entities):
                    self._allocate(2 * row)
                    self._bind()
                self._rows += 1
            self._entities[row] = 0
            self._entities[row, layout.CELL] = -1
            self._row_of[entity] = row
            self._next_id = max(self._next_id, entity + 1)
        return row

    def _thrown(self, speed: int) -> int:
        """The flags of what flies up: it is not held by what it stands on."""
        return FALLING if speed > 0 and self._parameters[layout.GRAVITY] else 0

    def _box_at(self, kind: int, position: Iterable[int]) -> list[int]:
        """Low and high corner of a template's box at a position."""
        row = self._templates[kind].tolist()
        low = [part + row[layout.LO_X + k] for k, part in enumerate(position)]
        return low + [part + row[layout.SIZE_X + k] for k, part in enumerate(low)]

    def _near(self, but: int, box: list[int]) -> layout.Int64s:
        """The candidates of the kernel for a box (`but`: a row left out, or -1), [n, 7]."""
        end = self.kernel.gather(self._bound, but, True, *box)
        return self._candidates[: end // layout.CANDIDATE]

    def _overlapping(self, but: int, box: list[int]) -> list[int]:
        """The ids of the solid entities that overlap a box, ascending (`but`: a row left out, or -1)."""
        near = self._near(but, box)
        low, high = np.array(box[:3]), np.array(box[3:])
        hits = (near[:, :3] < high).all(axis=1) & (near[:, 3:6] > low).all(axis=1)
        return sorted(self._entities[near[hits, 6], ID].tolist())

    def _taken(self, row: int, kind: int, box: list[int]) -> bool:
        if self.kernel.blocks_in(self._bound, *box):
            return True
        return self._meets(kind) and bool(self._overlapping(row, box))

    def _meets(self, kind: int) -> bool:
        """Whether entities of a template are stopped by solid entities."""
        return bool(self._parameters[layout.PAIRS] and self._templates[kind, layout.SOLID])

    def _free_place(self, row: int, kind: int, position: object, push: bool) -> list[int]:
        parts = vector(position, "position")
        at = [to_position(part, f"position.{axis}") for axis, part in zip("xyz", parts, strict=True)]
        if not self._taken(row, kind, self._box_at(kind, at)):
            return at
        pushed = [moved for axis, sign in PUSHES if (moved := self._pushed(row, kind, at, axis, sign)) is not None]
        if not push or not pushed:
            near = " nor within a block of it" if push else ""
            raise OverlapError(f"position = {parts}: no room for a {self.scene.templates[kind].name!r} there{near}")
        return min(pushed, key=lambda moved: sum(abs(a - b) for a, b in zip(moved, at, strict=True)))

    def _pushed(self, row: int, kind: int, at: list[int], axis: int, sign: int) -> list[int] | None:
        """The nearest free position along one axis, at most a block away."""
        start = self._box_at(kind, at)
        stops = self._stops(row, kind, start, axis, sign)
        for stop in stops:
            distance = (stop - start[axis]) if sign > 0 else (start[axis + 3] - stop)
            if not 0 < distance <= BLOCK:
                continue
            moved = list(at)
            moved[axis] += sign * distance
            if not self._taken(row, kind, self._box_at(kind, moved)):
                return moved
        return None

    def _stops(self, row: int, kind: int, box: list[int], axis: int, sign: int) -> list[int]:
        """The faces within a block that a pushed box could come to rest against, nearest first."""
        face = box[axis] if sign > 0 else box[axis + 3]
        first = -(-face // BLOCK) if sign > 0 else face // BLOCK
        faces = [first * BLOCK, (first + sign) * BLOCK]
        if self._meets(kind):
            reach = list(box)
            reach[axis + 3 if sign > 0 else axis] += sign * BLOCK
            near = self._near(row, reach)
            faces += near[:, axis + 3 if sign > 0 else axis].tolist()
        return sorted(set(faces), reverse=sign < 0)

    def _wake_segment(self, index: Cell) -> None:
        """Wakes what overlaps or touches a segment."""
        low = [part * SEGMENT * BLOCK for part in index]
        self.kernel.wake_in(self._bound, *low, *(part + SEGMENT * BLOCK for part in low))

    def _leave(self, row: int) -> None:
        """Wakes what stands on an entity that is about to go or to change."""
        box = self._box_at(int(self._entities[row, TEMPLATE]), self._entities[row, X : X + 3].tolist())
        self.kernel.wake_on(self._bound, row, box[0], box[1], box[3], box[4], box[5])


def hash_of(tick: int, segments: layout.Int64s, digests: npt.NDArray[np.uint8], states: layout.Int64s) -> bytes:
    """The hash of a world from its parts.

    Args:
        tick: the tick it has reached.
        segments: [n, 3], the indices of its segments in any order.
        digests: [n, 16], the digests of those segments.
        states: [m, 12], the states of its entities, ascending by id.
    """
    order = np.lexsort((segments[:, 2], segments[:, 1], segments[:, 0]))
    digest = hashlib.blake2b(struct.pack("<qqq", tick, len(segments), len(states)), digest_size=HASH_BYTES)
    digest.update(segments[order].astype("<i8").tobytes())
    digest.update(digests[order].tobytes())
    digest.update(states.astype("<i8").tobytes())
    return digest.digest()


LISTS = (
    ("_awake", layout.N_AWAKE), ("_woken", layout.N_WOKEN), ("_changed", layout.N_CHANGED), ("_fell", layout.N_FELL),
)  # fmt: skip
"""What a world lists between two steps, and where the length of each list is kept."""

PUSHES = ((2, 1), (0, -1), (0, 1), (1, -1), (1, 1), (2, -1))
"""Where an overlapping box is pushed, in the order of preference at equal distance: axis and sign."""


def _velocity(velocity: object) -> list[int]:
    parts = vector(velocity, "velocity")
    return [to_velocity(part, f"velocity.{axis}") for axis, part in zip("xyz", parts, strict=True)]


def _block(x: object, y: object, z: object) -> Cell:
    i, j, k = (whole(part, at, -RANGE_BLOCKS, RANGE_BLOCKS - 1) for at, part in (("x", x), ("y", y), ("z", z)))
    return i, j, k


def _segment(index: object) -> Cell:
    return cell(index, "segment", -SEGMENT_MAX, SEGMENT_MAX - 1)
