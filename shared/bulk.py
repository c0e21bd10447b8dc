"""The part of the kernel for many states at once: unpacking from a snapshot, comparing, packing, keeping.

Nothing here moves an entity. Like `shared.kernel`, this source runs compiled by Numba and, unchanged, in plain Python,
so it uses whole numbers, loops and comparisons only. `shared.snapshot` describes the packed bytes, and `shared.layout`
the rows of entities. `e` is the array of the entities, 16 values per row.
"""

from typing import Any

from shared.jit import decorators
from shared.layout import (
    AWAKE,
    BUTTONS,
    CELL,
    CELLS_SHIFT,
    CHANGED,
    EDGE_HIGH,
    EVENT_BITS,
    FLAGS,
    ID,
    LO_X,
    MOVE_X,
    MOVE_Y,
    N_CHANGED,
    NEW_BUTTONS,
    NEW_MOVE,
    NEXT,
    SIZE_X,
    STOP_X,
    TEMPLATE,
    TEMPLATE_COLUMNS,
    TOLD,
    TURN,
    VX,
    WHOLE,
    WIDTH_SHIFT,
    X,
    Y,
    Z,
)
from shared.units import BLOCK, BLOCK_SHIFT, IN_SEGMENT, TO_SEGMENT

jit, inlined = decorators(__name__)

ROW_BYTES = 33
"""Length of a packed state, in bytes."""
ALL_EVENTS = (1 << EVENT_BITS) - 1
"""Mask of the events in `changed`."""
SENT_EVENTS = WHOLE - 1
"""Mask of the events that are sent."""
GAP_BITS = 6
"""Number of bits of the gap between two ids in the first byte of a packed turn."""
GAP_MASK, GAP_GOES_ON, HAS_EVENTS = (1 << GAP_BITS) - 1, 1 << GAP_BITS, 0x80
"""Bits of the first byte of a packed turn: of the gap; the gap has more bytes; the events follow."""
BLOCK_MASK = EDGE_HIGH - 1
"""Mask of the block in the first byte of a packed stop."""
WITHIN = 0x80
"""Bit of the first byte of a packed stop: the place within the block follows in three bytes."""
IN_BLOCK = BLOCK - 1
"""Mask of a position's bits within a block."""
PART = 7
"""Number of values for each segment in the result of `news`."""
ID_MAX = (1 << 31) - 1
"""Greatest id."""
ID_BITS = 32
"""Number of bits for an id, or for a place in the array of entities, within a key to sort by."""


# -- unpacking -----------------------------------------------------------------------------------------------


@inlined
def word(data: Any, at: int) -> int:
    """Returns four bytes from `at` on as an unsigned whole number, little-endian."""
    return data[at] | data[at + 1] << 8 | data[at + 2] << 16 | data[at + 3] << 24


@jit
def read_turns(data: bytes, ends: Any, turns: Any) -> int:
    """Unpacks turns (`shared.snapshot`).

    Args:
        data: packed turns of all parts of a snapshot.
        ends: end of each part's turns in `data`.
        turns: [len(data) // 2 * 8], is written to.

    Returns:
        The number of turns; -1: a part breaks the format.
    """
    at = 0
    to = 0
    for part in range(len(ends)):
        end = ends[part]
        entity = 0
        while at < end:
            head = data[at]
            at += 1
            gap = head & GAP_MASK
            shift = GAP_BITS
            more = head & GAP_GOES_ON
            while more != 0:
                if at == end or shift > ID_BITS:
                    return -1
                gap |= (data[at] & 0x7F) << shift
                more = data[at] & 0x80
                shift += 7
                at += 1
            entity += gap + 1
            events = TOLD | NEW_MOVE
            if head & HAS_EVENTS != 0:
                if at == end:
                    return -1
                events = data[at] & 0xFF
                at += 1
            size = 0
            if events & TOLD != 0:
                size = (2 if events & NEW_MOVE != 0 else 0) + (1 if events & NEW_BUTTONS != 0 else 0)
            if entity > ID_MAX or at + size > end:
                return -1
            turns[to] = entity
            turns[to + 1] = events
            for k in range(2, TURN):
                turns[to + k] = 0
            if size >= 2:
                turns[to + 2] = (data[at] ^ 0x80) - 0x80
                turns[to + 3] = (data[at + 1] ^ 0x80) - 0x80
            at += size
            if size & 1 != 0:
                turns[to + 4] = data[at - 1]
            for k in range(3):
                if events & (STOP_X << k) != 0:
                    if at == end:
                        return -1
                    place = data[at] & 0xFF
                    at += 1
                    turns[to + 5 + k] = -1 - place
                    if place >= 2 * EDGE_HIGH:
                        if place & ~BLOCK_MASK != WITHIN or at + 3 > end:
                            return -1
                        within = data[at] | data[at + 1] << 8 | data[at + 2] << 16
                        turns[to + 5 + k] = (place & BLOCK_MASK) << BLOCK_SHIFT | within
                        at += 3
            to += TURN
    return to // TURN


