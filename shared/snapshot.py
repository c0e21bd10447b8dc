"""The parts of a snapshot, one per segment: encoded once per tick, and sent to every client that sees the segment.

    segment   [x, y, z, ago, turns, rows, gone, check, edits, attributes, fields]   an array inside the snapshot's
              array, without the fields at its end that are empty
    ago       the number of ticks that this part covers; -1 (`KEYFRAME`): rows are all entities of the segment
    turns     n * [gap, u8 events, new input, stops], ascending by id: entities that did not go on as before; only if
              `ago` is 1 (below)
    rows      n * 33 bytes, the whole exact state of an entity:
              u32 id  u8 template  u8 flags  i32 x, y, z (grid steps from the segment's low corner)
              i32 vx, vy, vz  i8 move_x, move_y  u8 buttons
    gone      n * u32: entities that have left the segment or the world
    edits     n * [u16 block, u8 kind]: blocks that changed, by index z << 10 | y << 5 | x
    check     sometimes a checksum of the segment, its entities and its blocks; otherwise 0
    attributes  [u32 id, {name: value}, u32 id, ...]: all attributes of an entity (its name, for example), if they
              changed in these ticks, or the entity came into the segment
    fields    the extra columns of entities that changed (`shared.extras`), in scenes that have any

The parts of a turn:

    gap       its id minus the one before it (0 at first) minus 1: the lowest 6 bits in the first byte, then 7 bits in
              each further byte. Bit 6 of the first byte, and bit 7 of the others: another byte follows
    events    follow if bit 7 of the first byte is set; otherwise they are `TOLD` and `NEW_MOVE`
    input     beside `TOLD`: i8 move_x, i8 move_y if it has `NEW_MOVE`; u8 buttons if it has `NEW_BUTTONS`
    stops     for each axis along which it stopped, a byte with its block b within the segment: 0 | b or 32 | b: the low
              or high side of the entity's box touches the block's low plane; 128 | b: three more bytes have the place
              within the block, in grid steps

On the wire the flags have two more bits. `ACTED`: the server's rules acted on the entity (placed it, threw it, changed
its template). `PLACED`: the rules placed the entity, so it did not move from its old position to the new one.

Theory of operation. The physics is equal on both sides, so the motion of an entity is not sent as long as nothing
happens to it: its state of one tick gives its state of the next (`World.follow`). The server sends only the events of
its turn (`layout.STOP_X` ...): it stopped, walks again, falls, jumps, has a new input. A turn depends on its
surroundings through these events alone. So the result is exact whether the client knows the surroundings or not. An
entity that was written, or has changed its segment, is sent as a row. So is every entity with an event if a part covers
more than one tick.
"""

import functools
import hashlib
import struct
from collections.abc import Collection, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

from shared import bulk, kernels
from shared.arrays import np
from shared.checks import Cell
from shared.fields import ENTITY_MAX, shown
from shared.kernels import Kernel
from shared.layout import BUTTONS, CELL, FALLING, ID, MOVE_X, TEMPLATE, TURN, WIDTH_SHIFT, Int64s, X
from shared.messages import ProtocolError, pack
from shared.units import BLOCK, SEGMENT
from shared.world import World

