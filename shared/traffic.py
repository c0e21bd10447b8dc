"""The part of the kernel for the messages of many clients at once: taking their inputs, writing their snapshots.

Only servers use it (`server.game.fast_path`). It handles plain messages alone and reports all others. This source runs
compiled and, unchanged, in plain Python. It adds, subtracts, multiplies and compares floats, so their bits are the same
everywhere. A session has a row of whole numbers, a row of floats, the segments of its client view, and a ring of slots
for the inputs that wait, one per tick.
"""

from typing import Any

from shared.fields import FIRST_MAX
from shared.jit import decorators

jit, inlined = decorators(__name__)

(
    STATE, NEWEST, ACCEPTED, MISSING, HELD, HELD_AIM, N_MARGINS, N_STATUSES, LATE, USED, SUBSTITUTED, TICK, ACKED,
    SNAPSHOT_BYTES, SENT_BYTES, TAKEN_BYTES, CARRIES, PROBE_TICK, PROBE_BYTES, N_SEGMENTS,
) = range(20)  # fmt: skip
"""Columns of the whole numbers. STATE: `FREE`, `PLAIN` or `ODD`. NEWEST, ACCEPTED, MISSING, LATE, USED, SUBSTITUTED:
as in `InputQueue`; the last three count since the row was written. HELD, HELD_AIM: the input that is repeated, as its
first three bytes on the wire, and the six bytes of its aim. TICK, ACKED, SNAPSHOT_BYTES, PROBE_TICK (-1: no probe),
PROBE_BYTES: as in `ClientStream`. SENT_BYTES, TAKEN_BYTES, CARRIES: as in `FlowControl`."""
MARGINS, STATUSES, KEPT = 20, 28, 8
"""Columns of the margins and of the statuses that are not sent yet, and how many of each there can be."""
WIDTH = 36
"""Columns of whole numbers in a row."""
RECEIVED_AT, ALLOWANCE, SENT_AT, MEASURE_AT, HELD_SHARE, PROBE_AT = range(6)
"""Columns of the floats, as in `Session`, `ClientStream` and `FlowControl`."""
FLOATS = 6
"""Columns of floats in a row."""
SEGMENTS = 64
"""Maximum number of segments of a client view."""
SLOT = 3
"""Numbers of a slot: the tick of the input (-1: the slot is empty), its first three bytes, its aim's six bytes."""
FREE, PLAIN, ODD = range(3)
"""States of a row. ODD: the session has something to do that is not done here."""

DONE, ANSWERED, LEFT = range(3)
"""Fates of a message: handled; handled, and it answers the probe of the round trip; left to the code in Python."""
UNUSED, UNWRITTEN = -1, -2
"""Starts of the messages of rows without one: the row is free; its session is odd."""
USED_INPUT, REPEATED_INPUT, NEUTRAL_INPUT = 0, 1, 2
"""Input statuses (`messages.USED`, `REPEATED`, `NEUTRALISED`)."""
REFUSED_MARGIN = -(1 << 15)
"""`messages.MARGIN_REFUSED`."""
HEADER_BYTES = 4 + 9 + 9 + (2 + 2 * KEPT) + 9 + (2 + KEPT) + 4
"""Maximum bytes of a snapshot before its segments."""
LEAST_ROOM = 512
"""`flow_control.LEAST_BYTES`."""


# -- MessagePack ---------------------------------------------------------------------------------------------


@inlined
def number_bytes(data: Any, at: int) -> int:
    """Returns how many bytes the whole number at `at` takes; 0: it is none that is read here."""
    first = data[at]
    if first < 0x80 or first == 0xFF:
        return 1
    if first == 0xCC:
        return 2
    if first == 0xCD:
        return 3
    return 5 if first == 0xCE else 0


@inlined
def number_at(data: Any, at: int, size: int) -> int:
    """Returns the whole number of `size` bytes at `at`."""
    if size == 1:
        return -1 if data[at] == 0xFF else int(data[at])
    value = 0
    for i in range(at + 1, at + size):
        value = value << 8 | data[i]
    return value


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


# -- inputs --------------------------------------------------------------------------------------------------


@inlined
def floor(value: float) -> int:
    """Returns the greatest whole number that is not greater than a value."""
    whole = int(value)
    return whole - 1 if whole > value else whole


