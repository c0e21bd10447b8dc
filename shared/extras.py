"""The extra columns of a state: what an entity has beyond its motion, in scenes that use it.

A state has 12 columns (`shared.layout`). In a scene with an aim or with behaviours further columns follow:

    aim_x, aim_y, aim_z     the latest aim of the entity, if the scene has an aim
    wakes_at                the tick at which the entity asked to have a turn; 0: none
    acts                    the number of its edits, spawns and announcements, in 16 bits: equal states did the same
    alive                   one bit for each of its spawned entities that exists, and the bit `RESERVED` if the numbers
                            after its own are reserved for them
    ...                     the fields of its behaviour; the columns are shared by all behaviours of the scene

On the wire (`shared.snapshot`), the changed extra columns of an entity are one record:

    u32 id   mask, one bit per column, in whole bytes   the values of these columns, each in its number of bytes

An entity whose whole state is sent has its start values, except for the columns in its record. All numbers are
little-endian.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from shared.arrays import np
from shared.checks import SceneError
from shared.fields import ENTITY_MAX
from shared.layout import CELL, COLUMNS, Int64s
from shared.messages import ProtocolError

if TYPE_CHECKING:
    from shared.scene import Scene

AIM, HIDDEN = ("aim_x", "aim_y", "aim_z"), ("wakes_at", "acts", "alive")
"""Names of the columns that are not fields of a behaviour."""
AIM_PART = 1 << 15
"""Bound of a part of an aim: from -AIM_PART to AIM_PART - 1."""
HIDDEN_BITS = (32, 16, 40)
"""Sizes of the hidden columns, in bits."""
AT_ONCE = 1
"""Value of `wakes_at` that asks for a turn at the next tick."""
RESERVED = 1 << 32
"""Bit of `alive`: numbers are reserved for what the entity spawns."""


class Column(NamedTuple):
    """An extra column: its name (of the first behaviour that uses it), its range, and its bytes on the wire."""

    name: str
    low: int
    high: int
    size: int


class Record(NamedTuple):
    """The changed extra columns of one entity: pairs of column and value."""

    entity: int
    values: list[tuple[int, int]]


class Extras:
    """The extra columns of a scene; `count` is 0 in a scene without any.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: "Scene") -> None:
        self.aims = scene.aim
        behaviours = scene.behaviours
        columns = [Column(name, -AIM_PART, AIM_PART - 1, 2) for name in AIM] if self.aims else []
        self.wakes_at = len(columns)
        self.acts, self.alive, self.first = (self.wakes_at + k for k in (1, 2, 3))
        """Places of the hidden columns, and of the first field, among the extra columns."""
        if behaviours:
            columns += [
                Column(name, 0, (1 << bits) - 1, bits // 8) for name, bits in zip(HIDDEN, HIDDEN_BITS, strict=True)
            ]
        for k in range(max((len(entry.fields) for entry in behaviours), default=0)):
            fields = [entry.fields[k] for entry in behaviours if k < len(entry.fields)]
            low, high = min(each.low for each in fields), max(each.high for each in fields)
            bits = max(each.bits + (low < 0 and not each.signed) for each in fields)
            columns.append(Column(fields[0].name, low, high, -(-bits // 8)))
        self.columns = tuple(columns)
        self.count = len(columns)
        self.names = [*COLUMNS[:CELL], *(column.name for column in columns)]
        """Names of all columns of a state."""
        self.mask_bytes = -(-self.count // 8)
        n = len(scene.templates)
        self.starts = np.zeros((n, self.count), np.int64)
        """Values of an entity of which nothing else is known, [templates, count]."""
        self.behaviour_of = np.full(n, -1, np.int64)
        """Number of each template's behaviour in the scene; -1: none."""
        self.blocks = [0] * n
        """Number of ids that are reserved for what a new entity of each template spawns; they follow its own id."""
        self.spawns = max((entry.spawns for entry in behaviours), default=0)
        """Number of ids that are reserved for one entity, if any are."""
        for index, entry in enumerate(behaviours):
            for name in entry.templates:
                kind = scene.template(name, f"behaviours.{entry.name}.templates")
                if self.behaviour_of[kind] >= 0:
                    raise SceneError(f"behaviours.{entry.name}.templates: {name!r} has a behaviour already")
                self.behaviour_of[kind] = index
                if entry.spawns:
                    self.blocks[kind] = self.spawns
                    self.starts[kind, self.alive] = RESERVED
                self.starts[kind, self.first : self.first + len(entry.fields)] = [f.start for f in entry.fields]
        self.new = self.starts.copy()
        """Values of a new entity, [templates, count]: `starts`, but an entity with a behaviour has a turn at once."""
        if behaviours:
            for kind, behaviour in enumerate(self.behaviour_of.tolist()):
                if behaviour >= 0:
                    self.new[kind, self.wakes_at] = AT_ONCE

    def widened(self, states: Int64s) -> Int64s:
        """Returns states with all columns; those with 12 columns get the start values of their templates."""
        if states.shape[1] == CELL + self.count:
            return states
        return np.concatenate((states[:, :CELL], self.starts[states[:, 1]]), axis=1)

    def whole(self, entity: int, template: int, values: Iterable[int]) -> bytes:
        """Returns the record of an entity whose whole state is sent; empty if it has its start values."""
        start = self.starts[template].tolist()
        mask = sum(1 << k for k, (value, first) in enumerate(zip(values, start, strict=True)) if value != first)
        return self.record(entity, mask, list(values)) if mask else b""

    def record(self, entity: int, mask: int, values: list[int]) -> bytes:
        """Returns the record of an entity with the columns of a mask."""
        packed = entity.to_bytes(4, "little") + mask.to_bytes(self.mask_bytes, "little")
        for k, column in enumerate(self.columns):
            if mask >> k & 1:
                packed += values[k].to_bytes(column.size, "little", signed=column.low < 0)
        return packed

    def decode(self, packed: bytes) -> list[Record]:
        """Returns the records in the bytes of a segment's part.

        Raises:
            ProtocolError: the bytes are not records of this scene.
        """
        records, at = [], 0
        while at < len(packed):
            entity = int.from_bytes(packed[at : at + 4], "little")
            mask = int.from_bytes(packed[at + 4 : at + 4 + self.mask_bytes], "little")
            at += 4 + self.mask_bytes
            if at > len(packed) or not 0 < entity <= ENTITY_MAX or mask >> self.count:
                raise ProtocolError("segment.fields: not allowed")
            values: list[tuple[int, int]] = []
            for k, column in enumerate(self.columns):
                if mask >> k & 1:
                    value = int.from_bytes(packed[at : at + column.size], "little", signed=column.low < 0)
                    at += column.size
                    if at > len(packed) or not column.low <= value <= column.high:
                        raise ProtocolError(f"segment.fields: {column.name} = {value}: not allowed")
                    values.append((k, value))
            records.append(Record(entity, values))
        return records
