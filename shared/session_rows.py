"""The rows of the sessions on the fast path (`server.game.fast_path`): what is in which column.

Compiled code reads and writes them (`shared.traffic`, `shared.pacing`). A session has a row of whole numbers, a row of
floats, the segments of its client view, and a ring of slots for the inputs that wait, one per tick.
"""

(
    STATE, NEWEST, ACCEPTED, MISSING, HELD, HELD_AIM, N_MARGINS, N_STATUSES, LATE, USED, SUBSTITUTED, TICK, ACKED,
    SNAPSHOT_BYTES, SENT_BYTES, TAKEN_BYTES, CARRIES, PROBE_TICK, PROBE_BYTES, N_SEGMENTS, FRAMED, N_SAMPLES, N_RATES,
) = range(23)  # fmt: skip
"""Columns of the whole numbers. STATE: `FREE`, `PLAIN` or `ODD`. NEWEST, ACCEPTED, MISSING, LATE, USED, SUBSTITUTED:
as in `InputQueue`; the last three count since the row was written. HELD, HELD_AIM: the input that is repeated, as its
first three bytes on the wire, and the six bytes of its aim. TICK, ACKED, SNAPSHOT_BYTES, PROBE_TICK (-1: no probe),
PROBE_BYTES: as in `ClientStream`. SENT_BYTES, TAKEN_BYTES, CARRIES: as in `FlowControl`. FRAMED: whether snapshots get
the header of a WebSocket frame. Names with N_: numbers of entries in the columns below."""
MARGINS, STATUSES, KEPT = 23, 31, 8
"""Columns of the margins and of the statuses that are not sent yet, and how many of each there can be."""
SAMPLE_BYTES, SAMPLES = 39, 6
"""Columns of the acknowledged bytes (`FlowControl.samples`), and how many there can be."""
HELD_TO, REFUSED = 45, 46
"""Columns of the last tick for which the latest input holds, and of the refused inputs since the row was written, as in
`InputQueue`."""
WIDTH = 47
"""Columns of whole numbers in a row."""
RECEIVED_AT, ALLOWANCE, SENT_AT, MEASURE_AT, HELD_SHARE, PROBE_AT, FULL_AT, LEAST_RTT, RTT, RTT_AT = range(10)
"""Columns of the floats, as in `Session`, `ClientStream` and `FlowControl`. LEAST_RTT, RTT, RTT_AT: the first round
trip in `FlowControl.rtts`, and the last one with its time (`-inf`: there is none)."""
SAMPLE_AT, RATE_AT, RATE, RATES = 10, 16, 30, 14
"""Columns of the times of the acknowledged bytes, and of `FlowControl.rates`: times, rates; how many of the latter
there can be."""
FLOATS = 44
"""Columns of floats in a row."""
SEGMENTS = 64
"""Maximum number of segments of a client view."""
SLOT = 3
"""Numbers of a slot: the tick of the input (-1: the slot is empty), its first three bytes, its aim's six bytes."""
UNRECORDED = 3
"""Numbers of a slot of a tick whose record has not come (at an edge): status and input, as in `SLOT`."""
FREE, PLAIN, ODD = range(3)
"""States of a row. ODD: the session has something to do that is not done here."""
