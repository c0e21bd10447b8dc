"""One segment's part of a snapshot: encoded once per tick, read by every client that sees the segment.

    segment   [x, y, z, ago, heads, tails, rows, gone, check, edits, attributes]   an array inside the snapshot's array,
              without the fields at its end that are empty
    ago       what follows is what happened in so many ticks; -1 (`KEYFRAME`): rows are all entities of the segment
    heads     n * [u32 id, u8 events]: entities that did not go on as they had, where `ago` is 1
    tails     for each of them, as its events say: i8 move_x, move_y u8 buttons if it was `TOLD` another wish; then i32
              for each axis along which it stopped, in grid steps from the segment's low corner
    rows      n * 33 bytes, the whole exact state of an entity:
              u32 id  u8 template  u8 flags  i32 x, y, z (grid steps from the segment's low corner)
              i32 vx, vy, vz  i8 move_x, move_y  u8 buttons
    gone      n * u32: entities that have left the segment or the world
    edits     n * [u16 block, u8 kind]: blocks that changed, by index z << 10 | y << 5 | x
    check     now and then a checksum of all of the segment, entities and blocks, else 0
    attributes  [u32 id, {name: value}, u32 id, ...]: all that the game's rules say of an entity (its name, say), where
              that has changed, or the entity has come into the segment, since then

On the wire the flags have two bits more. `ACTED`: the server's rules acted on the entity (placed it, threw it, changed
its template). `PLACED`: they placed it, so it did not move from where it was before to where it is.

Theory of operation. The physics is the same on both sides, so what an entity does as long as nothing happens to it is
not sent: whoever has its state of a tick has that of the next, by `World.follow`. What is sent is what took place in
its turn (`layout.STOP_X` ...): it stopped, walks on, falls, jumps, wishes something else. That is all that a turn takes
from its surroundings, so the result is exact whether the client knows them or not. An entity that was written, or
changed its segment, is sent whole, as is all that something has happened to in a span of more ticks than one.
"""

import hashlib
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from shared import bulk, kernels
from shared.checks import Cell
from shared.kernels import Kernel
from shared.layout import (
    BUTTONS,
    CELL,
    FALLING,
    ID,
    MOVE_X,
    TEMPLATE,
    TURN,
    Int64s,
    X,
)
from shared.messages import ENTITY_MAX, ProtocolError, pack, shown
from shared.units import BLOCK, SEGMENT
from shared.world import World

ROW = np.dtype(
    [("id", "<u4"), ("template", "u1"), ("flags", "u1")]
    + [(name, "<i4") for name in ("x", "y", "z", "vx", "vy", "vz")]
    + [("move_x", "i1"), ("move_y", "i1"), ("buttons", "u1")]
)
ROW_BYTES = ROW.itemsize
FLAGS_AT = 5
ROW_BY_SIZE = np.dtype([("id", "<u4"), ("kind", "u1", 2), ("place", "<i4", 6), ("move", "i1", 2), ("buttons", "u1")])
"""The same bytes in runs of equal size, each of which is converted at once."""
COLUMNS_BY_SIZE = (
    (ID, "id"), (slice(TEMPLATE, X), "kind"), (slice(X, MOVE_X), "place"), (slice(MOVE_X, BUTTONS), "move"),
    (BUTTONS, "buttons"),
)  # fmt: skip
HEAD = np.dtype([("id", "<u4"), ("events", "u1")])
VERDICT = np.dtype([("number", "<u4"), ("verdict", "u1")])
EDIT = np.dtype([("block", "<u2"), ("kind", "u1")])
NO_EDITS = np.zeros(0, EDIT)
NO_STATES = np.zeros((0, CELL), np.int64)
NO_TURNS = np.zeros((0, TURN), np.int64)
NO_FIELDS: list[Any] = [b"", b"", b"", b"", 0, b"", []]
"""What the fields of a part from `heads` on are where they are left out."""
SIDE = SEGMENT * BLOCK
"""Grid steps along one side of a segment."""
FIELDS = ("id", "template", "flags", "x", "y", "z", "vx", "vy", "vz", "move_x", "move_y", "buttons")
assert len(FIELDS) == CELL == BUTTONS + 1
assert SIDE & (SIDE - 1) == 0
assert (HEAD.itemsize, ROW_BYTES) == (bulk.HEAD_BYTES, bulk.ROW_BYTES)
FAR = 1 << 23
"""No index of a segment is further from 0 along an axis."""

KEYFRAME = -1
"""The `ago` of a part that holds everything."""
ACTED = 4
"""Flag on the wire: the server's rules acted on this entity."""
PLACED = 2
"""Flag on the wire: the server's rules placed this entity; `ACTED` is set, too."""
PART_MAX = 200 * 1024
"""No field of a segment's part is longer, in bytes."""

