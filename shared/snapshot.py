"""One segment's part of a snapshot: encoded once per tick, read by every client that sees the segment.

    segment   [x, y, z, since, rows, gone, edits, check, attributes]   an array inside the snapshot's array
    since     what follows is what changed after this tick; -1 (`KEYFRAME`): rows are all entities of the segment
    rows      n * 33 bytes, the whole exact state of an entity:
              u32 id  u8 template  u8 flags  i32 x, y, z (grid steps from the segment's low corner)
              i32 vx, vy, vz  i8 move_x, move_y  u8 buttons
    gone      n * u32: entities that have left the segment or the world
    edits     n * [u16 block, u8 kind]: blocks that changed, by index z << 10 | y << 5 | x
    check     now and then a checksum of all of the segment, entities and blocks, else 0
    attributes  [u32 id, {name: value}, u32 id, ...]: all that the game's rules say of an entity (its name, say), where
              that has changed, or the entity has come into the segment, since then

On the wire the flags have one bit more: `ACTED` says that the server's rules moved the entity, not the physics.
"""

import zlib
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import msgpack
import numpy as np

from shared import kernels
from shared.checks import Cell
from shared.layout import BUTTONS, CELL, FALLING, ID, MOVE_X, TEMPLATE, Int64s, X
from shared.messages import ENTITY_MAX, ProtocolError, shown
from shared.units import BLOCK, SEGMENT
from shared.world import World

ROW = np.dtype(
    [("id", "<u4"), ("template", "u1"), ("flags", "u1")]
    + [(name, "<i4") for name in ("x", "y", "z", "vx", "vy", "vz")]
    + [("move_x", "i1"), ("move_y", "i1"), ("buttons", "u1")]
)
ROW_BYTES = ROW.itemsize
ROW_BY_SIZE = np.dtype([("id", "<u4"), ("kind", "u1", 2), ("place", "<i4", 6), ("move", "i1", 2), ("buttons", "u1")])
"""The same bytes in runs of equal size, each of which is converted at once."""
COLUMNS_BY_SIZE = (
    (ID, "id"), (slice(TEMPLATE, X), "kind"), (slice(X, MOVE_X), "place"), (slice(MOVE_X, BUTTONS), "move"),
    (BUTTONS, "buttons"),
)  # fmt: skip
VERDICT = np.dtype([("number", "<u4"), ("verdict", "u1")])
EDIT = np.dtype([("block", "<u2"), ("kind", "u1")])
NO_EDITS = np.zeros(0, EDIT)
SIDE = SEGMENT * BLOCK
"""Grid steps along one side of a segment."""
FIELDS = ("id", "template", "flags", "x", "y", "z", "vx", "vy", "vz", "move_x", "move_y", "buttons")
assert len(FIELDS) == CELL == BUTTONS + 1
assert SIDE & (SIDE - 1) == 0
FAR = 1 << 23
"""No index of a segment is further from 0 along an axis."""

KEYFRAME = -1
"""The `since` of a part that holds everything."""
ACTED = 4
"""Flag on the wire: the server's rules placed or threw this entity."""
PART_MAX = 200 * 1024
"""No field of a segment's part is longer, in bytes."""

STATE_LOW = np.array([1, 0, 0, 0, 0, 0, -(1 << 30), -(1 << 30), -(1 << 30), -127, -127, 0], np.int64)
STATE_HIGH = np.array(
    [ENTITY_MAX, 255, FALLING | ACTED, SIDE - 1, SIDE - 1, SIDE - 1, 1 << 30, 1 << 30, 1 << 30, 127, 127, 255], np.int64
)
"""The bounds of a state on the wire: nothing a peer sends may take the kernel out of its tables."""
BOUNDS = {compiled: [kernels.lent(bound, compiled) for bound in (STATE_LOW, STATE_HIGH)] for compiled in (False, True)}


class SegmentPart(NamedTuple):
    """A decoded part: how many of the `states` are its `entities`, `gone` ids, `edits` (`EDIT` records)."""

    segment: Cell
    since: int
    entities: int
    gone: list[int]
    edits: np.ndarray[Any, np.dtype[Any]]
    check: int
    attributes: list[tuple[int, dict[str, Any]]]


def encode_rows(rows: Int64s, acted: Collection[int] = ()) -> bytes:
    """Entities ([n, >= 12] state columns), each in the segment of its position, as packed rows; `acted` flagged."""
    packed = np.empty(len(rows), ROW_BY_SIZE)
    for columns, name in COLUMNS_BY_SIZE:
        packed[name] = rows[:, columns]
    flags = packed["kind"][:, 1]
    flags &= FALLING
    if acted:
        flags |= np.where(np.isin(packed["id"], list(acted)), ACTED, 0).astype(np.uint8)
    packed["place"][:, :3] &= SIDE - 1
    return packed.tobytes()


