"""Flow control: how many bytes may be on the way to one client.

The amount must keep the connection busy without making snapshots old.

Theory of operation. Bytes that TCP has sent and not acknowledged wait in some queue, and the newest snapshot goes
behind them. So a snapshot is sent only while the bytes on the way (unsent and unacknowledged) fit into the window

    max(two snapshots, 512 bytes, rate x (3 x least round trip + one tick))

`rate` is the highest rate at which the connection has acknowledged bytes lately. The least round trip is measured with
nothing else on the way. The window has three of them because a lost packet delays the acknowledgements of everything
behind it by two or more, although no queue has grown. With one round trip, a connection of 200 ms that loses 2 % of its
packets gets 28 snapshots/s instead of 32. For long round trips the factor is smaller (`HOLD_S_MAX`).

If the window holds back most snapshots for a second, the cause is not packet loss but a narrow connection. Then the
queue consists of this server's own bytes and should be empty: when a snapshot is sent, only the bytes of one round trip
and two ticks may be on the way. The snapshot may be as large as what the connection carries in an eighth of a second.
So a client gets small snapshots often, with its own segment in each, instead of large ones rarely. At 30 kb/s for a
view that needs 90, they are 0.28 s old instead of 0.56 s.

The round trip is measured with snapshots before which nothing was on the way. If that never happens because the
connection is always full, sending pauses once a minute until it is empty. Otherwise the queue would count as distance
and could grow without bound. A client whose snapshots were left out gets the union of the changes with the next one.

The link is asked for the bytes on the way only if the answer matters. In between, the bytes sent since are added to the
last answer, which saves 2.3 of 31.7 us per client and tick. If the system cannot tell (Linux can), bytes up to a
snapshot count as on the way until the client acknowledges it.
"""

import math
from collections.abc import Callable

RATE_WINDOW_S = 1.0
"""Seconds of which the highest measured rate counts."""
RATE_SPAN_S = 0.25
"""Minimum time over which a rate is measured, in seconds."""
SAMPLE_S = 0.1
"""Seconds between two measurements: one tick in three or four, which saves 1.3 us per client and tick."""
RTT_WINDOW_S = 60.0
"""Seconds of which the shortest round trip counts, and after which sending pauses to measure a new one."""
RTT_SPAN_S = 1.0
"""Seconds after a measured round trip in which only a shorter one is kept."""
STALL_RTTS = 3.0
"""Round trips whose bytes may be on the way."""
HOLD_S_MAX = 0.6
"""Upper bound of the time that `STALL_RTTS` round trips stand for, in seconds; but it is at least 1.5 round trips."""
LEAST_BYTES = 512
"""Bytes that may always be on the way."""
HELD_S = 1.0
"""Seconds over which the share of ticks is averaged in which nothing could be sent."""
NARROW, WIDE = 0.5, 0.4
"""Share of such ticks above which a connection counts as narrow, and below which it no longer does."""
NARROW_S = 0.125
"""Seconds. On a narrow connection, a snapshot may be as large as what the connection carries in this time."""
NARROW_BYTES = 96
"""Bytes that a snapshot on a narrow connection may always have."""


