"""How much may be on its way to one client: enough to keep its path busy, too little to make snapshots old.

Theory of operation. What a TCP connection has not acknowledged yet stands in a queue somewhere, and the newest
snapshot goes behind it. So a snapshot is sent only while the bytes on the way (unsent and unacknowledged) fit into

    max(two snapshots, 512 bytes, rate x (3 x least round trip + one tick))

where `rate` is the fastest the path has acknowledged bytes lately and the least round trip is that of an empty
path. Three of them, because a lost packet holds up the acknowledgements of all behind it for two or more, although
no queue has grown: with one, a path of 200 ms that loses 2 % of its packets gets 28 snapshots/s instead of 32.

Where that holds back most snapshots for a second, it is no loss but the path that is narrow. Then the queue is of
one's own making, and there should be none: one round trip and two ticks may be on the way when a snapshot is sent, and
it may be as large as the path carries in an eighth of a second. So a client gets small snapshots often, its own segment
in each, instead of large ones rarely: at 30 kb/s for a view of 90, they are 0.28 s old instead of 0.56.

The round trip is measured of snapshots before which nothing was on the way. Where that never happens because the
path is full, sending pauses once a minute until it is empty, or a queue of one's own would pass for distance, and grow
for ever.
A client that lost some ticks that way gets their union in its next snapshot: latest wins.

The link is asked what is on the way only where that decides something: from one time to the next, what has been sent
since is counted on top (2.3 us less of 31.7 for each client's tick). Where the system cannot tell (Linux can), what the
client has not acknowledged counts.
"""

import math
from collections import deque
from collections.abc import Callable

RATE_WINDOW_S = 1.0
"""The rate is the best of the last second,"""
RATE_SPAN_S = 0.25
"""each measured over at least a quarter of one."""
SAMPLE_S = 0.1
"""and looked at so often: that is one tick in three or four, and takes 1.3 us off each client's tick."""
RTT_WINDOW_S = 60.0
RTT_SPAN_S = 1.0
"""Of the round trips within such a time only one that is shorter than the last is kept."""
STALL_RTTS = 3.0
HOLD_S_MAX = 0.6
"""Three round trips are enough at this length; of longer ones one and a half."""
LEAST_BYTES = 512
HELD_S = 1.0
"""The share of ticks in which nothing could be sent is averaged over this long."""
NARROW, WIDE = 0.5, 0.4
"""A path is narrow from this share on, until it is less than that."""
NARROW_S = 0.125
"""On a narrow path, a snapshot may be as large as what the path carries in this time,"""
NARROW_BYTES = 96
"""or this."""


