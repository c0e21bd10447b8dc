"""The part of the kernel that writes the snapshots of many clients at once.

Only servers use it (`server.game.fast_path`). This source runs compiled and, unchanged, in plain Python. It adds,
subtracts, multiplies and compares floats, so their bits are the same everywhere. `shared.session_rows` describes the
rows of the sessions.
"""

from typing import Any

from shared.jit import decorators
from shared.session_rows import (
    ALLOWANCE,
    CARRIES,
    FLOATS,
    FRAMED,
    FREE,
    HELD_SHARE,
    KEPT,
    MARGINS,
    N_MARGINS,
    N_SEGMENTS,
    N_STATUSES,
    NEWEST,
    ODD,
    PROBE_AT,
    PROBE_BYTES,
    PROBE_TICK,
    SEGMENTS,
    SENT_AT,
    SENT_BYTES,
    SNAPSHOT_BYTES,
    STATE,
    STATUSES,
    TAKEN_BYTES,
    TICK,
    WIDTH,
)

jit, inlined = decorators(__name__)

UNUSED, UNWRITTEN = -1, -2
"""Starts of the messages of rows without one: the row is free; its session is odd."""
HEADER_BYTES = 4 + (4 + 9 + 9 + (2 + 2 * KEPT) + 9 + (2 + KEPT) + 4)
"""Maximum bytes of a snapshot in a frame before its segments."""
FRAME_MAX = (1 << 16) - 1
"""Maximum size of a message that is sent here, in bytes."""
LEAST_ROOM = 512
"""`flow_control.LEAST_BYTES`."""


