"""The changes and the reading of a world by the turns of behaviours (`shared.turns`).

These changes are not reported to the observer, because a replay of a recording takes the turns again.
"""

from collections.abc import Mapping
from contextlib import suppress

from shared import blocks, edits, layout
from shared.aim import NO_AIM, is_normal
from shared.free_places import OverlapError
from shared.inputs import Input, checked_input, clamp
from shared.layout import ID, TEMPLATE, Int64s
from shared.messages import DONE
from shared.seen import Seen
from shared.turns import Turns
from shared.units import BLOCK, SPEED
from shared.world_changes import UncheckedWorld

AIM_MASK = 0b111
"""Mask of the columns of an aim among the extra columns."""


class TurnWorld(UncheckedWorld):
    """A world whose behaviours change it within a step."""

    def _with_turns(self, inputs: Mapping[int, Input]) -> Mapping[int, Input]:
        """Takes the turns of behaviours before a step.

        Returns:
            The inputs of the step: as `Input` with aims of their length in a scene with an aim, and without entities
            that the turns have removed.
        """
        used, turns = inputs, self.turns
        if self.extras.aims and not all(map(_is_used, inputs.values())):
            used = _inputs(inputs)
        if self.scene.behaviours:
            if turns is None:
                turns = self.turns = Turns(self)
            used = turns.take(used)
        return used

    def _write_aims(self, inputs: Mapping[int, Input]) -> None:
        """Writes the aims of the inputs of a step, which `_with_turns` has returned."""
        rows, extra = self._row_of, self._extra
        for entity, (_, _, _, aim) in inputs.items():
            mine = extra[rows[entity]]
            if (mine.item(0), mine.item(1), mine.item(2)) != aim:
                mine[:3] = aim
                self.note_fields(entity, AIM_MASK)

    def store_silently(self, states: Int64s) -> None:
        """Writes states with all columns without a report. New entities count as placed."""
        new = {entity for entity in states[:, ID].tolist() if entity not in self._row_of}
        self._store(states)
        self.placing |= new

    def remove_silently(self, entity: int) -> None:
        """Removes an entity without a report."""
        self._disown(entity)
        self._take_out(entity)

    def edit_silently(self, entity: int, edit: edits.Edit) -> None:
        """Carries out an edit without a report of it; the observer is still notified before the block changes."""
        if edits.verdict(self, entity, edit) == DONE:
            x, y, z, kind = edit
            if self.observer is not None:
                segment = blocks.segment_of(x, y, z)
                self.observer.touching(segment, segment)
            with suppress(OverlapError):
                self._set_box((x, y, z), (x + 1, y + 1, z + 1), kind, False)

    def rows_in(self, box: list[int], but: int, kind: int | None) -> list[int]:
        """Returns the rows of the entities that overlap or touch a box, ascending by id.

        Args:
            box: low and high corner, in grid steps.
            but: row that is left out.
            kind: number of their template; None: any.
        """
        n = self.kernel.gather(self.bound, but, False, *box) // layout.CANDIDATE
        if n == 0:
            return []
        entities = self._entities
        found = [(entities.item(row, ID), row) for row in self.candidates[:n, 6].tolist()]
        found.sort()
        return [row for _, row in found if kind is None or entities.item(row, TEMPLATE) == kind]

    def seen(self, row: int) -> Seen:
        """Returns what the turn of another entity sees of the entity in a row."""
        entity, kind, _, x, y, z, vx, vy, vz, *_ = self._entities[row].tolist()
        fields = self.fields_of(kind, self._extra[row].tolist())
        name = self.scene.templates[kind].name
        velocity = (vx / SPEED, vy / SPEED, vz / SPEED)
        return Seen(entity, name, (x / BLOCK, y / BLOCK, z / BLOCK), velocity, fields)

    def thrown(self, kind: int, speed: int) -> int:
        """Returns the flags of an entity of a template for a vertical speed, as `_thrown`."""
        return self._thrown(kind, speed)


def _is_used(input_: Input) -> bool:
    """Returns whether an input is an `Input` whose aim has its length. The other values are not checked."""
    return type(input_) is Input and (input_.aim is NO_AIM or is_normal(input_.aim))


def _inputs(inputs: Mapping[int, Input]) -> dict[int, Input]:
    """Returns inputs, some of which are plain tuples or have an aim of another length, as they are used.

    Raises:
        SceneError: a value is not an `Input`.
    """
    return {entity: clamp(checked_input(input_, f"inputs[{entity}]")) for entity, input_ in inputs.items()}