def encode_part(
    segment: Cell,
    since: int,
    rows: Int64s,
    gone: Sequence[int] = (),
    edits: Sequence[tuple[int, int]] = (),
    *,
    acted: Collection[int] = (),
    check: int = 0,
    attributes: Sequence[Any] = (),
) -> bytes:
    """One segment's part, ready to be joined into any client's snapshot."""
    return join_part(segment, since, encode_rows(rows, acted), gone, edits, check, attributes)


def join_part(
    segment: Cell,
    since: int,
    packed: bytes,
    gone: Sequence[int] = (),
    edits: Sequence[tuple[int, int]] = (),
    check: int = 0,
    attributes: Sequence[Any] = (),
) -> bytes:
    """The same from rows that are packed already."""
    packed_gone = np.array(gone, "<u4").tobytes() if gone else b""
    packed_edits = np.array(edits, EDIT).tobytes() if edits else b""
    return msgpack.packb((*segment, since, packed, packed_gone, packed_edits, check, attributes))  # type: ignore[no-any-return]


def checksum(world: World, segment: Cell) -> int:
    """A number from 1 on for all of a loaded segment as it is: entities and blocks."""
    rows = encode_rows(world.in_segment(segment))
    return zlib.crc32(world.blocks.digest(segment).to_bytes(8, "little") + rows) or 1


def decode_parts(
    segments: Sequence[Any], templates: int, *, compiled: bool = False
) -> tuple[list[SegmentPart], Int64s]:
    """Checks and unpacks `Snapshot.segments`, in a scene of so many templates; `compiled` by Numba, or not.

    Returns:
        The parts, and the states ([n, 12], as `World.put` takes them but for `ACTED`) of all their entities, part
        after part.

    Raises:
        ProtocolError: anything is not as drawn above.
    """
    corners: list[int] = []
    parts = [_decode_part(segment, corners) for segment in segments]
    packed = np.frombuffer(b"".join([segment[4] for segment in segments]), ROW_BY_SIZE)
    states = np.empty((len(packed), CELL), np.int64)
    if len(packed):
        for columns, name in COLUMNS_BY_SIZE:
            states[:, columns] = packed[name]
        kernel = kernels.compiled() if compiled else kernels.PLAIN
        flat, of_parts = kernels.lent(states, compiled), kernels.lent(np.array(corners, np.int64), compiled)
        if not kernel.admit(flat, of_parts, len(parts), *BOUNDS[compiled], templates):
            raise ProtocolError("segment.rows: a value is out of range")
    return parts, states


def _decode_part(part: Any, corners: list[int]) -> SegmentPart:
    """One part; its low corner in grid steps and its number of rows go to the `corners`."""
    if type(part) is not list or len(part) != 9:
        raise ProtocolError("segment: not nine fields")
    x, y, z, since, rows, gone, edits, check, attributes = part
    if not (type(x) is type(y) is type(z) is int and -FAR <= x < FAR and -FAR <= y < FAR and -FAR <= z < FAR):
        raise ProtocolError(f"segment {shown(x)} {shown(y)} {shown(z)}: not allowed")
    if type(check) is not int or not 0 <= check < 1 << 32:
        raise ProtocolError(f"segment.check = {shown(check)}: not allowed")
    if type(since) is not int or not -1 <= since < 1 << 53:
        raise ProtocolError(f"segment.since = {shown(since)}: not allowed")
    if not type(rows) is type(gone) is type(edits) is bytes or max(len(rows), len(gone), len(edits)) > PART_MAX:
        raise ProtocolError("segment: rows, gone or edits are no bytes, or too many")
    if len(rows) % ROW_BYTES or len(gone) % 4 or len(edits) % EDIT.itemsize:
        raise ProtocolError("segment: part of a row")
    edited = np.frombuffer(edits, EDIT) if edits else NO_EDITS
    if edits and int(edited["block"].max()) >= SEGMENT**3:
        raise ProtocolError("segment.edits: a block is out of range")
    left = np.frombuffer(gone, "<u4").tolist() if gone else []
    said = _decode_attributes(attributes) if attributes != [] else []
    entities = len(rows) // ROW_BYTES
    corners += (x * SIDE, y * SIDE, z * SIDE, entities)
    return SegmentPart((x, y, z), since, entities, left, edited, check, said)


def _decode_attributes(attributes: Any) -> list[tuple[int, dict[str, Any]]]:
    if type(attributes) is not list or len(attributes) % 2:
        raise ProtocolError("segment.attributes: not allowed")
    said = list(zip(attributes[::2], attributes[1::2], strict=True))
    for entity, values in said:
        if type(entity) is not int or not 0 < entity <= ENTITY_MAX:
            raise ProtocolError(f"segment.attributes: entity {shown(entity)}: not allowed")
        if type(values) is not dict or any(type(name) is not str for name in values):
            raise ProtocolError(f"segment.attributes of entity {entity}: not allowed")
    return said