STATE_LOW = np.array([1, 0, 0, 0, 0, 0, -(1 << 30), -(1 << 30), -(1 << 30), -127, -127, 0], np.int64)
STATE_HIGH = np.array(
    [ENTITY_MAX, 255, FALLING | ACTED | PLACED, SIDE - 1, SIDE - 1, SIDE - 1, 1 << 30, 1 << 30, 1 << 30, 127, 127, 255],
    np.int64,
)
"""The bounds of a state on the wire: nothing a peer sends may take the kernel out of its tables."""


class SegmentPart(NamedTuple):
    """A decoded part: how many of the `states` are its `entities`, `gone` ids, `edits` (`EDIT` records)."""

    segment: Cell
    ago: int
    entities: int
    gone: list[int]
    edits: np.ndarray[Any, np.dtype[Any]]
    check: int
    attributes: list[tuple[int, dict[str, Any]]]


def encode_rows(rows: Int64s, acted: Collection[int] = (), placed: Collection[int] = ()) -> bytes:
    """Packs entities ([n, >= 12] state columns), each in the segment of its position.

    Args:
        acted: ids that get the flag `ACTED`.
        placed: ids that get `ACTED` and `PLACED`.
    """
    packed = np.empty(len(rows), ROW_BY_SIZE)
    for columns, name in COLUMNS_BY_SIZE:
        packed[name] = rows[:, columns]
    flags = packed["kind"][:, 1]
    flags &= FALLING
    for ids, flag in ((acted, ACTED), (placed, ACTED | PLACED)):
        if ids:
            flags |= np.where(np.isin(packed["id"], list(ids)), flag, 0).astype(np.uint8)
    packed["place"][:, :3] &= SIDE - 1
    return packed.tobytes()


class Share(NamedTuple):
    """What has happened in a segment: the ids to which, those of them that are sent `whole`, and the fields `heads`,
    `tails` and `rows`."""

    segment: Cell
    ids: list[int]
    whole: list[int]
    packed: tuple[bytes, bytes, bytes]


class News:
    """Packs what has happened to entities in a tick, all at once; what it needs of memory serves for the next, too.

    Args:
        world: stepped elsewhere.
        check_ticks: how often a segment in which something changes is due.
    """

    def __init__(self, world: World, check_ticks: int) -> None:
        self._world, self._check_ticks = world, check_ticks
        self._allocate(len(world.arrays.changed))

    def pack(self, acted: Collection[int], placed: Collection[int] = ()) -> tuple[list[Share], set[Cell]]:
        """What there is to tell of the entities that the latest step changed, and the segments of them that are due.

        Args:
            acted: ids on which the rules acted.
            placed: ids that the rules placed.
        """
        w, tick = self._world.arrays, self._world.tick
        if len(w.changed) >= len(self._ids):
            self._allocate(len(w.changed))
        mine = self._ids, self._parts, self._due, self._packed
        n_parts = self._world.kernel.news(w.entities, w.changed, w.lengths, tick, self._check_ticks, *mine)
        shares: list[Share] = []
        start = at = 0
        parts = self._parts[:n_parts].tolist()
        for i in range(0, n_parts, 8):
            x, y, z, whole, end, heads, tails, stop = parts[i : i + 8]
            ids = self._ids[start:end].tolist()
            for row, entity in enumerate(ids[whole - start :] if acted or placed else ()):
                if entity in placed:
                    self._packed[tails + row * ROW_BYTES + FLAGS_AT] |= ACTED | PLACED
                elif entity in acted:
                    self._packed[tails + row * ROW_BYTES + FLAGS_AT] |= ACTED
            packed = self._packed[at:stop].tobytes()
            fields = packed[: heads - at], packed[heads - at : tails - at], packed[tails - at :]
            shares.append(Share((x, y, z), ids, ids[whole - start :], fields))
            start, at = end, stop
        due = self._due[1 : 1 + self._due[0]].tolist()
        return shares, {(due[i], due[i + 1], due[i + 2]) for i in range(0, len(due), 3)}

    def _allocate(self, room: int) -> None:
        """Makes room for so many entities."""
        self._ids, self._parts, self._due, self._packed = (
            self._world.kernel.lent(np.empty(1 + room * numbers, kind))
            for numbers, kind in ((1, np.int64), (8, np.int64), (3, np.int64), (ROW_BYTES, np.uint8))
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
) -> bytes:
    """One segment's part, ready to be joined into any client's snapshot."""
    return join_part(segment, ago, (b"", b"", encode_rows(rows, acted, placed)), gone, edits, check, attributes)


def join_part(
    segment: Cell,
    ago: int,
    news: tuple[bytes, bytes, bytes],
    gone: Sequence[int] = (),
    edits: Sequence[tuple[int, int]] = (),
    check: int = 0,
    attributes: Sequence[Any] = (),
) -> bytes:
    """The same from heads, tails and rows that are packed already."""
    packed_gone = np.array(gone, "<u4").tobytes() if gone else b""
    packed_edits = np.array(edits, EDIT).tobytes() if edits else b""
    fields = [*news, packed_gone, check, packed_edits, attributes]
    while fields and not fields[-1]:
        del fields[-1]
    return pack((*segment, ago, *fields))