@jit
def read_rows(rows: bytes, parts: Any, low: Any, high: Any, templates: int, states: Any) -> bool:
    """Unpacks states (`shared.snapshot`).

    Args:
        rows: packed states, [n * 33].
        parts: for each part of the snapshot: low corner of its segment in grid steps (3), number of its states.
        low: [12], lowest value of each column.
        high: [12], greatest value of each column.
        templates: number of templates of the scene.
        states: [n * 12], is written to.

    Returns:
        Whether all values are within their bounds.
    """
    to = at = 0
    for part in range(0, len(parts), 4):
        for _ in range(parts[part + 3]):
            states[to] = word(rows, at)
            states[to + TEMPLATE] = rows[at + 4]
            states[to + FLAGS] = rows[at + 5]
            for k in range(6):
                states[to + X + k] = (word(rows, at + 6 + 4 * k) ^ 1 << 31) - (1 << 31)
            states[to + MOVE_X] = (rows[at + 30] ^ 0x80) - 0x80
            states[to + MOVE_Y] = (rows[at + 31] ^ 0x80) - 0x80
            states[to + BUTTONS] = rows[at + 32]
            for k in range(CELL):
                if states[to + k] < low[k] or states[to + k] > high[k]:
                    return False
            if states[to + TEMPLATE] >= templates:
                return False
            for k in range(3):
                states[to + X + k] += parts[part + k]
            to += CELL
            at += ROW_BYTES
    return True


# -- comparing -----------------------------------------------------------------------------------------------


@inlined
def counts(states: Any, at: int, mine: int, reach: int, always: Any) -> bool:
    """Returns whether the state at `at` counts in a comparison for the state at `mine`; with -1 every state does."""
    if mine < 0 or always[states[at + TEMPLATE]] != 0:
        return True
    return (
        abs(states[at + X] - states[mine + X]) < reach
        and abs(states[at + Y] - states[mine + Y]) < reach
        and abs(states[at + Z] - states[mine + Z]) < reach
    )


@jit
def alike(a: Any, n: int, b: Any, m: int, entity: int, reach: int, always: Any) -> bool:
    """Returns whether two lists of states are equal in all states that count for `entity`.

    A state counts if it is less than `reach` (grid steps) away from `entity` along each axis, or if `always` is not 0
    for its template. In a list without `entity`, every state counts.

    Args:
        a: `n` states, ascending by id.
        b: `m` states, ascending by id.
        always: [templates].
    """
    mine = -1
    for i in range(n):
        if a[CELL * i + ID] == entity:
            mine = CELL * i
    own = -1
    for j in range(m):
        if b[CELL * j + ID] == entity:
            own = CELL * j
    i = j = 0
    while True:
        while i < n and not counts(a, CELL * i, mine, reach, always):
            i += 1
        while j < m and not counts(b, CELL * j, own, reach, always):
            j += 1
        if i == n or j == m:
            return i == n and j == m
        for k in range(CELL):
            if a[CELL * i + k] != b[CELL * j + k]:
                return False
        i += 1
        j += 1


# -- packing -------------------------------------------------------------------------------------------------


@inlined
def ahead(e: Any, a: int, b: int) -> int:
    """Compares the segments of the entities at `a` and `b` in the order z, y, x.

    Returns 0 if both are in one segment, a negative number if the segment of `a` comes first, else a positive one.
    """
    for k in (Z, Y, X):
        by: int = (e[a + k] >> TO_SEGMENT) - (e[b + k] >> TO_SEGMENT)
        if by != 0:
            return by
    return 0