class FlowControl:
    """The flow control of the connection to one client.

    Args:
        ask: returns the bytes on the way, or None if unknown, like `client_stream.Link.outstanding`.
    """

    def __init__(self, ask: Callable[[], int | None]) -> None:
        self.sent_bytes = 0
        """Total of bytes handed to the transport."""
        self._ask = ask
        self.taken = 0
        """Lower bound of the bytes that are no longer on the way."""
        # If the link cannot tell: the snapshots that are not acknowledged, with the total of bytes after each. They
        # count from the first acknowledgement on, because a client that waits for terrain sends none.
        self.blind = False
        """Whether the link could once not tell the bytes on the way."""
        self._unheard: list[tuple[int, int]] = []
        self._heard = -1
        self.measure_at = -math.inf
        """Time in seconds of the next measurement."""
        self.samples: list[tuple[float, int]] = []
        """Latest measurements: time in seconds, total of bytes that were no longer on the way."""
        self.rates: list[tuple[float, float]] = []
        self.rtts: list[tuple[float, float]] = []
        """Rates and round trips, each with its time in seconds in front. One is dropped once a later one is better, so
        the best is the first."""
        self.full_at = -math.inf
        """Time in seconds at which nothing could be sent for the last time."""
        self.pauses = self.narrow = False
        """Whether sending pauses to measure the round trip; whether the connection is narrow."""
        self.held_share = 0.0
        """Share of ticks in which nothing could be sent, averaged over `HELD_S`."""
        self.carries = LEAST_BYTES
        """Bytes that may be on the way, apart from two snapshots."""
        self._portion = 0

    @property
    def rate(self) -> float:
        """Highest rate of the last `RATE_WINDOW_S`, in bytes per second; 0: not measured yet."""
        return self.rates[0][1] if self.rates else 0.0

    @property
    def least_rtt_s(self) -> float:
        """Shortest time from sending a snapshot to its acknowledgement, in seconds; 0: not measured yet."""
        return self.rtts[0][1] if self.rtts else 0.0

    @property
    def outstanding(self) -> int:
        """Upper bound of the bytes that are on the way."""
        return self.sent_bytes - self.taken

    def look(self) -> None:
        """Asks the link for the bytes on the way, which makes `outstanding` exact."""
        told = self._ask()
        self.blind = self.blind or told is None
        unheard = self._unheard[-1][1] - self._heard if self._unheard else 0
        self.taken = self.sent_bytes - max(told or 0, unheard)

    def sent(self, tick: int) -> None:
        """Notes that the snapshot of a tick was handed to the transport."""
        if self.blind and self._heard >= 0:
            self._unheard.append((tick, self.sent_bytes))

    def acked(self, tick: int) -> None:
        """Notes that the client has acknowledged the snapshot of a tick."""
        if self._heard < 0:
            self._heard = self.sent_bytes
        while self._unheard and self._unheard[0][0] <= tick:
            self._heard = self._unheard.pop(0)[1]

    def answered(self, rtt_s: float, size: int, now: float) -> None:
        """Takes a measured round trip.

        Args:
            rtt_s: seconds from sending a message, before which nothing was on the way, to its acknowledgement.
            size: bytes of the message.
            now: the current time in seconds.
        """
        if now - self.full_at < RATE_WINDOW_S + rtt_s and self.rate > 0:
            rtt_s = max(rtt_s - size / self.rate, 0.0)  # on a narrow connection, subtract the time of the transfer
        if self.rtts and rtt_s >= self.rtts[-1][1] and now - self.rtts[-1][0] < RTT_SPAN_S:
            return
        while self.rtts and (self.rtts[0][0] < now - RTT_WINDOW_S):
            self.rtts.pop(0)
        while self.rtts and self.rtts[-1][1] >= rtt_s:
            self.rtts.pop()
        self.rtts.append((now, rtt_s))
        self.pauses = False

    def window(self, snapshot_bytes: int, tick_s: float, now: float) -> int:
        """Returns how many bytes may be on the way now. Call it once per tick.

        Args:
            snapshot_bytes: size of the latest snapshot.
            tick_s: duration of a tick in seconds.
            now: the current time in seconds.
        """
        measure = now >= self.measure_at
        if measure:
            self.measure(tick_s, now)
        window = self.carries
        if not self.narrow and 2 * snapshot_bytes > window:
            window = 2 * snapshot_bytes
        if not measure and self.sent_bytes - self.taken + snapshot_bytes > window:
            self.look()
        if self.pauses:
            return 0
        held = self.sent_bytes - self.taken > window
        if held:
            self.full_at = now
        if held or self.held_share:
            self.held_share += (held - self.held_share) * min(tick_s / HELD_S, 1.0)
        return window

    def room(self, window: int) -> int:
        """Returns how many bytes, about, a snapshot may have that is sent now, for the result of `window`."""
        return self._portion if self.narrow else max(window - self.outstanding, LEAST_BYTES)

    @property
    def steady(self) -> bool:
        """Whether all that limits the next snapshot is `carries`, and the link tells the bytes on the way."""
        return not (self.narrow or self.pauses or self.blind or self._heard < 0)

    def measure(self, tick_s: float, now: float) -> None:
        """Measures the rate of the connection, and from it how many bytes may be on the way.

        Args:
            tick_s: duration of a tick in seconds.
            now: the current time in seconds.
        """
        self.measure_at = now + SAMPLE_S
        self.look()
        acked = self.taken
        self.samples.append((now, acked))
        while len(self.samples) > 1 and self.samples[1][0] <= now - RATE_SPAN_S:
            self.samples.pop(0)
        since, before = self.samples[0]
        if now - since >= RATE_SPAN_S:
            rate = (acked - before) / (now - since)
            while self.rates and self.rates[-1][1] <= rate:
                self.rates.pop()
            self.rates.append((now, rate))
        while self.rates and self.rates[0][0] < now - RATE_WINDOW_S:
            self.rates.pop(0)
        rtt_s = self.least_rtt_s
        self.narrow = self.held_share > (WIDE if self.narrow else NARROW)
        if self.narrow:
            self.carries = max(NARROW_BYTES, int(self.rate * (rtt_s + 2 * tick_s)))
            self._portion = max(NARROW_BYTES, int(self.rate * NARROW_S))
        else:
            hold_s = min(STALL_RTTS * rtt_s, max(HOLD_S_MAX, 1.5 * rtt_s)) + tick_s
            self.carries = max(LEAST_BYTES, int(self.rate * hold_s))
        self.pauses = bool(self.rtts) and now - self.rtts[-1][0] > RTT_WINDOW_S > now - self.full_at
