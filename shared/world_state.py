"""The state of a world in memory: its blocks, its entities, and all methods that only read them.

Entities are rows of one int64 matrix (`shared.layout`), which the kernel (`shared.kernel`) reads and writes in place;
Python keeps only which row belongs to which id. Only entities that are awake have a turn in a step, so the kernel keeps
lists of them. The row of an entity that was removed while awake is reused only after the next step, because these lists
name it until then.

`shared.world_changes` and `shared.world` have the methods that change a world.
"""

import hashlib
import struct
from array import array
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from shared import blocks, kernels, layout
from shared.arrays import Uint8s, flat, grown, np
from shared.behaviours import Field
from shared.checks import Cell, MissingError, SceneError, is_whole, shown, whole
from shared.layout import FALLING, FLAGS, ID, NEXT, TEMPLATE, VX, Arrays, X
from shared.scene import Scene
from shared.states import ID_MAX, STATES
from shared.units import BLOCK, SPEED

if TYPE_CHECKING:
    from shared.turns import Turns

HASH_BYTES = 20
"""Length of a state hash in bytes."""
COLLECT_MAX = 1024
"""Number of rows up to which the kernel sorts the states, by insertion: 1 us for about ten rows instead of numpy's
9."""
NEW_ROW = array("q", (-(column == layout.CELL) for column in range(len(layout.COLUMNS))))
"""Row of an entity that has no state yet, and is in no cell."""


