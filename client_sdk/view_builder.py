"""The view: the own entity as predicted, all others a little in the past, corrections smoothed.

Other entities are drawn as predicted, too, if their template is shown so (`shown = "predicted"` in the scene).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from client_sdk.interpolation import Interpolation
from client_sdk.interpolation.smoothing import Smoothing
from client_sdk.prediction.prediction import Prediction, Reconciled
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from client_sdk.view import NO_VALUES, EntityView, View
from shared.checks import Vec
from shared.layout import CELL, ID, MOVE_X, TEMPLATE, VX, X
from shared.scene import Scene
from shared.units import BLOCK, SPEED

FACINGS_MIN = 64
"""Number of kept directions up to which those of entities out of view are not dropped."""


class _Still(NamedTuple):
    """The part of an entity view that depends on the entity's state alone: the same in all frames of a snapshot."""

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
        self._states: Any = None  # the states of which `_still` has parts
        self._rows: list[list[int]] = []
        self._still: dict[int, _Still] = {}
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
        states, places = self.interpolation.sample(server_tick)
        if len(self._facings) > 2 * len(states) + FACINGS_MIN:
            there = set(states[:, ID].tolist())
            self._facings = {entity: facing for entity, facing in self._facings.items() if entity in there}
        if states is not self._states:
            self._states, self._rows, self._still = states, states.tolist(), {}
        still, attributes, others = self._still, prediction.attributes, []
        first_own, last_own, predicted = prediction.entity, prediction.last_own, self._predicted
        new = tuple.__new__  # half the time of a call of the class
        for state, (x, y, z) in zip(self._rows, places.tolist(), strict=True):
            entity = state[ID]
            if first_own <= entity <= last_own:
                continue
            if predicted and state[TEMPLATE] in predicted and (ahead := self._ahead(entity, tick, now)) is not None:
                others.append(ahead)
                continue
            part = still.get(entity)
            if part is None:
                part = still[entity] = self._part(state)
            template, velocity, fields, facing = part
            values = (entity, template, (x, y, z), velocity, attributes.get(entity, NO_VALUES), fields, facing)
            others.append(new(EntityView, values))
        if prediction.last_own > prediction.entity:  # what the own entity has spawned: predicted, like itself
            own = (self._ahead(entity, tick, now) for entity in prediction.spawned())
            others = sorted([*others, *(each for each in own if each is not None)], key=lambda each: each.entity)
        return View(tick, self._ahead(prediction.entity, tick, now), others, self.interpolation.shown(server_tick))

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
        x, y, z = place
        template, velocity, fields, facing = self._part(state)
        attributes = self._prediction.attributes.get(state[ID], NO_VALUES)
        return EntityView(state[ID], template, (x, y, z), velocity, attributes, fields, facing)

    def _part(self, state: Sequence[int]) -> _Still:
        """Returns the part of an entity view that depends on the state alone."""
        velocity = (state[VX] / SPEED, state[VX + 1] / SPEED, state[VX + 2] / SPEED)
        template = self._templates[state[TEMPLATE]]
        fields: Mapping[str, int] = NO_VALUES
        if self._extras.count:
            fields = self._prediction.predicted.fields_of(state[TEMPLATE], list(state[CELL:]))
        return _Still(template, velocity, fields, self._facing(state))

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
