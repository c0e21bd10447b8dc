"""The view: the own entity as predicted, all others a little in the past, corrections smoothed.

Other entities are drawn as predicted, too, if their template is shown so (`shown = "predicted"` in the scene).
"""

import math
from collections.abc import Mapping, Sequence
from itertools import compress

from client_sdk.interpolation import Interpolation
from client_sdk.interpolation.interpolation import Way, changes, place_of
from client_sdk.interpolation.smoothing import Smoothing
from client_sdk.prediction.prediction import Prediction, Reconciled
from client_sdk.timing.server_clock import ServerClock
from client_sdk.timing.timeline import Timeline
from client_sdk.view import NO_VALUES, EntityView, View
from shared.checks import Vec
from shared.layout import CELL, ID, MOVE_X, TEMPLATE, VX
from shared.scene import Scene
from shared.units import SPEED

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
        self._way: Way | None = None  # the latest drawn one
        self._layout: tuple[list[int], list[int]] = [], []  # numbers and templates of the entities where it begins
        self._figures: dict[int, EntityView] = {}  # these entities there, without the own ones
        self._unsure: dict[int, list[int]] = {}  # states of those that may be drawn as predicted
        self._labelled = -1  # state of the attributes in `_figures`
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
        seen = self.interpolation.shown(server_tick)
        way = self.interpolation.way(seen)
        if way is not self._way:
            self._follow(way)
        if self._labelled != prediction.confirmed_copy.attribute_changes:
            self._label()
        figures, share = self._figures.copy(), way.share(seen)
        for entity, x, y, z, u, v, w in way.moving:
            if figure := figures.get(entity):
                figures[entity] = _at((x + u * share, y + v * share, z + w * share), figure)
        for entity, state in self._unsure.items():
            ahead = self._ahead(entity, tick, now)
            figures[entity] = ahead or figures[entity]._replace(facing=self._facing(state))
        others = list(figures.values())
        if prediction.last_own > prediction.entity:  # what the own entity has spawned: predicted, like itself
            own = (self._ahead(entity, tick, now) for entity in prediction.spawned())
            others = sorted([*others, *(each for each in own if each is not None)], key=lambda each: each.entity)
        return View(tick, self._ahead(prediction.entity, tick, now), others, seen)

    def _follow(self, way: Way) -> None:
        """Takes the states at the beginning of another way."""
        former, self._way = self._way, way
        if former is not None and former.before is way.before:
            return
        if former is not None and former.after is way.before:
            changed = former.changed
        else:  # the first one, or frames have left out snapshots
            changed = changes(way.states[:0], way.states)
        ids, templates = layout = way.states[:, ID].tolist(), way.states[:, TEMPLATE].tolist()
        if len(self._facings) > 2 * len(ids) + FACINGS_MIN:
            there = set(ids)
            self._facings = {entity: facing for entity, facing in self._facings.items() if entity in there}
        own = range(self._prediction.entity, self._prediction.last_own + 1)
        moves = {entity for entity, *_ in way.moving} if way.after is not way.before else ()
        for old, new in changed:
            entity = new[ID]
            if entity in own:
                continue
            if old is None or old[TEMPLATE] != new[TEMPLATE] or old[VX:] != new[VX:]:
                self._put(new)
            elif entity not in moves:  # otherwise each frame gives it a position
                self._figures[entity] = _at(place_of(new), self._figures[entity])
        if layout != self._layout:
            self._layout = layout
            self._figures = {entity: self._figures[entity] for entity in ids if entity not in own}
            unsure = compress(ids, (template in self._predicted for template in templates))
            self._unsure = {entity: self._unsure[entity] for entity in unsure if entity not in own}

    def _put(self, state: list[int]) -> None:
        """Takes the state of an entity that differs from its earlier one in more than its position."""
        if state[TEMPLATE] in self._predicted:
            self._unsure[state[ID]] = state
            self._figures[state[ID]] = self._figure(state, place_of(state), EAST)
        else:
            self._figures[state[ID]] = self._figure(state, place_of(state), self._facing(state))

    def _label(self) -> None:
        """Takes the attributes of all entities."""
        self._labelled = self._prediction.confirmed_copy.attribute_changes
        attributes = self._prediction.attributes
        for entity, figure in self._figures.items():
            values = attributes.get(entity, NO_VALUES)
            if values is not figure.attributes:
                self._figures[entity] = figure._replace(attributes=values)

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
        x, y, z = (
            old + (new - old) * share + more
            for old, new, more in zip(place_of(before), place_of(after), offset, strict=True)
        )
        return self._figure(after, (x, y, z), self._facing(after))

    def _figure(self, state: Sequence[int], place: Vec, facing: Facing) -> EntityView:
        """Returns the view of an entity that is drawn at `place` (in blocks)."""
        template = state[TEMPLATE]
        velocity = (state[VX] / SPEED, state[VX + 1] / SPEED, state[VX + 2] / SPEED)
        attributes = self._prediction.attributes.get(state[ID], NO_VALUES)
        fields: Mapping[str, int] = NO_VALUES
        if self._extras.count:
            fields = self._prediction.predicted.fields_of(template, list(state[CELL:]))
        return EntityView(state[ID], self._templates[template], place, velocity, attributes, fields, facing)

    def _facing(self, state: Sequence[int]) -> Facing:
        """Returns the direction in which an entity looks, and keeps it for when it stands still."""
        aims = self._extras.aims and (state[CELL] or state[CELL + 1])
        for part in (CELL if aims else MOVE_X, VX):
            east, north = state[part], state[part + 1]
            if east or north:
                length = math.hypot(east, north)
                self._facings[state[ID]] = east / length, north / length
                break
        return self._facings.get(state[ID], EAST)


def _at(place: Vec, figure: EntityView) -> EntityView:
    """Returns the view of an entity at another position. (`_replace` takes several times as long.)"""
    entity, template, _, velocity, attributes, fields, facing = figure
    return tuple.__new__(EntityView, (entity, template, place, velocity, attributes, fields, facing))