ROW = struct.Struct("<IBB6i2bB")
"""Format of a row of `rows`."""
ROW_BYTES = ROW.size
"""Length of a row, in bytes."""
TURN_BYTES_MIN = 2
"""Least length of a packed turn, in bytes: one without a new input and without a stop."""
FLAGS_AT = 5
"""Place of the flags within a row, in bytes."""
COLUMNS_BY_SIZE = (
    (ID, "id"), (slice(TEMPLATE, X), "kind"), (slice(X, MOVE_X), "place"), (slice(MOVE_X, BUTTONS), "move"),
    (BUTTONS, "buttons"),
)  # fmt: skip
"""Columns of a state for each field of `row_by_size`."""
VERDICT = struct.Struct("<IB")
"""Format of an entry of `Snapshot.verdicts`: the number of a command, and its verdict."""
EDIT = struct.Struct("<HB")
"""Format of an entry of `edits`: block and kind."""
DROP = struct.Struct("<3i")
"""Format of an entry of `Snapshot.drops`: the index of a segment."""
NO_STATES = np.zeros((0, CELL), np.int64)
NO_TURNS = np.zeros((0, TURN), np.int64)
NO_FIELDS: list[Any] = [b"", b"", b"", 0, b"", [], b""]
"""Values of the fields from `turns` on that a part leaves out."""
SIDE = SEGMENT * BLOCK
"""Length of a segment's side, in grid steps."""
FIELDS = ("id", "template", "flags", "x", "y", "z", "vx", "vy", "vz", "move_x", "move_y", "buttons")
"""Names of the columns of a state."""
assert len(FIELDS) == CELL == BUTTONS + 1
assert SIDE & (SIDE - 1) == 0
assert (ROW_BYTES, ENTITY_MAX) == (bulk.ROW_BYTES, bulk.ID_MAX)
FAR = 1 << 23
"""Bound of a segment's index along each axis, in segments: from `-FAR` to `FAR - 1`."""

KEY_ROW = (1 << bulk.ID_BITS) - 1
"""Mask of a row's place in the array of entities within a key of `bulk.muster`."""
KEYFRAME = -1
"""Value of `ago` in a part that has all entities of the segment."""
ACTED = 4
"""Flag on the wire: the server's rules acted on this entity."""
PLACED = 2
"""Flag on the wire: the server's rules placed this entity; `ACTED` is set, too."""
PART_MAX = 200 * 1024
"""Longest field of a segment's part, in bytes."""

STATE_LOW = np.array([1, 0, 0, 0, 0, 0, -(1 << 30), -(1 << 30), -(1 << 30), -127, -127, 0], np.int64)
"""Lowest values of a state on the wire. Beyond the bounds, a peer could make the kernel leave its tables."""
STATE_HIGH = np.array(
    [ENTITY_MAX, 255, FALLING | ACTED | PLACED, SIDE - 1, SIDE - 1, SIDE - 1, 1 << 30, 1 << 30, 1 << 30, 127, 127, 255],
    np.int64,
)
"""Greatest values of a state on the wire."""


class DecodedDelta(NamedTuple):
    """A decoded part of a snapshot.

    `entities` is the number of the part's states, `gone` has ids, and `edits` has pairs of block and kind. The other
    fields are those of the wire format; `Extras.decode` reads `fields`.
    """

    segment: Cell
    ago: int
    entities: int
    gone: list[int]
    edits: list[tuple[int, int]]
    check: int
    attributes: list[tuple[int, dict[str, Any]]]
    fields: bytes


@functools.cache
def row_by_size() -> "np.dtype[Any]":
    """Returns numpy's layout of a row as runs of fields of equal size, each of which is converted at once."""
    runs = [("id", "<u4"), ("kind", "u1", 2), ("place", "<i4", 6), ("move", "i1", 2), ("buttons", "u1")]
    return np.dtype(runs)


def encode_rows(rows: Int64s, acted: Collection[int] = (), placed: Collection[int] = ()) -> bytes:
    """Returns entities packed as rows, with positions from the low corner of the segment that each is in.

    Args:
        rows: entities, [n, at least 12]; the first 12 columns are the state.
        acted: ids that get the flag `ACTED`.
        placed: ids that get the flags `ACTED` and `PLACED`.
    """
    packed = np.empty(len(rows), row_by_size())
    for columns, name in COLUMNS_BY_SIZE:
        packed[name] = rows[:, columns]
    flags = packed["kind"][:, 1]
    flags &= FALLING
    for ids, flag in ((acted, ACTED), (placed, ACTED | PLACED)):
        if ids:
            flags |= np.where(np.isin(packed["id"], list(ids)), flag, 0).astype(np.uint8)
    packed["place"][:, :3] &= SIDE - 1
    return packed.tobytes()


