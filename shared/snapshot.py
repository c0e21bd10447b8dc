"""One segment's part of a snapshot: encoded once per tick, read by every client that sees the segment.

segment   [x, y, z, since, rows, gone, edits]      a MessagePack array inside the snapshot's array
since     what follows is what changed after this tick; -1: rows are all entities of the segment
rows      n * 33 bytes, the whole exact state of an entity:
          u32 id  u8 template  u8 flags  i32 x, y, z (grid steps from the segment's low corner)
          i32 vx, vy, vz  i8 move_x, move_y  u8 buttons
gone      n * u32: entities that have left the segment or the world
edits     n * [u16 block, u8 kind]: blocks that changed, by index z << 10 | y << 5 | x
"""

from typing import Any, NamedTuple

import msgpack
import numpy as np

from shared.checks import Cell
from shared.layout import BUTTONS, CELL, FALLING, FLAGS, ID, TEMPLATE, VX, Int64s, X
from shared.messages import ENTITY_MAX, ProtocolError
from shared.units import BLOCK, SEGMENT

ROW = np.dtype(
    [("id", "<u4"), ("template", "u1"), ("flags", "u1")]
    + [(name, "<i4") for name in ("x", "y", "z", "vx", "vy", "vz")]
    + [("move_x", "i1"), ("move_y", "i1"), ("buttons", "u1")]
)
EDIT = np.dtype([("block", "<u2"), ("kind", "u1")])
SIDE = SEGMENT * BLOCK
"""Grid steps along one side of a segment."""
FIELDS = ("id", "template", "flags", "x", "y", "z", "vx", "vy", "vz", "move_x", "move_y", "buttons")
assert len(FIELDS) == CELL == BUTTONS + 1

PART_MAX = 200 * 1024
"""No field of a segment's part is longer, in bytes."""


class SegmentPart(NamedTuple):
    """A decoded part: `states` [n, 12] as `World.put` takes them, `gone` ids, `edits` (`EDIT` records)."""

    segment: Cell
    since: int
    states: Int64s
    gone: list[int]
    edits: np.ndarray[Any, np.dtype[Any]]


def encode_rows(rows: Int64s, segment: Cell) -> bytes:
    """Entities of one segment ([n, >= 12] state columns) as packed rows."""
    packed = np.empty(len(rows), ROW)
    for column, name in enumerate(FIELDS):
        packed[name] = rows[:, column]
    packed["flags"] &= FALLING
    for axis, name in enumerate("xyz"):
        packed[name] = rows[:, X + axis] - segment[axis] * SIDE
    return packed.tobytes()


def encode_part(segment: Cell, since: int, rows: Int64s, gone: list[int], edits: list[tuple[int, int]]) -> bytes:
    """One segment's part, ready to be joined into any client's snapshot."""
    packed_gone = np.array(gone, "<u4").tobytes()
    packed_edits = np.array(edits, EDIT).tobytes() if edits else b""
    part = (*segment, since, encode_rows(rows, segment), packed_gone, packed_edits)
    return msgpack.packb(part)  # type: ignore[no-any-return]


def decode_part(part: Any, templates: int) -> SegmentPart:
    """Checks and unpacks one element of `Snapshot.segments`, in a scene of so many templates.

    Raises:
        ProtocolError: anything in it is not as drawn above.
    """
    if type(part) is not list or len(part) != 7:
        raise ProtocolError("segment: not seven fields")
    for name, value in zip(("x", "y", "z", "since"), part, strict=False):
        if type(value) is not int or not -(1 << 31) <= value < 1 << 53:
            raise ProtocolError(f"segment.{name} = {str(value)[:40]}: not allowed")
    for name, value, size in zip(("rows", "gone", "edits"), part[4:], (ROW.itemsize, 4, EDIT.itemsize), strict=True):
        if type(value) is not bytes or len(value) > PART_MAX or len(value) % size:
            raise ProtocolError(f"segment.{name}: not allowed")
    segment = (part[0], part[1], part[2])
    if not all(-(1 << 23) <= place < 1 << 23 for place in segment):
        raise ProtocolError(f"segment {segment}: out of range")
    packed = np.frombuffer(part[4], ROW)
    states = np.empty((len(packed), CELL), np.int64)
    for column, name in enumerate(FIELDS):
        states[:, column] = packed[name]
    if len(states) and not _sound(states, templates):
        raise ProtocolError("segment.rows: a value is out of range")
    for axis in range(3):
        states[:, X + axis] += segment[axis] * SIDE
    gone = np.frombuffer(part[5], "<u4").tolist()
    edits = np.frombuffer(part[6], EDIT)
    if len(edits) and int(edits["block"].max()) >= SEGMENT**3:
        raise ProtocolError("segment.edits: a block is out of range")
    return SegmentPart(segment, part[3], states, gone, edits)


def _sound(states: Int64s, templates: int) -> bool:
    places = states[:, X : X + 3]
    ids = states[:, ID]
    return bool(
        ids.min() > 0
        and ids.max() <= ENTITY_MAX
        and states[:, TEMPLATE].max() < templates
        and states[:, FLAGS].max() <= FALLING
        and places.min() >= 0
        and places.max() < SIDE
        and np.abs(states[:, VX : VX + 3]).max() <= 1 << 30
    )
