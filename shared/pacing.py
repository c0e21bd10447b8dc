"""The part of the kernel that measures the connections of many clients at once (`server.replication.flow_control`).

Only servers use it (`server.game.fast_path`). This source runs compiled and, unchanged, in plain Python. It adds,
subtracts, multiplies, divides and compares floats, so their bits are the same everywhere. `shared.session_rows`
describes the rows of the sessions.
"""

from typing import Any

from shared.jit import decorators
from shared.session_rows import (
    CARRIES,
    FLOATS,
    FULL_AT,
    HELD_SHARE,
    LEAST_RTT,
    MEASURE_AT,
    N_RATES,
    N_SAMPLES,
    ODD,
    PLAIN,
    RATE,
    RATE_AT,
    RATES,
    RECEIVED_AT,
    RTT_AT,
    SAMPLE_AT,
    SAMPLE_BYTES,
    SAMPLES,
    SENT_BYTES,
    SNAPSHOT_BYTES,
    STATE,
    TAKEN_BYTES,
    WIDTH,
)

jit, inlined = decorators(__name__)

LEAST_BYTES = 512
"""`flow_control.LEAST_BYTES`."""
NEVER = -(1 << 60)
"""Times in seconds before this one stand for no time at all."""


@jit
def due_rows(numbers: Any, floats: Any, due: Any, clock: Any) -> int:
    """Lists the rows whose connection is to be asked for the bytes on the way, as `FlowControl.window` asks.

    Makes silent rows `ODD`, and those that would not be steady after their measurement.

    Args:
        numbers, floats: the rows.
        due: gets the rows. Those whose measurement is due come as they are; others, which may have no room, as
            `-1 - row`.
        clock: the time in seconds, the longest time without a message, `flow_control.NARROW`, `RTT_WINDOW_S`.

    Returns:
        The number of rows in `due`.
    """
    now, silence_s, narrow, rtt_window_s = clock[0], clock[1], clock[2], clock[3]
    n = 0
    for row in range(len(numbers) // WIDTH):
        base, reals = row * WIDTH, row * FLOATS
        if numbers[base + STATE] != PLAIN:
            continue
        if now - floats[reals + RECEIVED_AT] > silence_s:
            numbers[base + STATE] = ODD
        elif now >= floats[reals + MEASURE_AT]:
            old = now - floats[reals + RTT_AT] > rtt_window_s > now - floats[reals + FULL_AT]
            full = numbers[base + N_SAMPLES] == SAMPLES or numbers[base + N_RATES] == RATES
            if full or floats[reals + HELD_SHARE] > narrow or (floats[reals + RTT_AT] > NEVER and old):
                numbers[base + STATE] = ODD
                continue
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
def measure_rows(numbers: Any, floats: Any, due: Any, told: Any, n: int, clock: Any) -> None:
    """Takes the bytes on the way of the rows in `due`, as `FlowControl.look` and `measure` do.

    Args:
        numbers, floats: the rows.
        due: rows, as `due_rows` lists them.
        told: the bytes on the way of each.
        n: number of rows in `due`.
        clock: the time in seconds; `flow_control.SAMPLE_S`, `RATE_SPAN_S`, `RATE_WINDOW_S`, `STALL_RTTS`, `HOLD_S_MAX`;
            the duration of a tick in seconds.
    """
    now, stall_rtts, hold_s_max, tick_s = clock[0], clock[4], clock[5], clock[6]
    for i in range(n):
        row = due[i] if due[i] >= 0 else -1 - due[i]
        base, reals = row * WIDTH, row * FLOATS
        numbers[base + TAKEN_BYTES] = numbers[base + SENT_BYTES] - told[i]
        if due[i] < 0:
            continue
        floats[reals + MEASURE_AT] = now + clock[1]
        take_sample(numbers, floats, base, reals, now, clock[2])
        drop_rates(numbers, floats, base, reals, now - clock[3])
        rtt_s = floats[reals + LEAST_RTT]
        hold_s = min(stall_rtts * rtt_s, max(hold_s_max, 1.5 * rtt_s)) + tick_s
        rate = floats[reals + RATE] if numbers[base + N_RATES] > 0 else 0.0
        numbers[base + CARRIES] = max(LEAST_BYTES, int(rate * hold_s))


@inlined
def take_sample(numbers: Any, floats: Any, base: int, reals: int, now: float, span_s: float) -> None:
    """Notes the bytes that are no longer on the way, and the rate since the first note of the last `span_s`."""
    n, taken = numbers[base + N_SAMPLES], numbers[base + TAKEN_BYTES]
    floats[reals + SAMPLE_AT + n], numbers[base + SAMPLE_BYTES + n] = now, taken
    n += 1
    while n > 1 and floats[reals + SAMPLE_AT + 1] <= now - span_s:
        n -= 1
        for j in range(n):
            floats[reals + SAMPLE_AT + j] = floats[reals + SAMPLE_AT + j + 1]
            numbers[base + SAMPLE_BYTES + j] = numbers[base + SAMPLE_BYTES + j + 1]
    numbers[base + N_SAMPLES] = n
    since_s = now - floats[reals + SAMPLE_AT]
    if since_s < span_s:
        return
    rate = (taken - numbers[base + SAMPLE_BYTES]) / since_s
    rates = numbers[base + N_RATES]
    while rates > 0 and floats[reals + RATE + rates - 1] <= rate:
        rates -= 1
    floats[reals + RATE_AT + rates], floats[reals + RATE + rates] = now, rate
    numbers[base + N_RATES] = rates + 1


@inlined
def drop_rates(numbers: Any, floats: Any, base: int, reals: int, oldest: float) -> None:
    """Drops the rates that were measured before a time."""
    n = numbers[base + N_RATES]
    while n > 0 and floats[reals + RATE_AT] < oldest:
        n -= 1
        for j in range(n):
            floats[reals + RATE_AT + j] = floats[reals + RATE_AT + j + 1]
            floats[reals + RATE + j] = floats[reals + RATE + j + 1]
    numbers[base + N_RATES] = n