class SegmentDelta(NamedTuple):
    """The changes of one segment in a tick: its segment delta.

    `ids` are the entities that something happened to, `whole` those of them that are sent as rows, and `packed` has the
    fields `turns` and `rows`.
    """

    segment: Cell
    ids: list[int]
    whole: list[int]
    packed: tuple[bytes, bytes]


class TickEncoder:
    """The tick encoder: packs the changes of all entities in a tick by segment. Its buffers are reused in every tick.

    Args:
        world: the server's world, which other code steps.
        check_ticks: number of ticks between two checksums of a segment in which something changes.
    """

    def __init__(self, world: World, check_ticks: int) -> None:
        self._world, self._check_ticks = world, check_ticks
        self._allocate(len(world.arrays.changed))

    def pack(self, acted: Collection[int], placed: Collection[int] = ()) -> tuple[list[SegmentDelta], set[Cell]]:
        """Packs the entities that the latest step changed.

        Args:
            acted: ids of entities on which the rules acted.
            placed: ids of entities that the rules placed.

        Returns:
            The changes of each segment, and the segments that are due for a checksum.
        """
        w, tick = self._world.arrays, self._world.tick
        if len(w.changed) >= len(self._ids):
            self._allocate(len(w.changed))
        mine = self._ids, self._parts, self._due, self._packed
        n_parts = self._world.kernel.news(w.entities, w.templates, w.changed, w.lengths, tick, self._check_ticks, *mine)
        if not n_parts and not self._due[0]:
            return [], set()
        deltas: list[SegmentDelta] = []
        start = at = 0
        parts = self._parts[:n_parts].tolist()
        for i in range(0, n_parts, bulk.PART):
            x, y, z, whole, end, turns, stop = parts[i : i + bulk.PART]
            ids = self._ids[start:end].tolist()
            for row, entity in enumerate(ids[whole - start :] if acted or placed else ()):
                if entity in placed:
                    self._packed[turns + row * ROW_BYTES + FLAGS_AT] |= ACTED | PLACED
                elif entity in acted:
                    self._packed[turns + row * ROW_BYTES + FLAGS_AT] |= ACTED
            packed = self._packed[at:stop].tobytes()
            fields = packed[: turns - at], packed[turns - at :]
            deltas.append(SegmentDelta((x, y, z), ids, ids[whole - start :], fields))
            start, at = end, stop
        due = self._due[1 : 1 + self._due[0]].tolist()
        return deltas, {(due[i], due[i + 1], due[i + 2]) for i in range(0, len(due), 3)}

    def rows_in(self, segment: Cell) -> tuple[bytes, bytes]:
        """Returns the keys of all entities in a loaded segment, ascending by id, and the entities packed as rows.

        A key is an i64 with the id of an entity and its place in memory, as in `bulk.muster`.
        """
        world, w = self._world, self._world.arrays
        if len(w.changed) >= len(self._ids):
            self._allocate(len(w.changed))
        end = world.kernel.muster(w.entities, w.heads, self._ids, self._packed, world.blocks.rows[segment])
        if not end:
            return b"", b""
        return self._ids[: end // ROW_BYTES].tobytes(), self._packed[:end].tobytes()

    def _allocate(self, room: int) -> None:
        """Makes room for `room` entities."""
        self._ids, self._parts, self._due, self._packed = (
            self._world.kernel.lent(np.empty(1 + room * numbers, kind))
            for numbers, kind in ((1, np.int64), (bulk.PART, np.int64), (3, np.int64), (ROW_BYTES, np.uint8))
        )


def encode_part(
    segment: Cell,
    ago: int,
    rows: Int64s,
    gone: Sequence[int] = (),
    edits: Sequence[tuple[int, int]] = (),
    *,
    acted: Collection[int] = (),
    placed: Collection[int] = (),
    check: int = 0,
    attributes: Sequence[Any] = (),
    fields: bytes = b"",
) -> bytes:
    """Returns a segment's part, encoded for `messages.join_snapshot`.

    Args:
        segment: index of the segment.
        ago: number of ticks that the part covers, or `KEYFRAME`.
        rows: entities that are sent whole, [n, at least 12].
        gone: ids of entities that have left the segment.
        edits: changed blocks, as pairs of index and kind.
        acted: ids that get the flag `ACTED`.
        placed: ids that get the flags `ACTED` and `PLACED`.
        check: checksum of the segment, or 0.
        attributes: id, attributes, id, attributes, ...
        fields: records of extra columns (`shared.extras`).
    """
    packed = b"", encode_rows(rows, acted, placed)
    return join_part(segment, ago, packed, gone, edits, check, pack(attributes) if attributes else b"", fields)


def join_part(
    segment: Cell,
    ago: int,
    packed: tuple[bytes, bytes],
    gone: Sequence[int] = (),
    edits: Sequence[tuple[int, int]] = (),
    check: int = 0,
    attributes: bytes = b"",
    extra: bytes = b"",
) -> bytes:
    """Returns a segment's part like `encode_part`, from `packed`: its turns and rows.

    `attributes` is the field of this name, encoded already; empty: there are none.
    """
    packed_gone = struct.pack(f"<{len(gone)}I", *gone) if gone else b""
    packed_edits = b"".join(EDIT.pack(*edit) for edit in edits) if edits else b""
    fields = [*packed, packed_gone, check, packed_edits]
    if attributes:
        part = pack((*segment, ago, *fields))
        more = (attributes, pack(extra)) if extra else (attributes,)
        return b"".join((bytes((part[0] + len(more),)), part[1:], *more))  # the first byte has the number of fields
    fields += [], extra
    while fields and not fields[-1]:
        del fields[-1]
    return pack((*segment, ago, *fields))


def checksum(world: World, segment: Cell) -> int:
    """Returns the checksum of a loaded segment, over its entities and blocks: 1 to 2^32 - 1.

    It is the first 4 bytes, little-endian, of a SHA-256 over the segment's digest, the rows of its entities, and their
    extra columns as i64; 1 stands for 0.
    """
    kernel = world.kernel
    keys, packed = np.empty(len(world), np.int64), np.empty(len(world) * ROW_BYTES, np.uint8)
    mine = kernel.lent(keys), kernel.lent(packed)
    end = kernel.muster(world.arrays.entities, world.arrays.heads, *mine, world.blocks.rows[segment])
    whole = hashlib.sha256(world.blocks.digest(segment))
    whole.update(packed[:end].data)
    if world.extras.count:
        rows = (keys[: end // ROW_BYTES] & KEY_ROW) >> WIDTH_SHIFT
        whole.update(world.extra_rows[rows].astype("<i8").tobytes())
    return int.from_bytes(whole.digest()[:4], "little") or 1


def decode_parts(
    segments: Sequence[Any], templates: int, kernel: Kernel | None = None
) -> tuple[list[DecodedDelta], Int64s, Int64s]:
    """Checks and unpacks `Snapshot.segments`.

    Args:
        segments: the segments of a snapshot.
        templates: number of templates in the scene.
        kernel: kernel that unpacks; None: the plain one.

    Returns:
        The parts; the states of all their entities, part after part ([n, 12], as for `World.put`, but with the flags
        `ACTED` and `PLACED`); and all their turns ([n, 8], as for `World.follow`).

    Raises:
        ProtocolError: a part breaks the format that this module describes.
    """
    if not segments:
        return [], NO_STATES, NO_TURNS
    corners: list[int] = []
    packed: tuple[list[bytes], list[bytes]] = ([], [])
    parts = [_decode_part(segment, corners, packed) for segment in segments]
    turns, rows = map(b"".join, packed)
    kernel = kernel or kernels.get(False)
    states = _decode_rows(rows, corners, templates, kernel) if rows else NO_STATES
    return parts, states, _decode_turns(turns, packed[0], kernel) if turns else NO_TURNS


def _decode_rows(rows: bytes, corners: list[int], templates: int, kernel: Kernel) -> Int64s:
    states = np.empty((len(rows) // ROW_BYTES, CELL), np.int64)
    of_parts, low, high = map(kernel.lent, (np.array(corners, np.int64), STATE_LOW, STATE_HIGH))
    if not kernel.read_rows(rows, of_parts, low, high, templates, kernel.lent(states)):
        raise ProtocolError("segment.rows: a value is out of range")
    return states


def _decode_turns(packed: bytes, parts: list[bytes], kernel: Kernel) -> Int64s:
    ends = np.array(list(accumulate(map(len, parts))), np.int64)
    turns = np.empty((len(packed) // TURN_BYTES_MIN, TURN), np.int64)
    n = kernel.read_turns(packed, kernel.lent(ends), kernel.lent(turns))
    if n < 0:
        raise ProtocolError("segment.turns: too few bytes, an id that is too large, or an unknown kind of stop")
    return turns[:n]


def _decode_part(part: Any, corners: list[int], packed: tuple[list[bytes], ...]) -> DecodedDelta:
    """Checks and returns one part.

    Appends its low corner (grid steps) and its number of rows to `corners`, and its turns and rows to `packed`.
    """
    if type(part) is not list or not 4 <= len(part) <= 11:
        raise ProtocolError("segment: must be a list of 4 to 11 fields")
    x, y, z, ago, turns, rows, gone, check, edits, attributes, fields = part + NO_FIELDS[len(part) - 4 :]
    if not (type(x) is type(y) is type(z) is int and -FAR <= x < FAR and -FAR <= y < FAR and -FAR <= z < FAR):
        raise ProtocolError(f"segment {shown(x)} {shown(y)} {shown(z)}: not allowed")
    if type(check) is not int or not 0 <= check < 1 << 32:
        raise ProtocolError(f"segment.check = {shown(check)}: not allowed")
    if type(ago) is not int or not -1 <= ago < 1 << 53:
        raise ProtocolError(f"segment.ago = {shown(ago)}: not allowed")
    if not (
        type(turns) is type(rows) is type(gone) is type(edits) is type(fields) is bytes
        and max(len(turns), len(rows), len(gone), len(edits), len(fields)) <= PART_MAX
        and len(rows) % ROW_BYTES == len(gone) % 4 == len(edits) % EDIT.size == 0
    ):
        raise ProtocolError("segment: turns, rows, gone, edits or fields are not bytes, too long, or of a wrong length")
    if turns and ago != 1:
        raise ProtocolError(f"segment.turns: not allowed with ago = {ago}, only with 1")
    all_turns, all_rows = packed
    all_turns.append(turns)
    all_rows.append(rows)
    edited = list(EDIT.iter_unpack(edits)) if edits else []
    if edits and max(edited)[0] >= SEGMENT**3:
        raise ProtocolError("segment.edits: a block is out of range")
    left = list(struct.unpack(f"<{len(gone) // 4}I", gone)) if gone else []
    tables = _decode_attributes(attributes) if attributes != [] else []
    entities = len(rows) // ROW_BYTES
    corners += (x * SIDE, y * SIDE, z * SIDE, entities)
    return DecodedDelta((x, y, z), ago, entities, left, edited, check, tables, fields)


def _decode_attributes(attributes: Any) -> list[tuple[int, dict[str, Any]]]:
    if type(attributes) is not list or len(attributes) % 2:
        raise ProtocolError("segment.attributes: must be a list of pairs of entity and table")
    tables = list(zip(attributes[::2], attributes[1::2], strict=True))
    for entity, values in tables:
        if type(entity) is not int or not 0 < entity <= ENTITY_MAX:
            raise ProtocolError(f"segment.attributes: entity {shown(entity)}: not allowed")
        if type(values) is not dict or any(type(name) is not str for name in values):
            raise ProtocolError(f"segment.attributes of entity {entity}: not allowed")
    return tables