class WorldState:
    """The whole state of a scene at one tick. `shared.world.World` describes the arguments and the errors."""

    turns: "Turns | None" = None
    """The behaviours; None: the scene has none, or the world has not made a step."""

    def __init__(self, scene: Scene, *, compiled: bool | None = None) -> None:
        rules: object = scene
        if not isinstance(rules, Scene):
            raise SceneError(f"scene = {shown(rules)}: must be a `Scene`")
        self.scene = scene
        self.tick = 0
        """Number of the latest step: the world is the state at the end of this tick. `rebase` sets it without a
        step."""
        self.blocks = blocks.Blocks(scene.passable)
        self.kernel = kernels.get(compiled)
        """Kernel that steps this world; all other code that works on the world's arrays uses it, too."""
        self.templates, self._walk, self.parameters = scene.kernel_tables()
        self.boxes = [tuple(row[layout.LO_X : layout.LO_X + 6]) for row in self.templates.tolist()]
        """Low corner and size of each template's box, in grid steps."""
        self.meets = [bool(self.parameters[layout.PAIRS] and row[layout.SOLID]) for row in self.templates.tolist()]
        """Whether solid entities stop the entities of each template."""
        self.extras = scene.extras
        """The extra columns of the scene's states."""
        self._row_of: dict[int, int] = {}
        self._ordered: layout.Int64s | None = None  # rows, ascending by id; None: to be sorted
        self._dense = False  # whether these rows are 0, 1, 2, ...
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
        self._fields_setting: dict[int, int] = {}
        self.fields_set: dict[int, int] = {}
        """Entities whose extra columns alone were set in the latest step, with a mask of these columns."""
        self._inputs = np.zeros(32, np.int64)
        self._one, self._one_row = np.zeros((1, STATES), np.int64), np.zeros(1, np.int64)  # an entity that is added
        self._one_state = flat(self._one)
        self._extra = np.zeros((0, self.extras.count), np.int64)
        self._entities = np.zeros((0, len(layout.COLUMNS)), np.int64)
        self._awake = self._next_awake = self._woken = self._later = np.zeros(0, np.int64)
        self._changed = self._fell = np.zeros(0, np.int64)
        self._allocate(8)
        self.use(self.kernel)

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, entity: object) -> bool:
        return (type(entity) is int or is_whole(entity)) and entity in self._row_of

    @property
    def entities(self) -> "np.ndarray[Any, np.dtype[Any]]":
        """A copy of all entities as a structured array of numpy (`layout.COLUMNS`, in grid steps), ascending by id."""
        kind = np.dtype([(name, np.int64) for name in layout.COLUMNS])
        return self.rows(sorted(self._row_of)).view(kind).reshape(-1)

    def rows(self, entities: Iterable[int]) -> layout.Int64s:
        """Returns a copy of some entities as an int64 matrix [n, 16], in the given order (columns as in `layout`)."""
        asked = list(entities)
        try:
            rows = [self._row_of[entity] for entity in asked]
        except (KeyError, TypeError):
            rows = [self._row_at(entity) for entity in asked]
        return self._entities[rows]

    def states(self) -> layout.Int64s:
        """Returns the states of all entities, [n, 12], ascending by id; equal worlds have equal states. A copy.

        In a scene with extra columns (`shared.extras`), these follow the 12.
        """
        if self.extras.count:
            return self._wide_states()
        if self.compiled and self._rows <= COLLECT_MAX:
            out = np.empty((self._rows, STATES), np.int64)
            return out[: self.kernel.collect(self._arrays.entities, self._rows, self.kernel.lent(out))]
        rows: layout.Int64s = self._entities[: self._rows, :STATES]
        rows = rows[rows[:, ID] != 0]
        rows = rows[np.argsort(rows[:, ID])]
        rows[:, FLAGS] &= FALLING
        return rows

    def states_of(self, entities: Iterable[int]) -> layout.Int64s:
        """Returns a copy of the states of some entities, [n, 12], in the given order."""
        states = self.rows(entities)[:, :STATES]
        states[:, FLAGS] &= FALLING
        if self.extras.count:
            extra = self._extra[[self._row_of[entity] for entity in states[:, ID].tolist()]]
            return np.concatenate((states, extra), axis=1)
        return states

    def _wide_states(self) -> layout.Int64s:
        """Returns the states of all entities with their extra columns, ascending by id."""
        rows = self.ordered_rows()
        n = len(rows)
        entities, extra = self._entities, self._extra
        if not self._dense:
            entities, extra = entities.take(rows, 0), extra.take(rows, 0)
        states = np.concatenate((entities[:n, :STATES], extra[:n]), 1)
        if n == 1:  # a lone player, predicted many times per second: numpy takes 2 us for a column
            states[0, FLAGS] = states.item(0, FLAGS) & FALLING
        else:
            states[:, FLAGS] &= FALLING
        return states

    def ordered_rows(self) -> layout.Int64s:
        """Returns the rows of all entities in memory, ascending by id. Do not write to the array."""
        if self._ordered is None:
            rows = [self._row_of[entity] for entity in sorted(self._row_of)]
            self._ordered, self._dense = np.array(rows, np.int64), rows == list(range(len(rows)))
        return self._ordered

    def state(self, entity: int) -> tuple[int, ...]:
        """Returns the state of one entity as 12 whole numbers (the columns of `layout.COLUMNS` before `cell`).

        In a scene with extra columns, these follow.
        """
        row = self._row_at(entity)
        state: list[int] = self._entities[row, :STATES].tolist()
        state[FLAGS] &= FALLING
        return tuple(state + self._extra[row].tolist()) if self.extras.count else tuple(state)

    def field(self, entity: int, name: str) -> int:
        """Returns the value of a field of an entity's behaviour.

        Raises:
            MissingError: there is no such entity.
            SceneError: its behaviour has no such field.
        """
        row = self._row_at(entity)
        column, _ = self.field_column(int(self._entities[row, TEMPLATE]), name)
        return int(self._extra[row, column])

    def fields(self, entity: int) -> dict[str, int]:
        """Returns the fields of an entity's behaviour by name; empty if its template has no behaviour."""
        row = self._row_at(entity)
        return self.fields_of(int(self._entities[row, TEMPLATE]), self._extra[row].tolist())

    def fields_of(self, kind: int, extra: Sequence[int]) -> dict[str, int]:
        """Returns the fields of a template's behaviour by name, from the extra columns of an entity."""
        behaviour = self.extras.behaviour_of[kind]
        if behaviour < 0:
            return {}
        fields = self.scene.behaviours[behaviour].fields
        return {each.name: extra[self.extras.first + k] for k, each in enumerate(fields)}

    def field_column(self, kind: int, name: str) -> tuple[int, Field]:
        """Returns the place of a field among the extra columns, and its declaration.

        Args:
            kind: number of a template.
            name: name of the field.

        Raises:
            SceneError: the template's behaviour has no such field.
        """
        behaviour = self.extras.behaviour_of[kind]
        fields = self.scene.behaviours[behaviour].fields if behaviour >= 0 else ()
        for k, each in enumerate(fields):
            if each.name == name:
                return self.extras.first + k, each
        there = ", ".join(each.name for each in fields) or "none"
        raise SceneError(f"{self.scene.templates[kind].name}.{name}: no such field (there are {there})")

    def row_of(self, entity: int) -> int:
        """Returns the row of an entity in memory."""
        return self._row_of[entity]

    @property
    def entity_rows(self) -> layout.Int64s:
        """The rows of all entities in memory, [rows, 16]; only for `shared.turns`."""
        return self._entities

    @property
    def extra_rows(self) -> layout.Int64s:
        """The extra columns of all rows in memory, [rows, n]; only for `shared.turns`."""
        return self._extra

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
        return rows[np.argsort(rows[:, ID])] if len(found) > 1 else rows

    def block(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block; None if its segment is not loaded."""
        return self.blocks.get(*blocks.checked_block(x, y, z))

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
        return hash_of(self.tick, cells, digests, self.states_of(sorted(entities)))

    def use(self, kernel: kernels.Kernel) -> None:
        """Replaces the kernel; the state of the world stays the same."""
        self.kernel = kernel
        self._told, self._adding = kernel.lent(self._inputs), (kernel.lent(self._one_row), kernel.lent(self._one))
        self._bind()

    def _allocate(self, rows: int) -> None:
        """Makes room for `rows` entities, and keeps the present ones."""
        self._entities = grown(self._entities, 0, rows)
        self._flat = flat(self._entities)
        if self.extras.count:
            self._extra = grown(self._extra, 0, rows)
        for name in ("_awake", "_next_awake", "_woken", "_later", "_changed", "_fell"):
            setattr(self, name, grown(getattr(self, name), 0, rows + 1))
        self.candidates = np.zeros((rows + 1, layout.CANDIDATE), np.int64)
        self.candidates_flat = flat(self.candidates)
        self._riders = np.zeros((rows + 1, layout.RIDER), np.int64)

    def _bind(self) -> None:
        """Passes the arrays to the kernel; called whenever one has moved in memory."""
        b = self.blocks
        arrays: tuple[Any, ...] = (
            self._entities, self.templates, self._walk, self.parameters, b.solid, b.segments, b.table, b.heads,
            self._awake, self._next_awake, self._woken, self._later, self.candidates, self._changed, self._fell,
            self._lengths, b.near, self._riders,
        )  # fmt: skip
        self._arrays = Arrays(*map(self.kernel.lent, arrays))
        self.bound = self.kernel.bound(self._arrays)

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
            self._flat[row << layout.WIDTH_SHIFT : row + 1 << layout.WIDTH_SHIFT] = NEW_ROW
            self._row_of[entity] = row
            self._ordered = None
            self._next_id = max(self._next_id, entity + 1)
        return row


def hash_of(tick: int, segments: layout.Int64s, digests: Uint8s, states: layout.Int64s) -> bytes:
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
