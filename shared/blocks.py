"""The blocks of a world, as segments: cubes of 32^3 blocks, dense, in one array that the kernel reads.

Two values show whether two segments are equal:

`version` compares within one process. Every change takes the next number of one counter, and a copy takes the number of
its original, so equal versions mean equal blocks. It costs an edit nothing.

`digest` compares between processes and machines. It is a SHA-256 over the segment's bytes, so no client can choose
edits that leave it unchanged. An edit only marks it as stale; it is computed (25 to 40 us) when it is read, or by
`freshen`.

Rejected: a sum or an exclusive-or over the blocks, which an edit can update. About 40 chosen edits leave such a digest
unchanged, and a key does not help, because every client would have to know it.
"""

import hashlib
import itertools
import math
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from shared.arrays import PLAIN, Int32s, Truths, Uint8s, Uint32s, grown, np
from shared.checks import Cell, MissingError, SceneError, cell, shown, whole
from shared.fields import PACKED_MAX
from shared.layout import CELLS
from shared.units import RANGE_BLOCKS, SEGMENT, SEGMENT_SHIFT

BLOCKS = SEGMENT**3
"""Number of blocks in a segment."""
AIR = 0
"""Kind of a block that is empty. The scene says which other kinds are not solid (`Scene.kinds`)."""
KIND_MAX = 255
"""Greatest kind of a block."""
SEGMENT_MAX = RANGE_BLOCKS // SEGMENT
"""Bound of a segment's index along each axis, in segments: from `-SEGMENT_MAX` to `SEGMENT_MAX - 1`."""
FILL_MAX = 1 << 20
"""Limit of the blocks of one `World.fill`."""
DIGEST_BYTES = 16
"""Length of a segment's digest, in bytes."""

Kinds = Uint8s
"""Kinds of blocks; for a whole segment [32768], by index z << 10 | y << 5 | x."""

Large = tuple[Kinds, Uint32s, Int32s]
"""The arrays `kinds`, `solid` and `heads` of `Blocks`."""

_versions = itertools.count(1)


def digest_of(kinds: Kinds) -> bytes:
    """Returns the digest of a segment ([32768] kinds, contiguous): the first 16 bytes of their SHA-256."""
    return hashlib.sha256(kinds.data).digest()[:DIGEST_BYTES]


def pack(kinds: Kinds) -> bytes:
    """Returns the blocks of a segment packed for a message or a file (zlib)."""
    return zlib.compress(kinds.tobytes(), 6)


def unpack(data: bytes) -> Kinds:
    """Returns the [32768] kinds that `pack` packed.

    Raises:
        ValueError: `data` is not one packed segment.
    """
    if len(data) > PACKED_MAX:
        raise ValueError(f"packed segment of {len(data)} bytes: longer than {PACKED_MAX}")
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(data, BLOCKS + 1)
    except zlib.error as error:
        raise ValueError(f"packed segment: {error}") from error
    if len(raw) != BLOCKS or not unpacker.eof or unpacker.unused_data:
        raise ValueError("packed segment: not 32768 blocks")
    return np.frombuffer(raw, np.uint8)


def checked_kinds(kinds: Any) -> Kinds:
    """Returns the blocks of a segment as [32768] kinds.

    Raises:
        SceneError: `kinds` are not 32768 whole numbers from 0 to 255.
    """
    if PLAIN and getattr(kinds, "dtype", None) == np.uint8 and len(kinds) == BLOCKS:
        return kinds  # type: ignore[no-any-return]
    found = np.asarray(kinds)
    good = found.dtype.kind in "iu" and found.size == BLOCKS
    if not good or (found.dtype != np.uint8 and not AIR <= found.min() <= found.max() <= KIND_MAX):
        raise SceneError(f"kinds = {shown(kinds)}: must be {BLOCKS} whole numbers from {AIR} to {KIND_MAX}")
    return found.reshape(-1).astype(np.uint8, copy=False)


def checked_block(x: object, y: object, z: object) -> Cell:
    """Returns the coordinates of a block.

    Raises:
        SceneError: one is not a whole number, or is out of range.
    """
    i, j, k = (whole(part, at, -RANGE_BLOCKS, RANGE_BLOCKS - 1) for at, part in (("x", x), ("y", y), ("z", z)))
    return i, j, k