@inlined
def wire(packed: Any, at: int, value: int, size: int) -> int:
    """Writes a whole number as `size` bytes, little-endian. Returns the place after them."""
    for k in range(size):
        packed[at + k] = value >> 8 * k & 255
    return at + size


@inlined
def wire_state(packed: Any, to: int, e: Any, at: int) -> int:
    """Writes the packed state of the entity at `at`. Returns the place after it."""
    to = wire(packed, to, e[at + ID], 4)
    to = wire(packed, to, e[at + TEMPLATE], 1)
    to = wire(packed, to, e[at + FLAGS] & ~AWAKE, 1)
    for k in range(X, VX):
        to = wire(packed, to, e[at + k] & IN_SEGMENT, 4)
    for k in range(VX, MOVE_X):
        to = wire(packed, to, e[at + k], 4)
    for k in range(MOVE_X, CELL):
        to = wire(packed, to, e[at + k], 1)
    return to


@inlined
def wire_turn(packed: Any, to: int, e: Any, at: int, gap: int, t: Any) -> int:
    """Writes the packed turn of the entity at `at`, whose id is `gap + 1` above the one before.

    Returns the place after it.
    """
    events = e[at + CHANGED] & SENT_EVENTS
    head = gap & GAP_MASK
    gap >>= GAP_BITS
    head |= GAP_GOES_ON if gap != 0 else 0
    head |= HAS_EVENTS if events != TOLD | NEW_MOVE else 0
    packed[to] = head
    to += 1
    while gap != 0:
        packed[to] = gap & 0x7F | (0x80 if gap > 0x7F else 0)
        gap >>= 7
        to += 1
    if head & HAS_EVENTS != 0:
        to = wire(packed, to, events, 1)
    if events & TOLD != 0 and events & NEW_MOVE != 0:
        to = wire(packed, to, e[at + MOVE_X], 1)
        to = wire(packed, to, e[at + MOVE_Y], 1)
    if events & TOLD != 0 and events & NEW_BUTTONS != 0:
        to = wire(packed, to, e[at + BUTTONS], 1)
    kind = e[at + TEMPLATE] * TEMPLATE_COLUMNS
    for k in range(3):
        if events & STOP_X << k != 0:
            place = e[at + X + k] & IN_SEGMENT
            low = place + t[kind + LO_X + k]
            high = low + t[kind + SIZE_X + k]
            if low & IN_BLOCK == 0:
                to = wire(packed, to, low >> BLOCK_SHIFT & BLOCK_MASK, 1)
            elif high & IN_BLOCK == 0:
                to = wire(packed, to, high >> BLOCK_SHIFT & BLOCK_MASK | EDGE_HIGH, 1)
            else:
                to = wire(packed, to, place >> BLOCK_SHIFT | WITHIN, 1)
                to = wire(packed, to, place, 3)
    return to