class Pacing:
    """The path to one client, from what was sent and what is still on the way.

    Args:
        ask: as `server.game.session.Link.outstanding`.
    """

    def __init__(self, ask: Callable[[], int | None]) -> None:
        self.sent_bytes = 0
        """All that has been handed to the transport."""
        self._ask = ask
        self._taken = 0  # so much of it at least is not on the way any more
        # Where the link cannot tell: snapshots that have not been acknowledged, and what had been sent with each. They
        # count from the first acknowledgement on: a client that waits for terrain sends none.
        self._blind = False
        self._unheard: deque[tuple[int, int]] = deque()
        self._heard = -1
        self._measure_at = -math.inf
        self._acked: list[tuple[float, int]] = []  # time, bytes acknowledged by then
        # Time and value; whatever a later one beats is dropped, so the best is in front.
        self._rates: list[tuple[float, float]] = []
        self._rtts: list[tuple[float, float]] = []
        self._full_at = -math.inf
        self._pauses = self._narrow = False
        self._held = 0.0
        self._carries = LEAST_BYTES
        self._portion = 0

    @property
    def rate(self) -> float:
        """Bytes per second that the path has lately been seen to carry."""
        return self._rates[0][1] if self._rates else 0.0

    @property
    def least_rtt_s(self) -> float:
        """The shortest time lately from sending a snapshot to hearing that it was applied."""
        return self._rtts[0][1] if self._rtts else 0.0

    @property
    def outstanding(self) -> int:
        """Bytes that are on the way, at most."""
        return self.sent_bytes - self._taken

    def look(self) -> None:
        """Asks the link: `outstanding` is exact now."""
        told = self._ask()
        self._blind = self._blind or told is None
        unheard = self._unheard[-1][1] - self._heard if self._unheard else 0
        self._taken = self.sent_bytes - max(told or 0, unheard)

    def sent(self, tick: int) -> None:
        """The snapshot of a tick has been handed over."""
        if self._blind and self._heard >= 0:
            self._unheard.append((tick, self.sent_bytes))

    def acked(self, tick: int) -> None:
        """The client has applied the snapshot of a tick."""
        if self._heard < 0:
            self._heard = self.sent_bytes
        while self._unheard and self._unheard[0][0] <= tick:
            self._heard = self._unheard.popleft()[1]

    def answered(self, rtt_s: float, size: int, now: float) -> None:
        """The client has acknowledged, `rtt_s` after it was sent, `size` bytes before which nothing was on the way."""
        if now - self._full_at < RATE_WINDOW_S + rtt_s and self.rate > 0:
            rtt_s = max(rtt_s - size / self.rate, 0.0)  # of a narrow path, part of that was its width
        if self._rtts and rtt_s >= self._rtts[-1][1] and now - self._rtts[-1][0] < RTT_SPAN_S:
            return
        while self._rtts and (self._rtts[0][0] < now - RTT_WINDOW_S):
            self._rtts.pop(0)
        while self._rtts and self._rtts[-1][1] >= rtt_s:
            self._rtts.pop()
        self._rtts.append((now, rtt_s))
        self._pauses = False

    def window(self, snapshot_bytes: int, tick_s: float, now: float) -> int:
        """How many bytes may be on the way now, if the latest snapshot had so many; call once a tick."""
        measure = now >= self._measure_at
        if measure:
            self._measure_at = now + SAMPLE_S
            self.look()
            self._measure(tick_s, now)
        window = self._carries
        if not self._narrow and 2 * snapshot_bytes > window:
            window = 2 * snapshot_bytes
        if not measure and self.sent_bytes - self._taken + snapshot_bytes > window:
            self.look()
        if self._pauses:
            return 0
        held = self.sent_bytes - self._taken > window
        if held:
            self._full_at = now
        if held or self._held:
            self._held += (held - self._held) * min(tick_s / HELD_S, 1.0)
        return window

    def room(self, window: int) -> int:
        """How large about a snapshot may be that is sent now."""
        return self._portion if self._narrow else max(window - self.outstanding, LEAST_BYTES)

    def _measure(self, tick_s: float, now: float) -> None:
        acked = self._taken
        self._acked.append((now, acked))
        while len(self._acked) > 1 and self._acked[1][0] <= now - RATE_SPAN_S:
            self._acked.pop(0)
        since, before = self._acked[0]
        if now - since >= RATE_SPAN_S:
            rate = (acked - before) / (now - since)
            while self._rates and self._rates[-1][1] <= rate:
                self._rates.pop()
            self._rates.append((now, rate))
        while self._rates and self._rates[0][0] < now - RATE_WINDOW_S:
            self._rates.pop(0)
        rtt_s = self.least_rtt_s
        self._narrow = self._held > (WIDE if self._narrow else NARROW)
        if self._narrow:
            self._carries = max(NARROW_BYTES, int(self.rate * (rtt_s + 2 * tick_s)))
            self._portion = max(NARROW_BYTES, int(self.rate * NARROW_S))
        else:
            hold_s = min(STALL_RTTS * rtt_s, max(HOLD_S_MAX, 1.5 * rtt_s)) + tick_s
            self._carries = max(LEAST_BYTES, int(self.rate * hold_s))
        self._pauses = bool(self._rtts) and now - self._rtts[-1][0] > RTT_WINDOW_S > now - self._full_at
