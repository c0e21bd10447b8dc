"""The part of the kernel that takes the inputs of many clients at once.

Only servers use it (`server.game.fast_path`). It handles plain messages alone and reports all others. This source runs
compiled and, unchanged, in plain Python. It adds, subtracts, multiplies and compares floats, so their bits are the same
everywhere. `shared.session_rows` describes the rows of the sessions.
"""

from typing import Any

from shared.fields import AFTER_MAX, FIRST_MAX
from shared.jit import decorators
from shared.session_rows import (
    ACCEPTED,
    ACKED,
    ALLOWANCE,
    FLOATS,
    FREE,
    FULL_AT,
    HELD,
    HELD_AIM,
    HELD_TO,
    KEPT,
    LATE,
    MARGINS,
    MISSING,
    N_MARGINS,
    N_STATUSES,
    NEWEST,
    ODD,
    PLAIN,
    PROBE_AT,
    PROBE_TICK,
    RECEIVED_AT,
    REFUSED,
    RTT,
    RTT_AT,
    SLOT,
    STATE,
    STATUSES,
    SUBSTITUTED,
    TICK,
    UNRECORDED,
    USED,
    WIDTH,
)

jit, inlined = decorators(__name__)

DONE, ANSWERED, LEFT = range(3)
"""Fates of a message: handled; handled, and it answers the probe of the round trip in a way that matters; left to the
code in Python."""
USED_INPUT, REPEATED_INPUT, NEUTRAL_INPUT = 0, 1, 2
"""Input statuses (`messages.USED`, `REPEATED`, `NEUTRALISED`)."""
REFUSED_MARGIN = -(1 << 15)
"""`messages.MARGIN_REFUSED`."""
FRAME_HEAD_BYTES = 6
"""Bytes of a WebSocket frame with at most 125 bytes from a client before the message; the mask is the last four."""


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
def message_head(data: Any, at: int, end: int, newest: int) -> tuple[int, int, int]:
    """Reads the beginning of a message of the kinds `Inputs` and `Held`.

    Args:
        data, at, end: the bytes, and where the message begins and ends.
        newest: the newest tick of which the session has sent anything.

    Returns:
        First tick, acknowledged tick, and where the inputs begin (in a `Held`: `end`; in all other messages: -1).
    """
    if end - at < 4:
        return 0, 0, -1
    holds = data[at] == 0x93 and data[at + 1] == 9
    if not holds and (data[at] != 0x94 or data[at + 1] != 2):
        return 0, 0, -1
    at += 2
    size = number_bytes(data, at)
    if size == 0 or at + size >= end:
        return 0, 0, -1
    first = number_at(data, at, size)
    at += size
    size = number_bytes(data, at)
    if size == 0 or at + size > end or (not holds and at + size + 2 > end):
        return 0, 0, -1
    acked = number_at(data, at, size)
    at += size
    if not holds:
        return first, acked, at
    if not 1 <= first <= AFTER_MAX or acked < 0 or at != end:
        return 0, 0, -1
    return newest + first, newest + first - acked, end


@inlined
def put_margin(numbers: Any, base: int, due: int, tick: int, ahead: float, one: float) -> None:
    """Files the margin of a message for the tick `due`, which becomes the newest one."""
    margin = floor((due - tick - 1 + ahead) * one)
    if due <= tick:
        margin = min(margin, -1)
    numbers[base + MARGINS + numbers[base + N_MARGINS]] = max(REFUSED_MARGIN + 1, min(margin, -REFUSED_MARGIN - 1))
    numbers[base + N_MARGINS] += 1
    numbers[base + NEWEST] = numbers[base + ACCEPTED] = due


@inlined
def hold_input(numbers: Any, base: int, due: int, tick: int, repeats: int, ahead: float, one: float) -> None:
    """Notes that the latest input of a row holds from `due` on, as `InputQueue.hold` does."""
    end, held_to = due + repeats, numbers[base + HELD_TO]
    if due <= tick:
        numbers[base + LATE] += max(min(tick, end) - max(due, held_to + 1) + 1, 0)
        numbers[base + MISSING] = 0
    numbers[base + HELD_TO] = max(held_to, end)
    put_margin(numbers, base, due, tick, ahead, one)


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
        numbers[base + HELD_TO] = min(numbers[base + HELD_TO], due - 1)
        if due > tick:
            slot = (row * slots + due % slots) * SLOT
            ring[slot], ring[slot + 1], ring[slot + 2] = due, head, aim
        else:
            numbers[base + LATE] += 1
            numbers[base + HELD], numbers[base + HELD_AIM], numbers[base + MISSING] = head, aim, 0
        put_margin(numbers, base, due, tick, ahead, one)