def checked_segment(index: object) -> Cell:
    """Returns the index of a segment.

    Raises:
        SceneError: it is not three whole numbers, or one is out of range.
    """
    return cell(index, "segment", -SEGMENT_MAX, SEGMENT_MAX - 1)


def checked_box(low: object, high: object) -> tuple[Cell, Cell]:
    """Returns the corners of a box of blocks, `low` and `high` (excluded).

    Raises:
        SceneError: a corner is not three whole numbers or is out of range, `high` is below `low`, or the box has more
            than `FILL_MAX` blocks.
    """
    first, end = (cell(corner, at, -RANGE_BLOCKS, RANGE_BLOCKS) for corner, at in ((low, "low"), (high, "high")))
    sides = [b - a for a, b in zip(first, end, strict=True)]
    if min(sides) < 0:
        raise SceneError(f"high = {end}: must not be below low = {first} along any axis")
    if math.prod(sides) > FILL_MAX:
        raise SceneError(f"low = {first}, high = {end}: {math.prod(sides)} blocks; at most {FILL_MAX} at once")
    return first, end


def segment_of(x: int, y: int, z: int) -> Cell:
    """Returns the index of the segment that has a block."""
    return x >> SEGMENT_SHIFT, y >> SEGMENT_SHIFT, z >> SEGMENT_SHIFT


def offset_of(x: int, y: int, z: int) -> int:
    """Returns the index of a block within its segment: z << 10 | y << 5 | x."""
    inside = SEGMENT - 1
    return (z & inside) << 10 | (y & inside) << 5 | (x & inside)