@inlined
def ticks_left(now: float, deadline: float, rate: float, catch_up: float) -> float:
    """Returns the ticks until the next tick's deadline, like `Clocks.ticks_left`."""
    passed = (now - deadline) * rate
    return 1.0 - passed if passed < catch_up + 1 else 1.0 - catch_up - (passed - floor(passed))


@inlined
def file_inputs(
    numbers: Any,
    ring: Any,
    row: int,
    data: Any,
    at: int,
    facts: tuple[int, int, int, int, int],
    ahead: float,
    one: float,
) -> None:
    """Files consecutive inputs of a row, as `InputQueue.file` does.

    Args:
        numbers, ring: the rows.
        row: the row.
        data, at: the inputs as on the wire, and where they begin.
        facts: the tick of the first one, their number, the latest tick, bytes of an input, slots of a row.
        ahead: ticks until the next tick's deadline.
        one: a margin of one tick on the wire.
    """
    first, n, tick, row_bytes, slots = facts
    base = row * WIDTH
    for k in range(n):
        due = first + k
        head = data[at] | data[at + 1] << 8 | data[at + 2] << 16
        aim = 0
        for j in range(3, row_bytes):
            aim |= data[at + j] << (8 * (j - 3))
        at += row_bytes
        margin = floor((due - tick - 1 + ahead) * one)
        if due > tick:
            slot = (row * slots + due % slots) * SLOT
            ring[slot], ring[slot + 1], ring[slot + 2] = due, head, aim
        else:
            numbers[base + LATE] += 1
            numbers[base + HELD], numbers[base + HELD_AIM], numbers[base + MISSING] = head, aim, 0
            margin = min(margin, -1)
        numbers[base + MARGINS + numbers[base + N_MARGINS]] = max(REFUSED_MARGIN + 1, min(margin, -REFUSED_MARGIN - 1))
        numbers[base + N_MARGINS] += 1
        numbers[base + NEWEST] = numbers[base + ACCEPTED] = due


@jit
def take_messages(
    numbers: Any, floats: Any, ring: Any, data: bytes, spans: Any, times: Any, fates: Any, rules: Any, clock: Any
) -> None:
    """Takes the input messages of the time since the latest tick, as `Front.receive` would one by one.

    Once a message of a row is left, so are all later ones of that row.

    Args:
        numbers, floats, ring: the rows. Those with a message that is left become `ODD`.
        data: the messages, one after the other.
        spans: row and length of each message.
        times: time of arrival of each message, in seconds.
        fates: gets the fate of each message.
        rules: the latest tick, the most ticks ahead, bytes of an input, most inputs of a message, slots of a row.
        clock: deadline of the latest tick in seconds, ticks per second, most ticks to catch up on, a margin of one tick
            on the wire, messages of a burst.
    """
    tick, ahead_most, row_bytes, most, slots = rules[0], rules[1], rules[2], rules[3], rules[4]
    deadline, rate, catch_up, one, burst = clock[0], clock[1], clock[2], clock[3], clock[4]
    end = 0
    for i in range(len(fates)):
        row, at = spans[2 * i], end
        end += spans[2 * i + 1]
        base, reals = row * WIDTH, row * FLOATS
        fates[i] = LEFT
        if numbers[base + STATE] != PLAIN:
            continue
        numbers[base + STATE] = ODD
        if end - at < 6 or data[at] != 0x94 or data[at + 1] != 2:
            continue
        at += 2
        size = number_bytes(data, at)
        if size == 0 or at + size + 3 > end:
            continue
        first = number_at(data, at, size)
        at += size
        size = number_bytes(data, at)
        if size == 0 or at + size + 2 > end:
            continue
        acked = number_at(data, at, size)
        at += size
        n = (end - at - 2) // row_bytes
        if data[at] != 0xC4 or data[at + 1] != end - at - 2 or n * row_bytes != end - at - 2 or n > most:
            continue
        newest, kept = numbers[base + NEWEST], numbers[base + N_MARGINS]
        if first != newest + 1 or first <= numbers[base + ACCEPTED] or first + n - 1 > tick + ahead_most:
            continue
        if first + n > FIRST_MAX or kept + n > KEPT or floats[reals + ALLOWANCE] - 1 < -burst:
            continue
        now = times[i]
        floats[reals + RECEIVED_AT] = max(floats[reals + RECEIVED_AT], now)
        floats[reals + ALLOWANCE] -= 1
        ahead = ticks_left(now, deadline, rate, catch_up)
        file_inputs(numbers, ring, row, data, at + 2, (first, n, tick, row_bytes, slots), ahead, one)
        fates[i] = DONE
        if numbers[base + ACKED] < acked <= numbers[base + TICK]:
            numbers[base + ACKED] = acked
            probe = numbers[base + PROBE_TICK]
            if 0 <= probe <= acked:
                numbers[base + PROBE_TICK] = -1
                if probe == acked:
                    fates[i] = ANSWERED
        numbers[base + STATE] = PLAIN