@inlined
def put_refused(numbers: Any, base: int, n: int) -> None:
    """Files the margins of `n` ticks whose inputs are refused or left out."""
    for _ in range(n):
        numbers[base + MARGINS + numbers[base + N_MARGINS]] = REFUSED_MARGIN
        numbers[base + N_MARGINS] += 1


@inlined
def refuse_inputs(numbers: Any, base: int, first: int, n: int) -> None:
    """Refuses the inputs of `n` ticks from `first` on, the last of which becomes the newest one."""
    put_refused(numbers, base, n)
    numbers[base + REFUSED] += n
    if n > 0:
        numbers[base + NEWEST] = first + n - 1


@jit
def unmask(data: Any, sizes: Any) -> None:
    """Unmasks the messages in WebSocket frames.

    Args:
        data: frames and messages, one after the other.
        sizes: the size of each in bytes; that of a frame is negative.
    """
    end = 0
    for i in range(len(sizes)):
        at = end
        end += abs(sizes[i])
        if sizes[i] < 0:
            for j in range(at + FRAME_HEAD_BYTES, end):
                data[j] ^= data[at + 2 + (j - at - FRAME_HEAD_BYTES) % 4]


@jit
def take_messages(
    numbers: Any,
    floats: Any,
    ring: Any,
    data: bytes,
    rows: Any,
    sizes: Any,
    times: Any,
    fates: Any,
    rules: Any,
    clock: Any,
) -> None:
    """Takes the input messages of the time since the latest tick, as `Front.receive` would one by one.

    Args:
        numbers, floats, ring: the rows. Those with a message that is left become `ODD`; their later ones are left, too.
        data: the messages, one after the other; those in frames are unmasked.
        rows, sizes, times: row, bytes (negative: of its frame) and time (s) of each message; `fates` gets its fate.
        rules: latest tick, most ticks ahead, bytes of an input, inputs of a message, slots of a row, ticks of repeats,
            most ticks ahead for which there is room.
        clock: deadline of the latest tick in seconds, ticks per second, most ticks to catch up on, a margin of one tick
            on the wire, messages of a burst, `flow_control.RATE_WINDOW_S`, `flow_control.RTT_SPAN_S`.
    """
    tick, ahead_most, row_bytes, slots, repeats, room = rules[0], rules[1], rules[2], rules[4], rules[5], rules[6]
    deadline, rate, catch_up, one, burst = clock[0], clock[1], clock[2], clock[3], clock[4]
    end = 0
    for i in range(len(fates)):
        row, at = rows[i], end + (FRAME_HEAD_BYTES if sizes[i] < 0 else 0)
        end += abs(sizes[i])
        base, reals = row * WIDTH, row * FLOATS
        fates[i] = LEFT
        if numbers[base + STATE] != PLAIN:
            continue
        numbers[base + STATE] = ODD
        newest, kept = numbers[base + NEWEST], numbers[base + N_MARGINS]
        first, acked, at = message_head(data, at, end, newest)
        if at < 0:
            continue
        size = end - at - 2
        n = 1 if at == end else size // row_bytes
        if at < end and (data[at] != 0xC4 or data[at + 1] != size or n * row_bytes != size or n > rules[3]):
            continue
        refused = first > tick + ahead_most or (at == end and newest != numbers[base + ACCEPTED])
        if first <= max(newest, numbers[base + ACCEPTED]) or (not refused and first + n - 1 > tick + room):
            continue
        left_out = first - newest - 1 if kept > 0 or first > numbers[base + HELD_TO] + 1 else 0
        if first + n > FIRST_MAX or kept + left_out + n > KEPT:
            continue
        if floats[reals + ALLOWANCE] - 1 < -burst:
            continue
        now = times[i]
        floats[reals + RECEIVED_AT] = max(floats[reals + RECEIVED_AT], now)
        floats[reals + ALLOWANCE] -= 1
        ahead = ticks_left(now, deadline, rate, catch_up)
        put_refused(numbers, base, left_out if n > 0 else 0)
        if refused:
            refuse_inputs(numbers, base, first, n)
        elif at == end:
            hold_input(numbers, base, first, tick, repeats, ahead, one)
        else:
            file_inputs(numbers, ring, row, data, at + 2, (first, n, tick, row_bytes, slots), ahead, one)
        fates[i] = DONE
        if numbers[base + ACKED] < acked <= numbers[base + TICK]:
            numbers[base + ACKED] = acked
            probe = numbers[base + PROBE_TICK]
            if 0 <= probe <= acked:
                numbers[base + PROBE_TICK] = -1
                if probe == acked and matters(floats, reals, now, clock[5], clock[6]):
                    fates[i] = ANSWERED
        numbers[base + STATE] = PLAIN