@jit
def write_snapshots(
    numbers: Any,
    floats: Any,
    views: Any,
    starts: Any,
    lengths: Any,
    parts: bytes,
    out: Any,
    spans: Any,
    rules: Any,
    clock: Any,
) -> int:
    """Writes the snapshot of each plain row, and refills its allowance of messages.

    Args:
        numbers, floats: the rows. Those whose snapshot is left become `ODD`.
        views: [rows * SEGMENTS] numbers of the segments of each client view, in the order in which they are sent.
        starts, lengths, parts: the delta of each segment in `parts`, by number; length 0: there is none.
        out: gets the messages. It has room for the longest one at least.
        spans: gets start and end of each row's message in `out`; start `UNUSED` or `UNWRITTEN`: there is none.
        rules: the first row, the tick, most bytes of a snapshot; gets the number of messages and their bytes.
        clock: the time, messages of a burst, messages per tick, part by which the held share nears its new value.

    Returns:
        The row at which `out` was full; the number of rows: all are written.
    """
    tick, most = rules[1], rules[2]
    rules[3] = rules[4] = 0
    now, burst, refill, part_of = clock[0], clock[1], clock[2], clock[3]
    at = 0
    for row in range(rules[0], len(numbers) // WIDTH):
        base, reals = row * WIDTH, row * FLOATS
        spans[2 * row] = UNUSED
        if numbers[base + STATE] == FREE:
            continue
        size, n = 0, 0
        for i in range(row * SEGMENTS, row * SEGMENTS + numbers[base + N_SEGMENTS]):
            size += lengths[views[i]]
            n += 1 if lengths[views[i]] > 0 else 0
        if at + HEADER_BYTES + size > len(out):
            return row
        floats[reals + ALLOWANCE] = refilled(floats[reals + ALLOWANCE], burst, refill)
        spans[2 * row] = UNWRITTEN
        if numbers[base + STATE] == ODD:
            continue
        latest, outstanding = numbers[base + SNAPSHOT_BYTES], numbers[base + SENT_BYTES] - numbers[base + TAKEN_BYTES]
        window = max(numbers[base + CARRIES], 2 * latest)
        room = min(max(window - outstanding, LEAST_ROOM), most)
        if numbers[base + TICK] != tick - 1 or outstanding > window or size > min(room, FRAME_MAX - HEADER_BYTES):
            numbers[base + STATE] = ODD
            continue
        held = floats[reals + HELD_SHARE]
        if held != 0:
            floats[reals + HELD_SHARE] = held + (0 - held) * part_of
        start = at + 4 if numbers[base + FRAMED] else at
        at = put_header(numbers, base, tick, n, out, start)
        for i in range(row * SEGMENTS, row * SEGMENTS + numbers[base + N_SEGMENTS]):
            at = copied(parts, starts[views[i]], lengths[views[i]], out, at)
        rules[3] += 1
        rules[4] += at - start
        spans[2 * row + 1] = at
        spans[2 * row] = frame_start(out, start, at - start) if numbers[base + FRAMED] else start
        numbers[base + N_MARGINS] = numbers[base + N_STATUSES] = 0
        numbers[base + TICK], numbers[base + SNAPSHOT_BYTES] = tick, at - start
        numbers[base + SENT_BYTES] += at - start
        floats[reals + SENT_AT] = now
        if outstanding == 0 and numbers[base + PROBE_TICK] < 0:
            numbers[base + PROBE_TICK], numbers[base + PROBE_BYTES] = tick, at - start
            floats[reals + PROBE_AT] = now
    return len(numbers) // WIDTH


@inlined
def refilled(allowance: float, burst: float, refill: float) -> float:
    """Returns an allowance with the messages of one more tick, like `Clocks.refill`."""
    if allowance < 0:
        return min(max(allowance, -burst) + refill, 0.0)
    return max(allowance - refill, 0.0) if allowance > 0 else allowance


@inlined
def copied(parts: Any, begin: int, size: int, out: Any, at: int) -> int:
    """Copies bytes of `parts` to `out`. Returns the end of them."""
    for i in range(size):
        out[at + i] = parts[begin + i]
    return at + size


@inlined
def frame_start(out: Any, start: int, size: int) -> int:
    """Writes the header of a WebSocket frame before a message of at most `FRAME_MAX` bytes. Returns where it begins."""
    if size < 126:
        out[start - 2], out[start - 1] = 0x82, size
        return start - 2
    out[start - 4], out[start - 3], out[start - 2], out[start - 1] = 0x82, 126, size >> 8, size & 0xFF
    return start - 4


@inlined
def put_header(numbers: Any, base: int, tick: int, n: int, out: Any, at: int) -> int:
    """Writes the part of a snapshot before its `n` segments. Returns the end of it."""
    fields, margins, statuses = 8 + n, numbers[base + N_MARGINS], numbers[base + N_STATUSES]
    out[at], out[at + 1], out[at + 2], out[at + 3] = 0xDC, fields >> 8, fields & 0xFF, 18
    at = put_number(out, at + 4, tick)
    at = put_number(out, at, numbers[base + NEWEST])
    out[at], out[at + 1] = 0xC4, 2 * margins
    at += 2
    for i in range(margins):
        margin = numbers[base + MARGINS + i]
        out[at], out[at + 1] = margin & 0xFF, margin >> 8 & 0xFF
        at += 2
    at = put_number(out, at, tick - statuses + 1)
    out[at], out[at + 1] = 0xC4, statuses
    at += 2
    for i in range(statuses):
        out[at] = numbers[base + STATUSES + i]
        at += 1
    out[at], out[at + 1], out[at + 2], out[at + 3] = 0xC4, 0, 0xC4, 0
    return at + 4


@inlined
def put_number(out: Any, at: int, value: int) -> int:
    """Writes a whole number from -1 to 2^53. Returns the end of it."""
    if value < 0x80:
        out[at] = value & 0xFF
        return at + 1
    size, head = 8, 0xCF
    if value < 1 << 8:
        size, head = 1, 0xCC
    elif value < 1 << 16:
        size, head = 2, 0xCD
    elif value < 1 << 32:
        size, head = 4, 0xCE
    out[at] = head
    for i in range(size):
        out[at + 1 + i] = value >> (8 * (size - 1 - i)) & 0xFF
    return at + 1 + size
