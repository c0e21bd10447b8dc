"""The view: the own entity as predicted, all others a little in the past, corrections smoothed.

Other entities are drawn as predicted, too, if their template is shown so (`shown = "predicted"` in the scene).
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import compress, repeat
from operator import ne
from typing import Any

from client_sdk.interpolation import Interpolation
from client_sdk.interpolation.interpolation import LOOK_EXTRA, LOOK_MOVE, NO_ENTRY, Entry, Look
from client_sdk.interpolation.smoothing import Smoothing
from client_sdk.prediction.prediction import Prediction, Reconciled
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from client_sdk.view import NO_VALUES, EntityView, View
from shared.checks import Vec
from shared.layout import CELL, ID, MOVE_X, TEMPLATE, VX, VZ, X, Y, Z
from shared.scene import Scene
from shared.units import BLOCK, SPEED

Facing = tuple[float, float]
"""A direction of length 1: east and north."""
EAST: Facing = (1.0, 0.0)
"""The facing of an entity that has not moved yet."""
FACINGS_MIN = 64
"""Number of kept directions up to which those of entities out of view are not dropped."""


class ViewBuilder:
    """Makes views from predicted, interpolated and smoothed positions."""

    def __init__(self, scene: Scene, prediction: Prediction) -> None:
        self.interpolation = Interpolation(scene.tick_rate)
        self._prediction = prediction
        self._templates = [template.name for template in scene.templates]
        self._predicted = {i for i, template in enumerate(scene.templates) if template.shown == "predicted"}
        self._smoothing: dict[int, Smoothing] = {}
        self._extras = scene.extras
        self._facings: dict[int, Facing] = {}
        self._drawn = NO_ENTRY  # the snapshot from which on the others are drawn
        self._layout: tuple[list[int], list[int]] = [], []  # numbers and templates of its entities; then in that order:
        self._names: list[str] = []
        self._labels: list[Mapping[str, Any]] = []
        self._fields: list[Mapping[str, int]] = []
        self._directions: list[Facing] = []
        self._own = slice(0)  # rows of the own ones
        self._unsure: list[int] = []  # rows of those that may be drawn as predicted
        self._ahead_rows: set[int] = set()  # both
        self._looks: list[Look] = []  # of its states
        self._labelled = -1  # state of the attributes in `_labels`
        self._delay = 0.0  # the input delay of the latest view, in ticks
        self._viewed = -math.inf  # the timeline's tick of the latest view

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
        seen = self.interpolation.shown(server_tick)
        way = self.interpolation.way(seen)
        if way.before is not self._drawn:
            self._follow(way.before)
        if self._labelled != prediction.confirmed_copy.attribute_changes:
            self._label()
        looks = self._drawn.velocities, self._labels, self._fields, self._directions
        values = zip(way.before.ids, self._names, way.places(seen), *looks, strict=True)
        others = list(map(tuple.__new__, repeat(EntityView), values))  # `EntityView._make` takes several times as long
        for row in self._unsure:
            entity, look = self._drawn.ids[row], self._drawn.looks[row]
            others[row] = self._ahead(entity, tick, now) or others[row]._replace(facing=self._facing(entity, look))
        del others[self._own]
        if prediction.last_own > prediction.entity:  # what the own entity has spawned: predicted, like itself
            own = (self._ahead(entity, tick, now) for entity in prediction.spawned())
            others = sorted([*others, *(each for each in own if each is not None)], key=lambda each: each.entity)
        return View(tick, self._ahead(prediction.entity, tick, now), others, seen)

    def _follow(self, drawn: Entry) -> None:
        """Takes the states of another snapshot, from which on the others are drawn."""
        layout, before = (drawn.ids, drawn.templates), self._looks
        self._drawn, self._looks = drawn, drawn.looks
        fresh: Iterable[int] = range(len(drawn.ids))
        if layout == self._layout:
            fresh = compress(fresh, map(ne, before, self._looks))
        else:
            self._arrange(*layout)
        fields_of = self._prediction.predicted.fields_of
        for row in fresh:
            look = drawn.looks[row]
            if self._extras.count:
                self._fields[row] = fields_of(drawn.templates[row], look[LOOK_EXTRA:])
            if row not in self._ahead_rows:
                self._directions[row] = self._facing(drawn.ids[row], look)

    def _arrange(self, ids: list[int], templates: list[int]) -> None:
        """Takes other entities or templates than those in the snapshot before."""
        self._layout = ids, templates
        first, last = self._prediction.entity, self._prediction.last_own
        self._own = slice(bisect_left(ids, first), bisect_right(ids, last))
        own = range(*self._own.indices(len(ids)))
        self._unsure = [row for row, kind in enumerate(templates) if kind in self._predicted and row not in own]
        self._ahead_rows = {*own, *self._unsure}
        self._names = [self._templates[template] for template in templates]
        self._fields, self._directions = [NO_VALUES] * len(ids), [EAST] * len(ids)
        self._label()
        if len(self._facings) > 2 * len(ids) + FACINGS_MIN:
            there = set(ids)
            self._facings = {entity: facing for entity, facing in self._facings.items() if entity in there}

    def _label(self) -> None:
        """Takes the attributes of all entities."""
        self._labelled = self._prediction.confirmed_copy.attribute_changes
        attributes = self._prediction.attributes
        self._labels = [attributes.get(entity, NO_VALUES) for entity in self._drawn.ids]

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
        (x, y, z), (u, v, w), (i, j, k) = place_of(before), place_of(after), offset
        place = x + (u - x) * share + i, y + (v - y) * share + j, z + (w - z) * share + k
        return self._figure(after, place, self._facing(entity, (*after[VX:VZ], *after[MOVE_X:])))

    def _figure(self, state: Sequence[int], place: Vec, facing: Facing) -> EntityView:
        """Returns the view of an entity that is drawn at `place` (in blocks)."""
        template = state[TEMPLATE]
        velocity = (state[VX] / SPEED, state[VX + 1] / SPEED, state[VX + 2] / SPEED)
        attributes = self._prediction.attributes.get(state[ID], NO_VALUES)
        fields: Mapping[str, int] = NO_VALUES
        if self._extras.count:
            fields = self._prediction.predicted.fields_of(template, state[CELL:])
        return EntityView(state[ID], self._templates[template], place, velocity, attributes, fields, facing)

    def _facing(self, entity: int, look: Look) -> Facing:
        """Returns the direction in which an entity looks, and keeps it for when it stands still."""
        aims = self._extras.aims and (look[LOOK_EXTRA] or look[LOOK_EXTRA + 1])
        for part in (LOOK_EXTRA if aims else LOOK_MOVE, 0):
            if look[part] or look[part + 1]:
                self._facings[entity] = _toward(look[part], look[part + 1])
                break
        return self._facings.get(entity, EAST)


@lru_cache(256)
def _toward(east: int, north: int) -> Facing:
    """Returns a direction of length 1. Entities that walk share few of them, so a view touches less memory."""
    length = math.hypot(east, north)
    return east / length, north / length


def place_of(state: Sequence[int]) -> Vec:
    """Returns the position in a state, in blocks."""
    return state[X] / BLOCK, state[Y] / BLOCK, state[Z] / BLOCK
