"""The view: the own entity as predicted, all others a little in the past, corrections smoothed.

Other entities are drawn as predicted, too, if their template is shown so (`shown = "predicted"` in the scene).
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

from client_sdk.interpolation import Interpolation
from client_sdk.interpolation.smoothing import Smoothing
from client_sdk.prediction.prediction import Prediction, Reconciled
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from client_sdk.view import NO_VALUES, EntityView, View
from shared.arrays import PLAIN, np
from shared.checks import Vec
from shared.layout import CELL, ID, MOVE_X, TEMPLATE, VX, X
from shared.scene import Scene
from shared.units import BLOCK, SPEED

FACINGS_MIN = 64
"""Number of kept directions up to which those of entities out of view are not dropped."""


class _Still(NamedTuple):
    """The part of an entity view that depends on the entity's state alone, but not on its position."""

    entity: int
    template: str
    velocity: Vec
    fields: Mapping[str, int]
    facing: tuple[float, float]


class ViewBuilder:
    """Makes views from predicted, interpolated and smoothed positions."""

    def __init__(self, scene: Scene, prediction: Prediction) -> None:
        self.interpolation = Interpolation(scene.tick_rate)
        self._prediction = prediction
        self._templates = [template.name for template in scene.templates]
        self._predicted = {i for i, template in enumerate(scene.templates) if template.shown == "predicted"}
        self._smoothing: dict[int, Smoothing] = {}
        self._extras = scene.extras
        self._facings: dict[int, tuple[float, float]] = {}
        self._states: Any = None  # the latest drawn ones, and what was made of them
        self._own = slice(0)  # the rows of the own entities
        self._parts: list[_Still | None] = []  # of all rows; None: an own one, or it may be drawn as predicted
        self._others: list[_Still | None] = []  # of all rows but the own ones
        self._rows: list[list[int]] = []  # the states of these, if one may be drawn as predicted
        self._seldom: dict[int, _Still] = {}  # parts by row of those that were not drawn as predicted after all
        self._delay = 0.0  # the input delay of the latest view, in ticks
        self._viewed = -math.inf  # the timeline's tick of the latest view

    def advance(self, server_tick: float, now: float) -> float:
        """Adapts the interpolation delay of the others. Returns the tick at which they are drawn."""
        self.interpolation.advance(server_tick, now)
        return self.interpolation.shown(server_tick)

    def smooth(self, done: Reconciled, now: float) -> None:
        """Starts to fade out the jumps that a replay made. Entities that the rules acted on jump at once."""
        for entity in done.placed:
            self._smoothing.pop(entity, None)
        if not done.replayed:
            return
        if self._smoothing:
            predicted = self._prediction.predicted
            self._smoothing = {entity: old for entity, old in self._smoothing.items() if entity in predicted}
        for entity, offset in done.offsets.items():
            if entity not in done.acted:
                self._smoothing.setdefault(entity, Smoothing()).add(offset, now)

    def view(self, timeline: Timeline, clock: ServerClock, now: float) -> View:
        """Returns the view at `now`."""
        prediction = self._prediction
        tick, server_tick = timeline.tick(now), clock.tick(now)
        # The drawn delay grows no faster than time passes: after a longer input delay is set, the own entity stands
        # for as many ticks, and is never drawn further back than before.
        self._delay = min(prediction.ahead, self._delay + max(tick - self._viewed, 0.0))
        self._viewed = tick
        states, places = self.interpolation.drawn(server_tick)
        if states is not self._states:
            self._take(states)
        del places[self._own]
        if self._rows:
            others = [self._other(i, place, tick, now) for i, place in enumerate(places)]
        else:
            attributes, new = prediction.attributes.get, tuple.__new__  # half the time of a call of the class
            others = [
                new(EntityView, (entity, template, (x, y, z), velocity, attributes(entity, NO_VALUES), fields, facing))
                for (entity, template, velocity, fields, facing), (x, y, z) in zip(
                    cast("list[_Still]", self._others), places, strict=True
                )
            ]
        if prediction.last_own > prediction.entity:  # what the own entity has spawned: predicted, like itself
            own = (self._ahead(entity, tick, now) for entity in prediction.spawned())
            others = sorted([*others, *(each for each in own if each is not None)], key=lambda each: each.entity)
        return View(tick, self._ahead(prediction.entity, tick, now), others, self.interpolation.shown(server_tick))

    def _take(self, states: Any) -> None:
        """Takes the states of another snapshot.

        An entity whose state differs in its position only has the same part as before. Of an own one, and of one that
        may be drawn as predicted, a part is made only if it is not, because that changes its facing.
        """
        ids, templates = states[:, ID].tolist(), states[:, TEMPLATE].tolist()
        if len(self._facings) > 2 * len(ids) + FACINGS_MIN:
            there = set(ids)
            self._facings = {entity: facing for entity, facing in self._facings.items() if entity in there}
        first, end = bisect_left(ids, self._prediction.entity), bisect_right(ids, self._prediction.last_own)
        own, former, parts = slice(first, end), self._parts, list[_Still | None]()
        for row, same in enumerate(_unchanged(self._states, states)):
            part = former[same] if same >= 0 else None
            if part is None and templates[row] not in self._predicted and not first <= row < end:
                part = self._part(states[row].tolist())
            parts.append(part)
        others = parts.copy()
        del others[own]
        rows = []
        if None in others:
            rows = states.tolist()
            del rows[own]
        self._states, self._own, self._parts = states, own, parts
        self._others, self._rows, self._seldom = others, rows, {}

    def _other(self, row: int, place: list[float], tick: float, now: float) -> EntityView:
        """Returns the view of the entity of a row, as predicted or at `place` (in blocks)."""
        state, part = self._rows[row], self._others[row]
        if part is None:
            ahead = self._ahead(state[ID], tick, now)
            if ahead is not None:
                return ahead
            part = self._seldom.get(row)
            if part is None:
                part = self._seldom[row] = self._part(state)
        return self._figure_of(part, place)

    def _ahead(self, entity: int, tick: float, now: float) -> EntityView | None:
        """Returns a predicted entity to draw, one tick before `tick` and with smoothing; None if it is not predicted.

        One tick back, the position lies between two predicted states.
        """
        prediction = self._prediction
        if entity not in prediction.predicted:
            return None
        before, after, share = prediction.around(entity, tick - self._delay - 1)
        smoothing = self._smoothing.get(entity)
        offset = smoothing.offset(now) if smoothing else (0.0, 0.0, 0.0)
        place = []
        for a, b, more in zip(before[X : X + 3], after[X : X + 3], offset, strict=True):
            old = a / BLOCK
            place.append(old + (b / BLOCK - old) * share + more)
        return self._figure(after, place)

    def _figure(self, state: Sequence[int], place: list[float]) -> EntityView:
        """Returns the entity view of a state, drawn at `place` (in blocks)."""
        return self._figure_of(self._part(state), place)

    def _figure_of(self, part: _Still, place: list[float]) -> EntityView:
        entity, template, velocity, fields, facing = part
        x, y, z = place
        attributes = self._prediction.attributes.get(entity, NO_VALUES)
        return EntityView(entity, template, (x, y, z), velocity, attributes, fields, facing)

    def _part(self, state: Sequence[int]) -> _Still:
        """Returns the part of an entity view that depends on the state alone."""
        velocity = (state[VX] / SPEED, state[VX + 1] / SPEED, state[VX + 2] / SPEED)
        template = self._templates[state[TEMPLATE]]
        fields: Mapping[str, int] = NO_VALUES
        if self._extras.count:
            fields = self._prediction.predicted.fields_of(state[TEMPLATE], list(state[CELL:]))
        return _Still(state[ID], template, velocity, fields, self._facing(state))

    def _facing(self, state: Sequence[int]) -> tuple[float, float]:
        """Returns the direction in which an entity looks, and keeps it for when it stands still."""
        aims = self._extras.aims and (state[CELL] or state[CELL + 1])
        for part in (CELL if aims else MOVE_X, VX):
            east, north = state[part], state[part + 1]
            if east or north:
                length = math.hypot(east, north)
                self._facings[state[ID]] = east / length, north / length
                break
        return self._facings.get(state[ID], (1.0, 0.0))


def _unchanged(before: Any, after: Any) -> list[int]:
    """Returns for each state, [n, 12], the row of an earlier state that differs in its position at most; -1: none.

    Both are ascending by id. `before` may be None.
    """
    if before is None or not len(before):
        return [-1] * len(after)
    if PLAIN:
        rows = {state[ID]: (row, state) for row, state in enumerate(before.tolist())}
        found = [(rows.get(state[ID], (-1, state)), state) for state in after.tolist()]
        return [row if old[VX:] == new[VX:] and old[TEMPLATE] == new[TEMPLATE] else -1 for (row, old), new in found]
    if len(before) == len(after) and (before[:, ID] == after[:, ID]).all():  # mostly
        at, changed = np.arange(len(after)), before != after
    else:
        at = np.searchsorted(before[:, ID], after[:, ID])
        at[at == len(before)] = 0
        changed = before[at] != after
    changed[:, TEMPLATE + 1 : VX] = False
    at[changed.any(axis=1)] = -1
    same: list[int] = at.tolist()
    return same