@inlined
def matters(floats: Any, reals: int, now: float, window_s: float, span_s: float) -> bool:
    """Returns whether `FlowControl.answered` would do anything with an answer that the probe gets now."""
    rtt_s = now - floats[reals + PROBE_AT]
    return bool(
        now - floats[reals + FULL_AT] < window_s + rtt_s
        or rtt_s < floats[reals + RTT]
        or now - floats[reals + RTT_AT] >= span_s
    )


@jit
def take_inputs(
    numbers: Any,
    ring: Any,
    taken: Any,
    changed: Any,
    unrecorded: Any,
    tick: int,
    repeats: int,
    slots: int,
    most: int,
) -> int:
    """Takes an input of every row for a tick, as `InputQueue.take` does.

    Args:
        numbers, ring: the rows.
        taken: the inputs of the tick before, and gets those of this one. Two numbers per row: the first three bytes of
            the input, and the six bytes of its aim.
        changed: gets the rows whose input is not that of the tick before.
        unrecorded: gets the status and the input at an edge, where a status is filed by `confirm_inputs`.
        tick: the tick.
        repeats: number of missing inputs up to which the latest one is repeated.
        slots: slots of a row.
        most: slots of a row in `unrecorded`; 0: this is no edge.

    Returns:
        The number of rows in `changed`.
    """
    n = 0
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
        elif tick <= numbers[base + HELD_TO]:
            numbers[base + MISSING] = repeats
            numbers[base + USED] += 1
        else:
            numbers[base + MISSING] += 1
            numbers[base + SUBSTITUTED] += 1
            status = REPEATED_INPUT if numbers[base + MISSING] <= repeats else NEUTRAL_INPUT
        head = 0 if status == NEUTRAL_INPUT else numbers[base + HELD]
        aim = 0 if status == NEUTRAL_INPUT else numbers[base + HELD_AIM]
        if most == 0:
            file_status(numbers, base, status)
        else:
            slot = (row * most + tick % most) * UNRECORDED
            unrecorded[slot], unrecorded[slot + 1], unrecorded[slot + 2] = status, head, aim
        if taken[2 * row] != head or taken[2 * row + 1] != aim:
            taken[2 * row], taken[2 * row + 1] = head, aim
            changed[n] = row
            n += 1
    return n


@inlined
def file_status(numbers: Any, base: int, status: int) -> None:
    """Adds an input status to those for the next snapshot."""
    kept = numbers[base + N_STATUSES]
    if kept < KEPT:  # there are more only if ticks fail before their snapshots are sent
        numbers[base + STATUSES + kept] = status
        numbers[base + N_STATUSES] = kept + 1


@jit
def confirm_inputs(numbers: Any, unrecorded: Any, tick: int, most: int) -> None:
    """Files the statuses of a tick at an edge, whose record has the inputs that `take_inputs` has taken.

    Args:
        numbers: the rows.
        unrecorded: statuses and inputs of the ticks whose records have not come.
        tick: the tick.
        most: slots of a row in `unrecorded`.
    """
    for row in range(len(numbers) // WIDTH):
        if numbers[row * WIDTH + STATE] != FREE:
            file_status(numbers, row * WIDTH, unrecorded[(row * most + tick % most) * UNRECORDED])
