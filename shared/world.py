"""The world: all blocks and entities of a scene at one tick, and `step`, which computes the next tick.

    world = World(load_scene("hills"))
    world.load_terrain()
    player = world.spawn("player", (64, 64, 30))
    world.step({player: make_input(1, 0, jump=True)})

Theory of operation. A world changes only by the methods below: between two ticks, and by `step`. Two worlds of one
scene that get the same calls in the same order have the same `state_hash()` at every tick, on every machine, with every
form of the kernel. For this, all state is whole numbers, and entities take their turns in ascending order of id.

A `World` is made of layers. `shared.world_state` holds the state in memory and reads it. `shared.world_changes`
changes it and wakes what a change could concern. `shared.world_turns` is for behaviours. This module checks arguments.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from shared import blocks, layout
from shared.arrays import np
from shared.checks import Cell, SceneError, boolean, shown, vector, whole
from shared.extras import Record
from shared.free_places import OverlapError, box_at, free_place, taken
from shared.inputs import Input
from shared.layout import FLAGS, ID, MOVE_X, TEMPLATE, VX, X
from shared.states import ID_MAX, STATES, checked_states, to_positions
from shared.units import BLOCK, SPEED, SPEED_MAX, to_velocity
from shared.world_turns import TurnWorld

__all__ = ["OverlapError", "World"]

TICK_MAX = (1 << 53) - 1
"""Greatest tick of a world, which a float holds exactly."""


class World(TurnWorld):
    """The whole state of a scene at one tick.

    A method that takes an entity raises `MissingError` (a `KeyError`) if there is no entity of that number. A wrong
    value raises `SceneError`, with the field and the value in its text, before anything has changed.

    Args:
        scene: the description of the world.
        compiled: True: use a compiled kernel; False: use the plain one; None: use the one that `kernels` chooses.

    Raises:
        SceneError: `scene` is not a `Scene`.
    """

    def load_terrain(self, indices: Iterable[Cell] | None = None) -> None:
        """Generates segments with the scene's terrain generator; all segments of the scene by default."""
        from shared import terrain  # here, because a client gets its terrain from a server

        for index in self.scene.segments() if indices is None else indices:
            segment = blocks.checked_segment(index)
            self._load(segment, terrain.generate(self.scene.terrain, segment))
            self.blocks.generated[segment] = self.blocks.version(segment)

    def load_segment(self, index: Cell, kinds: blocks.Kinds) -> None:
        """Adds or replaces a segment, and wakes the entities that overlap or touch it.

        Args:
            index: index of the segment.
            kinds: [32768] kinds of blocks, by index z << 10 | y << 5 | x.
        """
        self._load(blocks.checked_segment(index), blocks.checked_kinds(kinds))

    def unload_segment(self, index: Cell) -> None:
        """Removes a segment. A segment that is not loaded is solid (below the scene's floor it is void).

        Raises:
            MissingError: the segment is not loaded.
            OverlapError: entities are still in it.
        """
        segment = blocks.checked_segment(index)
        if len(self.in_segment(segment)):
            raise OverlapError(f"segment {segment}: entities are in it")
        self._unload(segment)

    def set_block(self, x: int, y: int, z: int, kind: int, *, push: bool = False) -> bool:
        """Places (kind 1 to 255) or removes (0) a block. Returns whether anything changed.

        With `push`, solid entities in the way go to their nearest free places.

        Raises:
            OverlapError: a solid entity is in the way (and, with `push`, cannot be pushed out of it).
            SceneError: a value is not a valid coordinate or kind, or the block's segment is not loaded.
        """
        x, y, z = blocks.checked_block(x, y, z)
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
            SceneError: a value is not valid, the box has more than 2^20 blocks (`blocks.FILL_MAX`), or a segment is not
                loaded.
        """
        low, high = blocks.checked_box(low, high)
        kind, push = whole(kind, "kind", blocks.AIR, blocks.KIND_MAX), boolean(push, "push")
        return self._fill(low, high, kind, push) if all(a < b for a, b in zip(low, high, strict=True)) else 0

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
        at = free_place(self, -1, kind, position, boolean(push, "push"))
        return self.add(kind, at, _velocity(velocity))

    def spawn_many(self, template: str, positions: Any) -> range:
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
        n = len(at)
        ids = self._new_ids(kind, n)
        if ids.stop - 1 > ID_MAX:
            raise SceneError("ids: used up")
        settled = self._settle(kind, at)
        if settled < n:
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
        state = self._placed(entity, position, push=boolean(push, "push"))
        self._put([state])
        self.placing.add(state[ID])

    def set_velocity(self, entity: int, velocity: tuple[float, float, float]) -> None:
        """Sets the velocity of an entity, in blocks/s. An upward velocity makes gravity act on it.

        Raises:
            MissingError: there is no such entity.
            SceneError: a value is not finite or out of range.
        """
        state = self.state(entity)
        self._set_velocity(state, _velocity(velocity))

    def add_velocity(self, entity: int, velocity: tuple[float, float, float]) -> None:
        """Adds to the velocity of an entity, in blocks/s. An upward velocity makes gravity act on it.

        Each part of the sum is limited to 1024 blocks/s (`units.SPEED_MAX`). An entity that walks keeps the horizontal
        part only if its template has an acceleration or a friction; otherwise its input sets that part in the next
        tick.

        Raises:
            MissingError: there is no such entity.
            SceneError: a value is not finite or out of range.
        """
        state = self.state(entity)
        parts = zip(state[VX : VX + 3], _velocity(velocity), strict=True)
        fastest = round(SPEED_MAX * SPEED)
        self._set_velocity(state, [min(max(part + more, -fastest), fastest) for part, more in parts])

    def _set_velocity(self, state: tuple[int, ...], velocity: list[int]) -> None:
        """Writes a state with another velocity, in velocity steps."""
        flags = state[FLAGS] | self._thrown(state[TEMPLATE], velocity[2])
        self._put([(*state[:FLAGS], flags, *state[X:VX], *velocity, *state[MOVE_X:])])

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
        box = box_at(self, state[TEMPLATE], state[X : X + 3])
        if taken(self, row, state[TEMPLATE], box):
            raise OverlapError(f"entity {entity}: no room for the box of {template!r}")
        extras = self.extras
        if extras.count and extras.behaviour_of[self._entities[row, TEMPLATE]] != extras.behaviour_of[state[TEMPLATE]]:
            state[STATES + extras.first :] = extras.starts[state[TEMPLATE], extras.first :].tolist()
            state[STATES + extras.wakes_at] = int(extras.new[state[TEMPLATE], extras.wakes_at])
        self._put([tuple(state)])

    def set_field(self, entity: int, name: str, value: int) -> None:
        """Sets a field of an entity's behaviour.

        Raises:
            MissingError: there is no such entity.
            SceneError: its behaviour has no such field, or the value is out of range.
        """
        state = list(self.state(entity))
        column, declared = self.field_column(state[TEMPLATE], name)
        state[STATES + column] = declared.checked(value)
        self._put([tuple(state)])

    def write_fields(self, records: Iterable[Record]) -> bool:
        """Writes extra columns of entities, as they are on the wire. Returns whether there is an entity for each."""
        there = True
        for entity, values in records:
            row = self._row_of.get(entity)
            if row is None:
                there = False
                continue
            for column, value in values:
                self._extra[row, column] = value
        return there

    def forget(self, entity: int) -> None:
        """Removes an entity that has left a client's view; unlike `remove`, it still exists for its owner.

        Raises:
            MissingError: there is no such entity.
        """
        self._row_at(entity)
        self._take_out(entity)

    def remove(self, entity: int) -> None:
        """Removes an entity from the world, and wakes the entities that stood on it.

        Raises:
            MissingError: there is no such entity.
        """
        self._row_at(entity)
        self._remove(int(entity))

    def put(self, states: Iterable[tuple[int, ...]] | layout.Int64s) -> None:
        """Writes states as they are, without a check for free places; ids that are not known become new entities.

        Args:
            states: [n, 12] whole numbers, as `state` returns them, perhaps with the extra columns of the scene.

        Raises:
            SceneError: a value is out of range, or two states have one id.
        """
        self._put(checked_states(states, len(self.scene.templates), self.extras))

    def write(self, states: layout.Int64s) -> None:
        """Writes states like `put`, but without its checks, for states that `snapshot.decode_parts` has checked."""
        self._put(states)

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
        segment = blocks.checked_segment(segment)
        self.blocks.row(segment)
        where = [whole(at, f"offsets[{i}]", 0, blocks.BLOCKS - 1) for i, at in enumerate(where)]
        self._write_blocks(
            segment, where, [whole(kind, f"kinds[{i}]", 0, blocks.KIND_MAX) for i, kind in enumerate(what)]
        )

    def follow(self, turns: layout.Int64s, ticks: int, tick: int) -> bool:
        """Advances a world that is written and never stepped: a client's confirmed world.

        Each entity without a turn in `turns` moves on as before, with nothing in its way, but does not leave its
        segment.

        Args:
            turns: explicit turns, [n, 8] (`layout.TURN`), with the id in the first column. Empty unless `ticks` is 1.
                The array is written to.
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
        there = self.kernel.follow(self.bound, self.kernel.lent(turns), len(turns), self._rows, ticks, self.tick + 1)
        self._arrive(tick)
        return bool(there)

    def rebase(self, tick: int) -> None:
        """Sets the tick without a step: the world as it was written becomes the state at the end of `tick`.

        Raises:
            SceneError: `tick` is not a whole number from -1 to `TICK_MAX`.
        """
        self._rebase(whole(tick, "tick", -1, TICK_MAX))

    def step(self, inputs: Mapping[int, Input] | None = None) -> None:
        """Computes the next tick.

        Args:
            inputs: inputs by entity id. An entity without one goes on with its latest input.

        Raises:
            MissingError: there is no entity of an id.
            SceneError: a value is not an `Input`.
        """
        told = self._told_of(inputs) if inputs else []
        used = inputs
        if self.extras.count:
            used = self._with_turns(inputs or {})
            if used is not inputs:
                told = self._told_of(used)
        n = len(used) if used else 0
        if used:
            if self.extras.aims:
                self._write_aims(used)
            if len(told) > len(self._inputs):
                self._inputs = np.zeros(2 * len(told), np.int64)
                self._told = self.kernel.lent(self._inputs)
            self._inputs[: len(told)] = told
        self.tick += 1
        if self.editing or self.edited:
            self.edited, self.editing = self.editing, {}
        if self.placing or self.placed:
            self.placed, self.placing = self.placing, set()
        if self.extras.count:
            self.fields_set, self._fields_setting = self._fields_setting, {}
        self.kernel.step(self.bound, self._told, n, self.tick)
        if self._limbo:
            self._free += self._limbo
            self._limbo.clear()
        if self.observer is not None:
            self.observer.stepped(self, inputs or {})

    def copy(self) -> "World":
        """Returns another world in the same state."""
        other = World(self.scene, compiled=self.compiled)
        other.restore(self)
        return other


def _velocity(velocity: object) -> list[int]:
    parts = vector(velocity, "velocity")
    return [to_velocity(part, f"velocity.{axis}") for axis, part in zip("xyz", parts, strict=True)]
