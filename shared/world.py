"""The world: all blocks and entities of a scene at one tick, and `step`, which computes the next tick.

    world = World(load_scene("hills"))
    world.load_terrain()
    player = world.spawn("player", (64, 64, 30))
    world.step({player: make_input(1, 0, jump=True)})

Theory of operation. A world changes only in this module: by the methods below between two ticks, and by `step`. Two
worlds of one scene that get the same calls in the same order have the same `state_hash()` at every tick, on every
machine, with every form of the kernel. For this, all state is whole numbers, and entities take their turns in ascending
order of id.

Entities are rows of one int64 matrix (`shared.layout`), which the kernel (`shared.kernel`) reads and writes in place;
Python keeps only which row belongs to which id. Only entities that are awake have a turn in a step. Each method that
could change what an entity rests on wakes the entities concerned. The row of an entity that was removed while awake is
reused only after the next step, because the kernel's lists name it until then.
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
"""Length of a state hash in bytes."""
SEGMENT_MAX = RANGE_BLOCKS // SEGMENT
"""Bound of a segment's index along each axis, in segments: from `-SEGMENT_MAX` to `SEGMENT_MAX - 1`."""
FILL_MAX = 1 << 20
"""Limit of the blocks of one `fill`."""
TICK_MAX = (1 << 53) - 1
"""Greatest tick of a world, which a float holds exactly."""
COLLECT_MAX = 1024
"""Number of rows up to which the kernel sorts the states, by insertion: 1 us for about ten rows instead of numpy's
9."""


class OverlapError(SceneError):
    """The place is occupied by a block or by a solid entity."""