@jit
def news(
    e: Any, t: Any, changed: Any, lengths: Any, tick: int, every: int, ids: Any, parts: Any, due: Any, packed: Any
) -> int:
    """Packs the changes of a tick by segment, as `shared.snapshot` describes them.

    Args:
        e: array of the entities.
        t: array of the templates.
        changed: rows of the entities that changed.
        lengths: lengths of the world's lists (`layout.N_CHANGED` ...).
        tick: number of the tick; it decides which segments are due for a checksum.
        every: number of ticks between two checksums of a segment.
        ids: [n] gets the ids of the entities with events, segment by segment; within a segment, those that are sent
            whole come last.
        parts: [n * 7] gets for each segment: its index (3); where in `ids` the entities that are sent whole begin, and
            where the segment ends; where in `packed` its turns and its rows end.
        due: [1 + n * 3] gets the number of the values that follow; then the index (3) of each segment that is due, once
            for each entity that has changed there.
        packed: [n * 33] gets the bytes.

    Returns:
        The number of values in `parts`.
    """
    told = n_parts = n_due = 0
    for i in range(lengths[N_CHANGED]):
        at = changed[i] << WIDTH_SHIFT
        if e[at + ID] == 0:
            continue
        x = e[at + X] >> TO_SEGMENT
        y = e[at + Y] >> TO_SEGMENT
        z = e[at + Z] >> TO_SEGMENT
        if (x + 3 * y + 5 * z + tick) % every == 0:
            due[n_due + 1] = x
            due[n_due + 2] = y
            due[n_due + 3] = z
            n_due += 3
        if e[at + CHANGED] & ALL_EVENTS != 0:
            ids[told] = at
            told += 1

    due[0] = n_due
    gap = 1
    while gap < told:
        gap = 3 * gap + 1
    while gap > 1:  # Shellsort: 0.1 ms for a thousand entities
        gap //= 3
        for i in range(gap, told):
            at = ids[i]
            key = (e[at + CHANGED] & WHOLE) << ID_BITS | e[at + ID]
            to = i
            while to >= gap:
                other = ids[to - gap]
                by = ahead(e, other, at)
                if by < 0 or (by == 0 and (e[other + CHANGED] & WHOLE) << ID_BITS | e[other + ID] < key):
                    break
                ids[to] = other
                to -= gap
            ids[to] = at

    start = 0
    end = 0
    to = 0
    while start < told:
        first = ids[start]
        last = 0
        while end < told and e[ids[end] + CHANGED] & WHOLE == 0 and ahead(e, ids[end], first) == 0:
            to = wire_turn(packed, to, e, ids[end], e[ids[end] + ID] - last - 1, t)
            last = e[ids[end] + ID]
            end += 1
        parts[n_parts] = e[first + X] >> TO_SEGMENT
        parts[n_parts + 1] = e[first + Y] >> TO_SEGMENT
        parts[n_parts + 2] = e[first + Z] >> TO_SEGMENT
        parts[n_parts + 3] = end
        parts[n_parts + 5] = to
        while end < told and ahead(e, ids[end], first) == 0:
            to = wire_state(packed, to, e, ids[end])
            end += 1
        parts[n_parts + 4] = end
        parts[n_parts + 6] = to
        n_parts += PART
        for i in range(start, end):
            ids[i] = e[ids[i] + ID]
        start = end
    return n_parts


@jit
def sort(keys: Any, n: int) -> None:
    """Sorts the first `n` whole numbers by Shellsort."""
    gap = 1
    while gap < n:
        gap = 3 * gap + 1
    while gap > 1:
        gap //= 3
        for i in range(gap, n):
            key = keys[i]
            to = i
            while to >= gap and keys[to - gap] > key:
                keys[to] = keys[to - gap]
                to -= gap
            keys[to] = key


@jit
def muster(e: Any, heads: Any, keys: Any, packed: Any, segment: int) -> int:
    """Packs the states of all entities in one segment, ascending by id.

    Args:
        e: array of the entities.
        heads: first entity row of each cell.
        keys: [entities], is written to.
        packed: [entities * 33] gets the bytes.
        segment: row of the segment.

    Returns:
        The number of bytes.
    """
    n = 0
    for cell in range(segment << CELLS_SHIFT, (segment + 1) << CELLS_SHIFT):
        row = heads[cell]
        while row >= 0:
            at = row << WIDTH_SHIFT
            keys[n] = e[at + ID] << ID_BITS | at
            n += 1
            row = e[at + NEXT]
    sort(keys, n)
    to = 0
    for i in range(n):
        to = wire_state(packed, to, e, keys[i] & (1 << ID_BITS) - 1)
    return to


# -- keeping -------------------------------------------------------------------------------------------------


@jit
def recall(e: Any, changed: Any, known: Any, before: Any, n: int) -> int:
    """Updates the kept values of the `n` rows that have changed, and returns the old ones in `before`.

    Args:
        e: array of the entities.
        changed: the changed rows.
        known: [rows * 5] kept values of each row: id, template, x, y, z.
        before: [n * 6] gets each changed row, and the values that were kept of it.
        n: number of changed rows.

    Returns:
        By how much the number of entities has grown; negative if it has fallen.
    """
    more = 0
    for i in range(n):
        row = changed[i]
        more += int(e[(row << WIDTH_SHIFT) + ID] != 0) - int(known[5 * row] != 0)
        before[6 * i] = row
        for k in range(5):
            before[6 * i + 1 + k] = known[5 * row + k]
            known[5 * row + k] = e[(row << WIDTH_SHIFT) + (k if k < 2 else k + 1)]
    return more