@jit
def take_inputs(numbers: Any, ring: Any, taken: Any, tick: int, repeats: int, slots: int) -> None:
    """Takes an input of every row for a tick, as `InputQueue.take` does.

    Args:
        numbers, ring: the rows.
        taken: gets two numbers per row: the first three bytes of the input, and the six bytes of its aim.
        tick: the tick.
        repeats: number of missing inputs up to which the latest one is repeated.
        slots: slots of a row.
    """
    for row in range(len(numbers) // WIDTH):
        base = row * WIDTH
        if numbers[base + STATE] == FREE:
            continue
        slot = (row * slots + tick % slots) * SLOT
        status = USED_INPUT
        if ring[slot] == tick:
            ring[slot] = -1
            numbers[base + HELD], numbers[base + HELD_AIM] = ring[slot + 1], ring[slot + 2]
            numbers[base + MISSING] = 0
            numbers[base + USED] += 1
        else:
            numbers[base + MISSING] += 1
            numbers[base + SUBSTITUTED] += 1
            status = REPEATED_INPUT if numbers[base + MISSING] <= repeats else NEUTRAL_INPUT
        kept = numbers[base + N_STATUSES]
        numbers[base + STATUSES + kept] = status
        numbers[base + N_STATUSES] = kept + 1
        taken[2 * row] = 0 if status == NEUTRAL_INPUT else numbers[base + HELD]
        taken[2 * row + 1] = 0 if status == NEUTRAL_INPUT else numbers[base + HELD_AIM]


# -- snapshots -----------------------------------------------------------------------------------------------


@jit
def due_rows(numbers: Any, floats: Any, due: Any, clock: Any) -> int:
    """Lists the rows whose connection is to be asked for the bytes on the way, and makes silent ones `ODD`.

    Args:
        numbers, floats: the rows.
        due: gets the rows. Those with an earlier measurement than now come as they are; others, which may have no
            room, as `-1 - row`.
        clock: the time, and the longest time without a message, in seconds.

    Returns:
        The number of rows in `due`.
    """
    n = 0
    for row in range(len(numbers) // WIDTH):
        base, reals = row * WIDTH, row * FLOATS
        if numbers[base + STATE] != PLAIN:
            continue
        if clock[0] - floats[reals + RECEIVED_AT] > clock[1]:
            numbers[base + STATE] = ODD
        elif clock[0] >= floats[reals + MEASURE_AT]:
            due[n] = row
            n += 1
        else:
            latest = numbers[base + SNAPSHOT_BYTES]
            outstanding = numbers[base + SENT_BYTES] - numbers[base + TAKEN_BYTES]
            if outstanding + latest > max(numbers[base + CARRIES], 2 * latest):
                due[n] = -1 - row
                n += 1
    return n


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
        starts, lengths: the delta of each segment in `parts`, by number; length 0: there is none.
        parts: the encoded deltas.
        out: gets the messages. It has room for the longest one at least.
        spans: gets start and end of each row's message in `out`; start `UNUSED` or `UNWRITTEN`: there is none.
        rules: the first row, the tick, most bytes of a snapshot.
        clock: the time, messages of a burst, messages per tick, part by which the held share nears its new value.

    Returns:
        The row at which `out` was full; the number of rows: all are written.
    """
    tick, most = rules[1], rules[2]
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
        if numbers[base + TICK] != tick - 1 or outstanding > window or size > room:
            numbers[base + STATE] = ODD
            continue
        held = floats[reals + HELD_SHARE]
        if held != 0:
            floats[reals + HELD_SHARE] = held + (0 - held) * part_of
        start = at
        at = put_header(numbers, base, tick, n, out, at)
        for i in range(row * SEGMENTS, row * SEGMENTS + numbers[base + N_SEGMENTS]):
            at = copied(parts, starts[views[i]], lengths[views[i]], out, at)
        spans[2 * row], spans[2 * row + 1] = start, at
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
