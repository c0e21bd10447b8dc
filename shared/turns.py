"""The turns of behaviours: what happens at the start of a step, in scenes with behaviours.

Theory of operation. An entity has a turn if it is *active*: its template has a behaviour, and it moves or falls, or its
input of this tick or of the tick before is not neutral, or it has asked for a turn by now (`Body.wake`), as each new
entity has, or its behaviour has `always`. This follows from its state and its input alone, so server and clients agree
about it; whether the kernel has put an entity to sleep does not matter. An entity that rests costs a share of one
comparison of an array.

Turns are taken in ascending order of id. A turn collects its changes in its body. Blocks change as soon as the turn is
over; all else changes after the last turn, so every turn reads the other entities as they were before the first. The
changes are not reported to the world's observer, because a replay of a recording takes the turns again.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from shared.arrays import FEW, Truths, np
from shared.body import Body
from shared.body_fields import body_class
from shared.checks import SceneError
from shared.inputs import NEUTRAL, Input, checked_input
from shared.layout import BUTTONS, CELL, FALLING, FLAGS, ID, MOVE_X, MOVE_Y, TEMPLATE, VX, VY, VZ, Int64s

if TYPE_CHECKING:
    from shared.world_turns import TurnWorld

FAILURES_MAX = 64
"""Limit of the failed turns that a world keeps until they are taken."""


class Failure(NamedTuple):
    """A turn that has raised an exception; nothing of it was done."""

    tick: int
    entity: int
    behaviour: str
    error: Exception


class Announcement(NamedTuple):
    """An event that a turn of the latest step has announced; `payload` is MessagePack."""

    entity: int
    name: str
    payload: bytes


class _Changes:
    """The changes of the turns of one tick.

    Args:
        inputs: the inputs of the tick.
    """

    def __init__(self, inputs: Mapping[int, Input]) -> None:
        self.inputs = inputs
        self.steered: dict[int, Input] = {}
        self.states: list[list[int]] = []
        self.fields: list[tuple[int, int, int, list[int]]] = []
        self.removed: list[int] = []


def rests(state: list[int]) -> bool:
    """Returns whether an entity neither moves nor falls, and its latest input was neutral."""
    return not (
        state[VX]
        or state[VY]
        or state[VZ]
        or state[MOVE_X]
        or state[MOVE_Y]
        or state[BUTTONS]
        or state[FLAGS] & FALLING
    )


class Turns:
    """The behaviours of one world.

    Args:
        world: the world.

    Raises:
        SceneError: the classes of the scene's behaviours are not bound.
    """

    def __init__(self, world: "TurnWorld") -> None:
        self._world = world
        extras, entries = world.extras, world.scene.behaviours
        missing = [entry.name for entry in entries if entry.code is None]
        if missing:
            raise SceneError(f"behaviours = {', '.join(missing)}: the scene needs these classes; pass them")
        made: list[Body] = []
        for entry in entries:
            assert entry.code is not None
            body = body_class(entry, extras.first)(world)
            body.behaviour, body.entry = entry.code(), entry
            made.append(body)
        self._bodies: list[Body | None] = [made[k] if k >= 0 else None for k in extras.behaviour_of.tolist()]
        self._behaves = extras.behaviour_of >= 0
        self._always = [body is not None and body.behaviour.always for body in self._bodies]
        """Truth values by template: whether its entities have turns in every tick."""
        self._always_array = np.array(self._always, np.bool_)
        self.rows: Int64s | None = None
        """Rows of the entities with behaviours, ascending by id; None: to be looked up."""
        self._few: list[int] | None = None  # the same as a list, if there are few
        self.announced: list[Announcement] = []
        """Announcements of the latest step."""
        self.vanished: list[int] = []
        """Entities that the turns of the latest step have removed."""
        self.failures: list[Failure] = []
        """Failed turns that nobody has taken yet."""
        self.steered: list[int] = []
        """Entities whose input a turn of the latest step has replaced."""

    def take(self, inputs: Mapping[int, Input]) -> Mapping[int, Input]:
        """Takes the turns of the coming tick. Returns the inputs that the step uses."""
        if self.announced or self.vanished or self.steered:
            self.announced, self.vanished, self.steered = [], [], []
        world, bodies = self._world, self._bodies
        aims, wakes, tick = world.extras.aims, world.extras.wakes_at, world.tick + 1
        always = self._always
        made: _Changes | None = None
        for row, state, values in self._candidates(inputs):
            entity = state[ID]
            due = 0 < values[wakes] <= tick
            awake = due or always[state[TEMPLATE]]
            input_ = inputs.get(entity)
            if input_ is not None and type(input_) is not Input:
                input_ = checked_input(input_, f"inputs[{entity}]")
            neutral = input_ is None or input_ == NEUTRAL
            if neutral and not awake and rests(state) and not (aims and any(values[:3])):
                continue
            body = bodies[state[TEMPLATE]]
            assert body is not None
            body.begin(tick, state, values, input_)
            if due:
                body.set_column(wakes, 0)
            try:
                body.behaviour.turn(body)
            except Exception as error:
                self._fail(tick, entity, body, error)
                body.begin(tick, state, values, input_)
                if due:
                    body.set_column(wakes, 0)
            if body.changes:
                made = made or _Changes(inputs)
                self._collect(made, row, body)
        return self._apply(made) if made is not None else inputs

    def _candidates(self, inputs: Mapping[int, Input]) -> Iterable[tuple[int, list[int], list[int]]]:
        """Returns row, state and extra columns of the entities that may be active, ascending by id."""
        world, rows = self._world, self._found()
        entities, more = world.entity_rows, world.extra_rows
        if self._few is not None:
            return [(row, entities[row].tolist(), more[row].tolist()) for row in self._few]
        rows = rows[self._active(rows, inputs)]
        return zip(rows.tolist(), entities[rows].tolist(), more[rows].tolist(), strict=True)

    def _collect(self, made: "_Changes", row: int, body: Body) -> None:
        """Collects the changes of a turn, and makes those of blocks."""
        entity, parts = body.id, body.taken()
        if parts.steered is not None:
            made.steered[entity] = parts.steered
        for edit in parts.edits:
            self._world.edit_silently(entity, edit)
        if parts.state is not None:
            made.states.append(parts.state + parts.values)
        elif parts.mask:
            made.fields.append((row, entity, parts.mask, parts.values))
        made.states += parts.spawned
        made.removed += parts.removed
        self.announced += [Announcement(entity, name, payload) for name, payload in parts.announced]

    def _apply(self, made: "_Changes") -> Mapping[int, Input]:
        """Makes the changes of all turns. Returns the inputs that the step uses."""
        world = self._world
        for row, entity, mask, values in made.fields:
            world.extra_rows[row] = values
            world.note_fields(entity, mask)
        if made.states:
            world.store_silently(np.array(made.states, np.int64))
        for entity in made.removed:
            if entity in world:
                world.remove_silently(entity)
                self.vanished.append(entity)
        if not made.steered and not self.vanished:
            return made.inputs
        self.steered = list(made.steered)
        return {entity: input_ for entity, input_ in {**made.inputs, **made.steered}.items() if entity in world}

    def take_failures(self) -> list[Failure]:
        """Returns the failed turns since the last call."""
        failures, self.failures = self.failures, []
        return failures

    def _found(self) -> Int64s:
        """Returns the rows of the entities with behaviours, ascending by id."""
        if self.rows is None:
            rows = self._world.ordered_rows()
            self.rows = rows[self._behaves[self._world.entity_rows[rows, TEMPLATE]]]
            self._few = self.rows.tolist() if len(self.rows) <= FEW else None
        return self.rows

    def _active(self, rows: Int64s, inputs: Mapping[int, Input]) -> Truths:
        """Returns for each row whether its entity may be active."""
        world = self._world
        states, wakes = world.entity_rows[rows], world.extra_rows[rows, world.extras.wakes_at]
        active: Truths = (
            (states[:, VX:CELL] != 0).any(axis=1)
            | (states[:, FLAGS] & FALLING != 0)
            | ((wakes > 0) & (wakes <= world.tick + 1))
            | self._always_array[states[:, TEMPLATE]]
        )
        if world.extras.aims:
            active |= (world.extra_rows[rows, :3] != 0).any(axis=1)
        if inputs:
            active |= np.isin(states[:, ID], list(inputs))
        return active

    def _fail(self, tick: int, entity: int, body: Body, error: Exception) -> None:
        if len(self.failures) < FAILURES_MAX:
            self.failures.append(Failure(tick, entity, body.entry.name, error))
