"""A view as one array of float64, which a page reads without converting each entity.

    values[0 : len(HEAD)]          the head, `HEAD` names its places
    then for each entity a row     `COLUMNS` names its first places; the fields of its behaviour follow, in the order
                                   of the scene; places that a template does not use are 0

The own entity, if there is one, is the first row. The others follow, ascending by number.
"""

from array import array
from collections.abc import Mapping
from typing import Any

from client_sdk.stats import Stats
from client_sdk.view import View
from shared.scene import Scene

HEAD = (
    "state", "rows", "columns", "me", "tick", "seen", "events", "attributes", "blocks", "delay_s", "rtt_s", "lead_s",
    "snapshot_age_s", "bytes_up_per_s", "bytes_down_per_s", "late_share", "corrections", "corrections_lately",
    "replayed_ticks", "resyncs", "reconnects", "divergences", "frame_s", "due_s",
)  # fmt: skip
"""Names of the head's places.

state: place in `STATES`. rows: number of entities. columns: length of a row. me: 1 if the first row is the own entity.
tick, seen: as in `View`. events, attributes, blocks: number of events, entities and segments that wait for a call of
`events`, `attributes` and `blocks`. delay_s: how far in the past the others are drawn. From rtt_s on as in `Stats`;
late_share: of the last 5 s, corrections_lately: of the last minute. frame_s: how long the latest `frame` took in
Python. due_s: time until the next `pump` or `frame` has something to do. Times in seconds.
"""
COLUMNS = ("entity", "template", "x", "y", "z", "vx", "vy", "vz", "facing_east", "facing_north")
"""Names of the first places of a row. template: number of the template in the scene. Position in blocks, velocity in
blocks/s, facing: a direction of length 1."""
STATES = ("joining", "playing", "reconnecting", "closed")
"""States of a client, by number."""
AT = {name: place for place, name in enumerate(HEAD)}
"""Places of the head, by name."""
ROOM = 64
"""Number of rows for which there is room at first."""


class FlatView:
    """The array that a page reads.

    Attributes:
        values: the array, as a memoryview. A view that has no room gets a new, longer one.
    """

    def __init__(self) -> None:
        self.values: memoryview[float] = _zeros(len(HEAD) + ROOM * len(COLUMNS))
        self._columns = len(COLUMNS)
        self._numbers: dict[str, int] = {}
        self._fields: list[tuple[str, ...]] = []
        self._scene: Scene | None = None
        self._known: dict[int, Mapping[str, Any]] = {}
        self._changed: dict[int, Mapping[str, Any] | None] = {}

    def write(self, view: View, scene: Scene | None) -> int:
        """Writes the rows of a view, and their part of the head. Returns the number of values."""
        if scene is not self._scene and scene is not None:
            self._begin(scene)
        drawn = view.others if view.me is None else [view.me, *view.others]
        width, start = self._columns, len(HEAD)
        end = start + width * len(drawn)
        if end > len(self.values):
            self.values = _zeros(2 * end)
        values, known, numbers = self.values, self._known, self._numbers
        head = (len(drawn), width, view.me is not None, view.tick, view.seen)
        for place, value in enumerate(head, AT["rows"]):
            values[place] = value
        rows: list[float] = []
        for entity, template, position, velocity, attributes, fields, facing in drawn:
            number = numbers[template]
            rows += (entity, number, *position, *velocity, *facing)
            if width > len(COLUMNS):
                names = self._fields[number]
                rows += [fields[name] for name in names]
                rows += [0.0] * (width - len(COLUMNS) - len(names))
            if attributes is not known.get(entity):
                known[entity] = self._changed[entity] = attributes
        values[start:end] = array("d", rows)
        if len(known) > len(drawn):
            there = {each.entity for each in drawn}
            for entity in [entity for entity in known if entity not in there]:
                del known[entity]
                self._changed[entity] = None
        values[AT["attributes"]] = len(self._changed)
        return end

    def note(self, stats: Stats, **more: float) -> None:
        """Writes the rest of the head: statistics, and values by name."""
        values = self.values
        lately = sum(stats.corrections_lately.values())
        measured = (
            stats.rtt_s, stats.lead_s, stats.snapshot_age_s, stats.bytes_up_per_s, stats.bytes_down_per_s,
            stats.late_share_lately, stats.corrections, lately, stats.replayed_ticks, stats.resyncs, stats.reconnects,
            stats.divergences,
        )  # fmt: skip
        for place, value in enumerate(measured, AT["rtt_s"]):
            values[place] = value
        for name, value in more.items():
            values[AT[name]] = value

    def attributes(self) -> dict[int, Mapping[str, Any] | None]:
        """Returns the attributes of the entities whose attributes have changed since the last call.

        None: the entity is not drawn any more.
        """
        changed, self._changed = self._changed, {}
        return changed

    def _begin(self, scene: Scene) -> None:
        """Takes another scene."""
        self._scene = scene
        self._numbers = scene.index_of
        self._fields = fields_of(scene)
        self._columns = len(COLUMNS) + max(map(len, self._fields))


def _zeros(count: int) -> "memoryview[float]":
    return memoryview(bytearray(8 * count)).cast("d")


def fields_of(scene: Scene) -> list[tuple[str, ...]]:
    """Returns the names of the behaviour's fields of each template."""
    names: list[tuple[str, ...]] = [()] * len(scene.templates)
    for entry in scene.behaviours:
        for template in entry.templates:
            names[scene.template(template)] = tuple(field.name for field in entry.fields)
    return names