def checksum(world: World, segment: Cell) -> int:
    """The check of a loaded segment as it is, entities and blocks: 1 to 2^32 - 1.

    It is the first 4 bytes, little-endian, of a SHA-256: over the segment's digest and the rows of its entities.
    """
    kernel = world.kernel
    keys, packed = np.empty(len(world), np.int64), np.empty(len(world) * ROW_BYTES, np.uint8)
    mine = kernel.lent(keys), kernel.lent(packed)
    end = kernel.muster(world.arrays.entities, world.arrays.heads, *mine, world.blocks.rows[segment])
    whole = hashlib.sha256(world.blocks.digest(segment))
    whole.update(packed[:end].data)
    return int.from_bytes(whole.digest()[:4], "little") or 1


def decode_parts(
    segments: Sequence[Any], templates: int, kernel: Kernel | None = None
) -> tuple[list[SegmentPart], Int64s, Int64s]:
    """Checks and unpacks `Snapshot.segments`, in a scene of so many templates, by a kernel (None: the plain one).

    Returns:
        The parts, the states ([n, 12], as `World.put` takes them but for `ACTED` and `PLACED`) of all their entities,
        part after part, and all their turns ([n, 8], as `World.follow` takes them).

    Raises:
        ProtocolError: anything is not as drawn above.
    """
    if not segments:
        return [], NO_STATES, NO_TURNS
    corners: list[int] = []
    news: tuple[list[bytes], list[bytes], list[bytes]] = ([], [], [])
    parts = [_decode_part(segment, corners, news) for segment in segments]
    heads, tails, rows = map(b"".join, news)
    kernel = kernel or kernels.get(False)
    states = _decode_rows(rows, corners, templates, kernel) if rows else NO_STATES
    return parts, states, _decode_turns(heads, tails, kernel) if heads or tails else NO_TURNS


def _decode_rows(rows: bytes, corners: list[int], templates: int, kernel: Kernel) -> Int64s:
    states = np.empty((len(rows) // ROW_BYTES, CELL), np.int64)
    of_parts, low, high = map(kernel.lent, (np.array(corners, np.int64), STATE_LOW, STATE_HIGH))
    if not kernel.read_rows(rows, of_parts, low, high, templates, kernel.lent(states)):
        raise ProtocolError("segment.rows: a value is out of range")
    return states


def _decode_turns(heads: bytes, tails: bytes, kernel: Kernel) -> Int64s:
    turns = np.empty((len(heads) // HEAD.itemsize, TURN), np.int64)
    if not kernel.read_turns(heads, tails, kernel.lent(turns)):
        raise ProtocolError("segment.tails: too many or too few")
    return turns


def _decode_part(part: Any, corners: list[int], news: tuple[list[bytes], ...]) -> SegmentPart:
    """One part; its low corner in grid steps and its number of rows go to the `corners`, what they hold to `news`."""
    if type(part) is not list or not 4 <= len(part) <= 11:
        raise ProtocolError("segment: not four to eleven fields")
    x, y, z, ago, heads, tails, rows, gone, check, edits, attributes = part + NO_FIELDS[len(part) - 4 :]
    if not (type(x) is type(y) is type(z) is int and -FAR <= x < FAR and -FAR <= y < FAR and -FAR <= z < FAR):
        raise ProtocolError(f"segment {shown(x)} {shown(y)} {shown(z)}: not allowed")
    if type(check) is not int or not 0 <= check < 1 << 32:
        raise ProtocolError(f"segment.check = {shown(check)}: not allowed")
    if type(ago) is not int or not -1 <= ago < 1 << 53:
        raise ProtocolError(f"segment.ago = {shown(ago)}: not allowed")
    if not (
        type(heads) is type(tails) is type(rows) is type(gone) is type(edits) is bytes
        and max(len(heads), len(tails), len(rows), len(gone), len(edits)) <= PART_MAX
        and len(heads) % HEAD.itemsize == len(rows) % ROW_BYTES == len(gone) % 4 == len(edits) % EDIT.itemsize == 0
    ):
        raise ProtocolError("segment: heads, tails, rows, gone or edits are no bytes, too many, or part of one")
    if heads and ago != 1:
        raise ProtocolError(f"segment.heads of {ago} ticks: not allowed")
    all_heads, all_tails, all_rows = news
    all_heads.append(heads)
    all_tails.append(tails)
    all_rows.append(rows)
    edited = np.frombuffer(edits, EDIT) if edits else NO_EDITS
    if edits and int(edited["block"].max()) >= SEGMENT**3:
        raise ProtocolError("segment.edits: a block is out of range")
    left = np.frombuffer(gone, "<u4").tolist() if gone else []
    said = _decode_attributes(attributes) if attributes != [] else []
    entities = len(rows) // ROW_BYTES
    corners += (x * SIDE, y * SIDE, z * SIDE, entities)
    return SegmentPart((x, y, z), ago, entities, left, edited, check, said)


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
