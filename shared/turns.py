"""The turns of behaviours: what happens at the start of a step, in scenes with behaviours.

Theory of operation. An entity has a turn if it is *active*: its template has a behaviour, and it moves or falls, or its
input of this tick or of the tick before is not neutral, or it has asked for a turn by now (`Body.wake`). This follows
from its state and its input alone, so server and clients agree about it; whether the kernel has put an entity to sleep
does not matter. An entity that rests costs a share of one comparison of an array.

Turns are taken in ascending order of id. A turn collects its changes in its body. Blocks change as soon as the turn is
over; all else changes after the last turn, so every turn reads the other entities as they were before the first. The
changes are not reported to the world's observer, because a replay of a recording takes the turns again.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from shared.body import Body
from shared.body_fields import body_class
from shared.checks import SceneError
from shared.inputs import Input
from shared.layout import CELL, FALLING, FLAGS, ID, TEMPLATE, VX, Int64s

if TYPE_CHECKING:
    from shared.world_turns import TurnWorld

FEW = 16
"""Number of entities with behaviours up to which Python looks for the active ones; numpy takes about 10 us at least."""
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
        self._bodies: list[Body | None] = []
        made: list[Body] = []
        for entry in entries:
            assert entry.code is not None
            body = body_class(entry, extras.first)(world)
            body.behaviour, body.entry = entry.code(), entry
            made.append(body)
        self._bodies = [made[k] if k >= 0 else None for k in extras.behaviour_of.tolist()]
        self._behaves = extras.behaviour_of >= 0
        self.rows: Int64s | None = None
        """Rows of the entities with behaviours, ascending by id; None: to be looked up."""
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
        if self.announced or self.vanished:
            self.announced, self.vanished = [], []
        if self.steered:
            self.steered = []
        rows = self._found()
        if len(rows) > FEW:
            rows = rows[self._active(rows, inputs)]
        if not len(rows):
            return inputs
        world, extras = self._world, self._world.extras
        entities, more = world.entity_rows, world.extra_rows
        tick, wakes = world.tick + 1, extras.wakes_at
        used: dict[int, Input] | None = None
        stored: list[list[int]] = []
        removed: list[int] = []
        fields: list[tuple[int, int, int, list[int]]] = []
        for row, state, values in zip(rows.tolist(), entities[rows].tolist(), more[rows].tolist(), strict=True):
            entity, due = state[ID], 0 < values[wakes] <= tick
            input_ = inputs.get(entity)
            if not (
                due
                or state[FLAGS] & FALLING
                or any(state[VX:CELL])
                or (input_ is not None and any(input_[:3]))
                or (extras.aims and (any(values[:3]) or (input_ is not None and any(input_[3]))))
            ):
                continue
            body = self._bodies[state[TEMPLATE]]
            assert body is not None
            body.begin(tick, state, values, input_)
            if due:
                body._set(wakes, 0)
            try:
                body.behaviour.turn(body)
            except Exception as error:
                self._fail(tick, entity, body, error)
                if not due:
                    continue
                body.clear()
                body._values = values[:]
                body._set(wakes, 0)
            if body._steered is not None:
                used = dict(inputs) if used is None else used
                used[entity] = body._steered
                self.steered.append(entity)
            for edit in body._edits:
                world.edit_silently(entity, edit)
            if body._new is not None:
                stored.append(body._new + body._values)
            elif body._mask:
                fields.append((row, entity, body._mask, body._values))
            if body._spawned:
                stored += body._spawned
            removed += body._removed
            for name, payload in body._announced:
                self.announced.append(Announcement(entity, name, payload))
        for row, entity, mask, values in fields:
            more[row] = values
            world.note_fields(entity, mask)
        if stored:
            world.store_silently(np.array(stored, np.int64))
        for entity in removed:
            if entity in world:
                world.remove_silently(entity)
                self.vanished.append(entity)
        return inputs if used is None else used

    def take_failures(self) -> list[Failure]:
        """Returns the failed turns since the last call."""
        failures, self.failures = self.failures, []
        return failures

    def _found(self) -> Int64s:
        """Returns the rows of the entities with behaviours, ascending by id."""
        if self.rows is None:
            matrix = self._world.matrix
            ids = matrix[:, ID]
            rows = np.flatnonzero((ids != 0) & self._behaves[matrix[:, TEMPLATE]])
            self.rows = rows[np.argsort(ids[rows])]
        return self.rows

    def _active(self, rows: Int64s, inputs: Mapping[int, Input]) -> npt.NDArray[np.bool_]:
        """Returns for each row whether its entity may be active."""
        world = self._world
        states, wakes = world.entity_rows[rows], world.extra_rows[rows, world.extras.wakes_at]
        active: npt.NDArray[np.bool_] = (
            (states[:, VX:CELL] != 0).any(axis=1)
            | (states[:, FLAGS] & FALLING != 0)
            | ((wakes > 0) & (wakes <= world.tick + 1))
        )
        if world.extras.aims:
            active |= (world.extra_rows[rows, :3] != 0).any(axis=1)
        if inputs:
            given = [entity for entity, input_ in inputs.items() if any(input_[:3]) or any(input_[3:])]
            active |= np.isin(states[:, ID], given)
        return active

    def _fail(self, tick: int, entity: int, body: Body, error: Exception) -> None:
        if len(self.failures) < FAILURES_MAX:
            self.failures.append(Failure(tick, entity, body.entry.name, error))