class World:
    """The whole state of a scene at one tick.

    A method that takes an entity raises `MissingError` (a `KeyError`) if there is no entity of that number. A wrong
    value raises `SceneError`, with the field and the value in its text, before anything has changed.

    Args:
        scene: the description of the world.
        compiled: True: use a compiled kernel; False: use the plain one; None: use the one that `kernels` chooses.

    Raises:
        SceneError: `scene` is not a `Scene`.
    """

    def __init__(self, scene: Scene, *, compiled: bool | None = None) -> None:
        rules: object = scene
        if not isinstance(rules, Scene):
            raise SceneError(f"scene = {shown(rules)}: must be a `Scene`")
        self.scene = scene
        self.tick = 0
        """Number of the latest step: the world is the state at the end of this tick. `rebase` sets it without a
        step."""
        self.blocks = blocks.Blocks()
        self.kernel = kernels.get(compiled)
        """Kernel that steps this world; all other code that works on the world's arrays uses it, too."""
        self._templates, self._walk, self._parameters = scene.kernel_tables()
        self._row_of: dict[int, int] = {}
        self._next_id = 1
        self._rows = 0  # number of rows that were ever used
        self._free: list[int] = []
        self._limbo: list[int] = []  # rows freed since the latest step: the kernel's lists may still name them
        self._lengths = np.zeros(layout.LENGTHS, np.int64)
        self.editing: dict[Cell, int] = {}
        """Blocks that changed since the latest step, with their kinds before."""
        self.edited: dict[Cell, int] = {}
        """Blocks that changed between the latest step and the step before it, with their kinds before."""
        self.placing: set[int] = set()
        """Entities that were placed since the latest step."""
        self.placed: set[int] = set()
        """Entities that were placed between the latest step and the step before it; they did not move to where they
        are."""
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
        """A copy of all entities as a structured array (`layout.ENTITY`, in grid steps), ascending by id."""
        return self.rows(sorted(self._row_of)).view(ENTITY).reshape(-1)

    def rows(self, entities: Iterable[int]) -> layout.Int64s:
        """Returns a copy of some entities as an int64 matrix [n, 16], in the given order (columns as in `layout`)."""
        asked = list(entities)
        try:
            rows = [self._row_of[entity] for entity in asked]
        except (KeyError, TypeError):
            rows = [self._row_at(entity) for entity in asked]
        return self._entities[rows]

    def states(self) -> layout.Int64s:
        """Returns the states of all entities, [n, 12], ascending by id; equal worlds have equal states. A copy."""
        if self.compiled and self._rows <= COLLECT_MAX:
            out = np.empty((self._rows, STATES), np.int64)
            return out[: self.kernel.collect(self._arrays.entities, self._rows, self.kernel.lent(out))]
        rows: layout.Int64s = self._entities[: self._rows, :STATES]
        rows = rows[rows[:, ID] != 0]
        rows = rows[np.argsort(rows[:, ID])]
        rows[:, FLAGS] &= FALLING
        return rows

    def state(self, entity: int) -> tuple[int, ...]:
        """Returns the state of one entity as 12 whole numbers (the columns of `layout.COLUMNS` before `cell`)."""
        state = self._entities[self._row_at(entity), :STATES].copy()
        state[FLAGS] &= FALLING
        return tuple(state.tolist())

    def position(self, entity: int) -> tuple[float, float, float]:
        """Returns the position of an entity, in blocks."""
        x, y, z = self._entities[self._row_at(entity), X : X + 3].tolist()
        return x / BLOCK, y / BLOCK, z / BLOCK

    def velocity(self, entity: int) -> tuple[float, float, float]:
        """Returns the velocity of an entity, in blocks/s."""
        x, y, z = self._entities[self._row_at(entity), VX : VX + 3].tolist()
        return x / SPEED, y / SPEED, z / SPEED

    def falling(self, entity: int) -> bool:
        """Returns whether gravity acts on an entity, so that it falls or rises."""
        return bool(self._entities[self._row_at(entity), FLAGS] & FALLING)

    def awake(self, entity: int) -> bool:
        """Returns whether an entity will have a turn in the next tick even without an input."""
        return bool(self._entities[self._row_at(entity), FLAGS] & layout.AWAKE)

    @property
    def awake_count(self) -> int:
        """The number of entities that have a turn in the next tick."""
        return int(self._lengths[layout.N_AWAKE] + self._lengths[layout.N_WOKEN])

    @property
    def changed(self) -> layout.Int64s:
        """A copy of the entities that the latest step changed, or that were written since the step before, [n, 16]."""
        rows: layout.Int64s = self._entities[self._changed[: self._lengths[layout.N_CHANGED]]]
        alive: layout.Int64s = rows[rows[:, ID] != 0]
        return alive

    @property
    def matrix(self) -> layout.Int64s:
        """A read-only view of all rows in memory, [rows ever used, 16]; a free row has the id 0."""
        view: layout.Int64s = self._entities[: self._rows]
        view.flags.writeable = False
        return view

    @property
    def compiled(self) -> bool:
        """Whether the world's kernel is a compiled one."""
        return self.kernel.compiled

    @property
    def arrays(self) -> Arrays:
        """The arrays that the kernel works on, at their current place in memory, for other functions that read them."""
        return self._arrays

    @property
    def next_id(self) -> int:
        """The id of the next entity that is spawned. It can be set to a higher one.

        Raises:
            SceneError: the new id is lower than the present one, or above the range of ids.
        """
        return self._next_id

    @next_id.setter
    def next_id(self, entity: int) -> None:
        self._next_id = whole(entity, "next_id", self._next_id, ID_MAX + 1)

    @property
    def fell(self) -> list[int]:
        """The ids of the entities that were below the scene's floor at the end of the latest step."""
        fell: list[int] = self._fell[: self._lengths[layout.N_FELL]].tolist()
        return fell

    def in_segment(self, index: Cell) -> layout.Int64s:
        """Returns a copy of the entities whose position is in a loaded segment, [n, 16], ascending by id.

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
        """Returns the state hash (20 bytes) over the tick, all blocks and all entities.

        Args:
            entities: if given, only these entities are hashed, and no blocks.
        """
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
        """Generates segments with the scene's terrain generator; all segments of the scene by default."""
        for index in self.scene.segments() if indices is None else indices:
            segment = _segment(index)
            self._load(segment, terrain.generate(self.scene.terrain, segment))

    def load_segment(self, index: Cell, kinds: blocks.Kinds) -> None:
        """Adds or replaces a segment, and wakes the entities that overlap or touch it.

        Args:
            index: index of the segment.
            kinds: [32768] kinds of blocks, by index z << 10 | y << 5 | x.
        """
        self._load(_segment(index), blocks.checked_kinds(kinds))

    def _load(self, index: Cell, kinds: blocks.Kinds) -> None:
        if self.blocks.load(index, kinds):
            self._bind()
        if self._lengths[layout.N_HOMELESS]:
            self.kernel.relink_range(self._bound, 0, self._rows)
        self._wake_segment(index)

    def unload_segment(self, index: Cell) -> None:
        """Removes a segment. A segment that is not loaded is solid (below the scene's floor it is void).

        Raises:
            MissingError: the segment is not loaded.
            OverlapError: entities are still in it.
        """
        segment = _segment(index)
        if len(self.in_segment(segment)):
            raise OverlapError(f"segment {segment}: entities are in it")
        self._unload(segment)

    def _unload(self, index: Cell) -> None:
        self.blocks.unload(index)
        self._wake_segment(index)  # below the scene's floor, a segment that is not loaded is void, so things may fall

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block; None if its segment is not loaded."""
        return self.blocks.get(*_block(x, y, z))

    def set_block(self, x: int, y: int, z: int, kind: int, *, push: bool = False) -> bool:
        """Places (kind 1 to 255) or removes (0) a block. Returns whether anything changed.

        With `push`, solid entities in the way go to their nearest free places.

        Raises:
            OverlapError: a solid entity is in the way (and, with `push`, cannot be pushed out of it).
            SceneError: a value is not a valid coordinate or kind, or the block's segment is not loaded.
        """
        x, y, z = _block(x, y, z)
        kind, push = whole(kind, "kind", blocks.AIR, blocks.KIND_MAX), boolean(push, "push")
        return self._fill((x, y, z), (x + 1, y + 1, z + 1), kind, push) > 0

    def fill(self, low: Cell, high: Cell, kind: int, *, push: bool = False) -> int:
        """Sets every block of a box, or none if it raises an error.

        Args:
            low: the lowest block of the box.
            high: the corner opposite to it, excluded along every axis.
            kind: 1 to 255; 0 removes the blocks.
            push: move solid entities that are in the way to their nearest free places, in ascending order of id.

        Returns:
            The number of blocks that changed.

        Raises:
            OverlapError: a solid entity is in the way (and, with `push`, cannot be pushed out of it).
            SceneError: a value is not valid, the box has more than `FILL_MAX` blocks, or a segment is not loaded.
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
        """Adds an entity and returns its id. Ids ascend and are never used again.

        Args:
            template: name of the entity's template in the scene.
            position: in blocks, rounded to the grid.
            velocity: in blocks/s, rounded to the grid.
            push: if the place is occupied, use the nearest free one, at most a block away along one axis.

        Raises:
            OverlapError: the place is occupied (and, with `push`, so are the places near it).
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
        """Adds entities at rest, as `spawn` would one after the other; all of them, or none if it raises an error.

        Args:
            template: name of the entities' template in the scene.
            positions: [n, 3] in blocks, rounded to the grid.

        Returns:
            The ids of the new entities, in the order of the positions.

        Raises:
            OverlapError: a place is occupied, perhaps by an earlier entity of this call.
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
        """Teleports an entity, which keeps its velocity.

        Args:
            entity: number of the entity.
            position: in blocks, rounded to the grid.
            push: if the place is occupied, use the nearest free one, at most a block away along one axis.

        Raises:
            MissingError: there is no such entity.
            OverlapError: the place is occupied (and, with `push`, so are the places near it).
            SceneError: a value is not finite or out of range.
        """
        row = self._row_at(entity)
        state = list(self.state(entity))
        state[X : X + 3] = self._free_place(row, state[TEMPLATE], position, boolean(push, "push"))
        self._put([tuple(state)])
        self.placing.add(state[ID])

    def set_velocity(self, entity: int, velocity: tuple[float, float, float]) -> None:
        """Sets the velocity of an entity, in blocks/s. An upward velocity makes gravity act on it.

        Raises:
            MissingError: there is no such entity.
            SceneError: a value is not finite or out of range.
        """
        state = list(self.state(entity))
        state[VX : VX + 3] = _velocity(velocity)
        state[FLAGS] |= self._thrown(state[VX + 2])
        self._put([tuple(state)])

    def set_template(self, entity: int, template: str) -> None:
        """Changes the template of an entity, and so its box and its abilities.

        Raises:
            MissingError: there is no such entity.
            OverlapError: there is no room for the box of the new template.
            SceneError: there is no such template.
        """
        row = self._row_at(entity)
        state = list(self.state(entity))
        state[TEMPLATE] = self.scene.template(template)
        box = self._box_at(state[TEMPLATE], state[X : X + 3])
        if self._taken(row, state[TEMPLATE], box):
            raise OverlapError(f"entity {entity}: no room for the box of {template!r}")
        self._put([tuple(state)])

    def remove(self, entity: int) -> None:
        """Removes an entity from the world, and wakes the entities that stood on it.

        Raises:
            MissingError: there is no such entity.
        """
        self._row_at(entity)
        self._remove(int(entity))

    def _remove(self, entity: int) -> None:
        row = self._row_of.pop(entity)
        self._leave(row)
        self.kernel.unlink(self._bound, row)
        self._entities[row, ID] = 0
        (self._limbo if self._entities[row, FLAGS] & layout.AWAKE else self._free).append(row)

    def put(self, states: Iterable[tuple[int, ...]] | layout.Int64s) -> None:
        """Writes states as they are, without a check for free places; ids that are not known become new entities.

        Args:
            states: [n, 12] whole numbers, as `state` returns them.

        Raises:
            SceneError: a value is out of range, or two states have one id.
        """
        self._put(checked_states(states, len(self.scene.templates)))

    def write(self, states: layout.Int64s) -> None:
        """Writes states like `put`, but without its checks, for states that `snapshot.decode_parts` has checked."""
        self._put(states)

    def _put(self, states: Iterable[tuple[int, ...]] | layout.Int64s) -> None:
        new = np.asarray(states if isinstance(states, np.ndarray) else list(states), np.int64).reshape(-1, STATES)
        ids = new[:, ID].tolist()
        known = list(map(self._row_of.get, ids))
        rows = np.array([self._row(entity) for entity in ids] if None in known else known, np.int64)
        self.kernel.store(self._bound, self.kernel.lent(rows), self.kernel.lent(new), len(rows), self.tick + 1)

    def write_blocks(self, segment: Cell, offsets: Iterable[int], kinds: Iterable[int]) -> None:
        """Changes blocks of a loaded segment, without a check for entities in the way.

        Args:
            segment: index of the segment.
            offsets: the blocks, by index z << 10 | y << 5 | x within the segment.
            kinds: their new kinds, one for each offset.

        Raises:
            MissingError: the segment is not loaded.
            SceneError: a value is out of range, or there are more offsets than kinds, or fewer.
        """
        where, what = list(offsets), list(kinds)
        if len(where) != len(what):
            raise SceneError(f"kinds: {len(what)} values for {len(where)} offsets")
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
        """Advances a world that is written and never stepped: a client's confirmed world.

        Each entity without a turn in `turns` moves on as before, with nothing in its way, but does not leave its
        segment.

        Args:
            turns: explicit turns, [n, 8]: id, events (`layout.STOP_X` ...), input (3), position (3). The position
                counts from the segment's low corner, and only along the axes where the entity stopped. Empty unless
                `ticks` is 1. The array is written to.
            ticks: number of ticks to advance.
            tick: the tick that the world has then reached.

        Returns:
            Whether there is an entity for every turn.

        Raises:
            SceneError: `turns` has another type or shape.
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
        """Sets the tick without a step: the world as it was written becomes the state at the end of `tick`.

        Raises:
            SceneError: `tick` is not a whole number from -1 to `TICK_MAX`.
        """
        self._rebase(whole(tick, "tick", -1, TICK_MAX))

    def _rebase(self, tick: int) -> None:
        self._entities[: self._rows, layout.CHANGED] = -1  # the new tick may be an earlier one
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
        """Computes the next tick.

        Args:
            inputs: inputs by entity id. An entity without one goes on with its latest input.

        Raises:
            MissingError: there is no entity of an id.
            SceneError: a value is not an `Input`.
        """
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
        """Returns inputs as the kernel takes them: row, move_x, move_y and buttons for each."""
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
        except (KeyError, TypeError, ValueError):  # one of them is wrong, or has numbers of numpy
            told = []
            for entity, wish in inputs.items():
                told += (self._row_at(entity), *checked_input(wish, f"inputs[{entity}]"))
        return told

    def copy(self) -> "World":
        """Returns another world in the same state."""
        other = World(self.scene, compiled=self.compiled)
        other.restore(self)
        return other

    def restore(self, other: "World") -> None:
        """Makes this world equal to `other`, a world of the same scene. Cheap if few segments differ.

        Raises:
            SceneError: `other` is not a world of the same scene.
        """
        source: object = other
        if not isinstance(source, World):
            raise SceneError(f"other = {shown(source)}: must be a `World`")
        theirs, mine = other.scene, self.scene
        if theirs is not mine and theirs.fingerprint != mine.fingerprint:
            differ = sorted(name for name, digest in mine.digests.items() if theirs.digests[name] != digest)
            raise SceneError(f"other = a world of {theirs.name!r}: its scene differs in {', '.join(differ)}")
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
        """Replaces the kernel; the state of the world stays the same."""
        self.kernel = kernel
        self._told = kernel.lent(self._inputs)
        self._bind()

    # -- inside --------------------------------------------------------------------------------------------

    def _allocate(self, rows: int) -> None:
        """Makes room for `rows` entities, and keeps the present ones."""
        self._entities = blocks.grown(self._entities, 0, rows)
        for name in ("_awake", "_next_awake", "_woken", "_later", "_changed", "_fell"):
            setattr(self, name, blocks.grown(getattr(self, name), 0, rows + 1))
        self._candidates = np.zeros((rows + 1, layout.CANDIDATE), np.int64)

    def _bind(self) -> None:
        """Passes the arrays to the kernel; called whenever one has moved in memory."""
        b = self.blocks
        arrays: tuple[np.ndarray[Any, Any], ...] = (
            self._entities, self._templates, self._walk, self._parameters, b.solid, b.segments, b.table, b.heads,
            self._awake, self._next_awake, self._woken, self._later, self._candidates, self._changed, self._fell,
            self._lengths, b.near,
        )  # fmt: skip
        self._arrays = Arrays(*map(self.kernel.lent, arrays))
        self._bound = self.kernel.bound(self._arrays)

    def _row_at(self, entity: int) -> int:
        """Returns the row of an entity.

        Raises:
            MissingError: there is no such entity.
        """
        row = self._row_of.get(entity if type(entity) is int else whole(entity, "entity", 1, ID_MAX))
        if row is None:
            why = "has been removed" if 0 < entity < self._next_id else "there is no such entity"
            raise MissingError(f"entity = {entity}: {why}")
        return row

    def _row(self, entity: int) -> int:
        """Returns the row of an entity, a new one if the entity is not known."""
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
        """Returns the flags for a vertical speed: an entity that moves up falls, even if something supports it."""
        return FALLING if speed > 0 and self._parameters[layout.GRAVITY] else 0

    def _box_at(self, kind: int, position: Iterable[int]) -> list[int]:
        """Returns the low and the high corner of a template's box at a position, in grid steps."""
        row = self._templates[kind].tolist()
        low = [part + row[layout.LO_X + k] for k, part in enumerate(position)]
        return low + [part + row[layout.SIZE_X + k] for k, part in enumerate(low)]

    def _near(self, but: int, box: list[int]) -> layout.Int64s:
        """Returns the kernel's candidates for a box, [n, 7], without the row `but` (-1: none is left out)."""
        end = self.kernel.gather(self._bound, but, True, *box)
        return self._candidates[: end // layout.CANDIDATE]

    def _overlapping(self, but: int, box: list[int]) -> list[int]:
        """Returns the ids of the solid entities that overlap a box, ascending, without the row `but` (-1: none)."""
        near = self._near(but, box)
        low, high = np.array(box[:3]), np.array(box[3:])
        hits = (near[:, :3] < high).all(axis=1) & (near[:, 3:6] > low).all(axis=1)
        return sorted(self._entities[near[hits, 6], ID].tolist())

    def _taken(self, row: int, kind: int, box: list[int]) -> bool:
        if self.kernel.blocks_in(self._bound, *box):
            return True
        return self._meets(kind) and bool(self._overlapping(row, box))

    def _meets(self, kind: int) -> bool:
        """Returns whether solid entities stop the entities of a template."""
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
        """Returns the nearest free position in one direction, at most a block away; None if there is none."""
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
        """Returns the faces within a block that could stop a pushed box, nearest first, in grid steps."""
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
        """Wakes the entities that overlap or touch a segment."""
        low = [part * SEGMENT * BLOCK for part in index]
        self.kernel.wake_in(self._bound, *low, *(part + SEGMENT * BLOCK for part in low))

    def _leave(self, row: int) -> None:
        """Wakes the entities that stand on an entity that is about to be removed or changed."""
        box = self._box_at(int(self._entities[row, TEMPLATE]), self._entities[row, X : X + 3].tolist())
        self.kernel.wake_on(self._bound, row, box[0], box[1], box[3], box[4], box[5])


def hash_of(tick: int, segments: layout.Int64s, digests: npt.NDArray[np.uint8], states: layout.Int64s) -> bytes:
    """Returns the state hash of a world, computed from its parts.

    Args:
        tick: the tick of the world.
        segments: [n, 3], the indices of the world's segments in any order.
        digests: [n, 16], the digests of these segments.
        states: [m, 12], the states of the world's entities, ascending by id.
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
"""Names of the lists that a world keeps between two steps, with the place of each list's length in `_lengths`."""

PUSHES = ((2, 1), (0, -1), (0, 1), (1, -1), (1, 1), (2, -1))
"""Directions in which an overlapping box may be pushed, as axis and sign, by preference at equal distance."""


def _velocity(velocity: object) -> list[int]:
    parts = vector(velocity, "velocity")
    return [to_velocity(part, f"velocity.{axis}") for axis, part in zip("xyz", parts, strict=True)]


def _block(x: object, y: object, z: object) -> Cell:
    i, j, k = (whole(part, at, -RANGE_BLOCKS, RANGE_BLOCKS - 1) for at, part in (("x", x), ("y", y), ("z", z)))
    return i, j, k


def _segment(index: object) -> Cell:
    return cell(index, "segment", -SEGMENT_MAX, SEGMENT_MAX - 1)