class Blocks:
    """The loaded segments of a world, each in a row of the arrays.

    Args:
        passable: kinds of blocks that are not solid, besides air.
    """

    def __init__(self, passable: Iterable[int] = ()) -> None:
        self.stops = [kind != AIR for kind in range(KIND_MAX + 1)]
        """Whether blocks of a kind are solid, by kind."""
        for kind in passable:
            self.stops[kind] = False
        self._solid_kinds = None if sum(self.stops) == KIND_MAX else np.array(self.stops, np.bool_)
        self._digits = bytes(b"01"[stops] for stops in self.stops)
        self.count = 1  # row 0 is layout.NOWHERE
        self.rows: dict[Cell, int] = {}
        self.kinds: Kinds = np.zeros((1, BLOCKS), np.uint8)
        self.solid = np.zeros((1, SEGMENT * SEGMENT), np.uint32)  # one bit per block for the kernel
        self.segments = np.zeros((1, 3), np.int64)
        self.versions = np.zeros(1, np.int64)
        self.digests = np.zeros((1, DIGEST_BYTES), np.uint8)
        self.heads = np.full(CELLS, -1, np.int32)
        self.table = np.zeros(2, np.int64)
        self.near = np.full(4, 1 << 40, np.int64)
        self._free: list[int] = []
        self._stale: set[int] = set()
        """Rows whose digests are not up to date."""
        self.generated: dict[Cell, int] = {}
        """Versions of segments whose blocks are as the scene's generator makes them."""
        self.lend: Callable[[], Large] | None = None
        """Function that returns the large arrays for a copy of these blocks, which then must not change any more.
        None: the arrays are copied."""

    def __contains__(self, index: Cell) -> bool:
        return index in self.rows

    def __iter__(self) -> Iterator[Cell]:
        return iter(self.rows)

    def load(self, index: Cell, kinds: Kinds) -> bool:
        """Adds or replaces a segment. Returns whether the arrays have moved in memory."""
        moved = False
        row = self.rows.get(index)
        if row is None:
            if not self._free and self.count == len(self.kinds):
                self._grow(max(8, 2 * self.count))
                moved = True
            row = self._free.pop() if self._free else self.count
            self.count = max(self.count, row + 1)
            self.rows[index] = row
            self.segments[row] = index
            moved = self._enter(row) or moved
        self.kinds[row] = kinds
        self.solid[row] = self._words(kinds)
        self._touch(row)
        self._freshen(row)
        return moved

    def _words(self, kinds: Kinds) -> Uint32s:
        """Returns whether each block of a segment is solid, as bits of 1,024 words, the first block lowest."""
        if not PLAIN:
            return np.packbits(self._solid_of(kinds), bitorder="little").view("<u4")
        digits = kinds.tobytes().translate(self._digits)[::-1]
        return np.frombuffer(int(digits, 2).to_bytes(BLOCKS // 8, "little"), np.uint32)

    def _solid_of(self, kinds: Kinds) -> Truths:
        """Returns whether each block is solid. Where all kinds are, a comparison is faster than a table."""
        return kinds != AIR if self._solid_kinds is None else self._solid_kinds[kinds]

    def unload(self, index: Cell) -> None:
        """Removes a segment, which counts as solid from then on. No entity may be in it.

        Raises:
            MissingError: the segment is not loaded.
        """
        row = self.row(index)
        del self.rows[index]
        self._free.append(row)
        self._stale.discard(row)
        self._rebuild(len(self.table))

    def row(self, index: Cell) -> int:
        """Returns the row of a loaded segment.

        Raises:
            MissingError: the segment is not loaded.
        """
        row = self.rows.get(index)
        if row is None:
            raise MissingError(f"segment = {shown(index)}: is not loaded")
        return row

    def get(self, x: int, y: int, z: int) -> int | None:
        """Returns the kind of a block; None if its segment is not loaded."""
        row = self.rows.get(segment_of(x, y, z))
        return None if row is None else int(self.kinds[row, offset_of(x, y, z)])

    def different(self, low: Cell, high: Cell, kind: int) -> list[tuple[Cell, int]]:
        """Returns the blocks of a box (`high` excluded) that are not of a kind, with their kinds, ordered by z, y, x.

        Raises:
            SceneError: a segment of the box is not loaded.
        """
        (x0, y0, z0), (x1, y1, z1) = low, high
        if (x1 - x0, y1 - y0, z1 - z0) == (1, 1, 1):  # a short cut for one block: 1 us instead of 60
            before = self.get(x0, y0, z0)
            if before is not None:
                return [(low, before)] if before != kind else []
        if PLAIN:
            return self._different(low, high, kind)
        found = np.zeros((z1 - z0, y1 - y0, x1 - x0), np.uint8)
        spans = [range(a >> SEGMENT_SHIFT, (b - 1 >> SEGMENT_SHIFT) + 1) for a, b in zip(low, high, strict=True)]
        for z, y, x in itertools.product(*reversed(spans)) if found.size else ():
            row = self.rows.get((x, y, z))
            corner = x * SEGMENT, y * SEGMENT, z * SEGMENT
            first = [max(a, part) for a, part in zip(low, corner, strict=True)]
            if row is None:
                raise SceneError(f"block {tuple(first)}: its segment is not loaded")
            ends = [min(b, part + SEGMENT) for b, part in zip(high, corner, strict=True)]
            here = tuple(slice(a - part, b - part) for a, b, part in zip(first, ends, corner, strict=True))
            there = tuple(slice(a - part, b - part) for a, b, part in zip(first, ends, low, strict=True))
            found[there[::-1]] = self.kinds[row].reshape(SEGMENT, SEGMENT, SEGMENT)[here[::-1]]
        at = np.argwhere(found != kind)
        kinds: list[int] = found[tuple(at.T)].tolist()
        return [((x0 + x, y0 + y, z0 + z), was) for (z, y, x), was in zip(at.tolist(), kinds, strict=True)]

    def _different(self, low: Cell, high: Cell, kind: int) -> list[tuple[Cell, int]]:
        """Returns the same as `different`, block by block."""
        found = []
        for z, y, x in itertools.product(*(range(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))):
            was = self.get(x, y, z)
            if was is None:
                raise SceneError(f"block {(x, y, z)}: its segment is not loaded")
            if was != kind:
                found.append(((x, y, z), was))
        return found

    def set(self, x: int, y: int, z: int, kind: int) -> None:
        """Changes one block of a loaded segment.

        Raises:
            MissingError: the segment is not loaded.
        """
        row, at = self.row(segment_of(x, y, z)), offset_of(x, y, z)
        self.kinds[row, at] = kind
        word, bit = at >> SEGMENT_SHIFT, 1 << (at & (SEGMENT - 1))
        self.solid[row, word] = int(self.solid[row, word]) & ~bit | (bit if self.stops[kind] else 0)
        self._touch(row)

    def segment(self, index: Cell) -> Kinds:
        """Returns a read-only view of the blocks of a loaded segment, [z, y, x].

        Raises:
            MissingError: the segment is not loaded.
        """
        kinds = self.kinds[self.row(index)]
        if PLAIN:
            return memoryview(kinds.tobytes()).cast("B", (SEGMENT, SEGMENT, SEGMENT))  # type: ignore[return-value]
        view: Kinds = kinds.reshape(SEGMENT, SEGMENT, SEGMENT)
        view.flags.writeable = False
        return view

    def version(self, index: Cell) -> int:
        """Returns the version of a loaded segment: in one process, equal versions mean equal blocks.

        Raises:
            MissingError: the segment is not loaded.
        """
        return int(self.versions[self.row(index)])

    def digest(self, index: Cell) -> bytes:
        """Returns the digest of a loaded segment, 16 bytes, and computes it if it is stale.

        Raises:
            MissingError: the segment is not loaded.
        """
        row = self.row(index)
        if row in self._stale:
            self._freshen(row)
        return bytes(self.digests[row])

    @property
    def stale(self) -> int:
        """The number of digests that are not up to date."""
        return len(self._stale)

    def freshen(self, most: int | None = None) -> None:
        """Computes stale digests, at most `most` of them (None: all)."""
        for row in list(itertools.islice(self._stale, most)) if self._stale else ():
            self._freshen(row)

    def restore(self, other: "Blocks") -> bool:
        """Makes this equal to `other`, also the heads of its cells. Returns whether the arrays have moved in memory.

        Only segments that differ are copied, if both have the same segments in the same rows.
        """
        self._stale = set(other._stale)
        if self.rows == other.rows and len(self.kinds) == len(other.kinds):
            if self.versions.tobytes() != other.versions.tobytes():
                for row in np.flatnonzero(self.versions[: self.count] != other.versions[: self.count]).tolist():
                    self.kinds[row] = other.kinds[row]
                    self.solid[row] = other.solid[row]
                self.versions[:] = other.versions
            self.digests[:], self.heads[:] = other.digests, other.heads
            return False
        self.count, self.rows, self._free = other.count, dict(other.rows), list(other._free)
        self.generated = dict(other.generated)
        for name in ("segments", "versions", "digests", "table", "near"):
            setattr(self, name, getattr(other, name).copy())
        if other.lend is not None:
            self.kinds, self.solid, self.heads = other.lend()
        else:
            self.kinds, self.solid, self.heads = other.kinds.copy(), other.solid.copy(), other.heads.copy()
        return True

    def _touch(self, row: int) -> None:
        """Notes that the blocks of a row have changed: takes a new version, and marks the digest as stale."""
        self.versions[row] = next(_versions)
        self._stale.add(row)

    def _freshen(self, row: int) -> None:
        self.digests[row] = np.frombuffer(digest_of(self.kinds[row]), np.uint8)
        self._stale.discard(row)

    def _enter(self, row: int) -> bool:
        self.near[0] = 1 << 40
        if 2 * (len(self.rows) + 1) > len(self.table):
            self._rebuild(2 * len(self.table))
            return True
        self._insert(row)
        return False

    def _insert(self, row: int) -> None:
        x, y, z = self.segments[row].tolist()
        mask = len(self.table) - 1
        at = (x * 73856093 ^ y * 19349663 ^ z * 83492791) & mask
        while self.table[at]:
            at = (at + 1) & mask
        self.table[at] = row + 1

    def _rebuild(self, size: int) -> None:
        self.near[0] = 1 << 40
        if size == len(self.table):
            self.table[:] = 0
        else:
            self.table = np.zeros(size, np.int64)
        for row in self.rows.values():
            self._insert(row)

    def _grow(self, size: int) -> None:
        self.kinds = grown(self.kinds, 0, size)
        self.solid = grown(self.solid, 0, size)
        self.segments = grown(self.segments, 0, size)
        self.versions = grown(self.versions, 0, size)
        self.digests = grown(self.digests, 0, size)
        self.heads = grown(self.heads, -1, size * CELLS)
