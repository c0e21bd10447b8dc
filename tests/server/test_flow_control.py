"""Flow control: the bytes that may be on the way, on links made by hand."""

from server.replication.flow_control import HOLD_S_MAX, LEAST_BYTES, NARROW_S, RTT_WINDOW_S, SAMPLE_S, FlowControl

TICK_S = 1 / 32


class Path:
    """A link on which `outstanding` bytes are on the way; None: the system cannot tell."""

    def __init__(self, outstanding: int | None = 0) -> None:
        self.outstanding = outstanding
        self.asked = 0
        self.flow = FlowControl(self._ask)

    def _ask(self) -> int | None:
        self.asked += 1
        return self.outstanding

    def window(self, snapshot_bytes: int, now: float) -> int:
        return self.flow.window(snapshot_bytes, TICK_S, now)

    def stream(self, seconds: float, bytes_per_tick: int, start: float = 0.0) -> float:
        """Sends evenly for some seconds while `outstanding` bytes are on the way. Returns the time afterwards."""
        now = start
        for _ in range(int(seconds / TICK_S)):
            self.flow.sent_bytes += bytes_per_tick
            now += TICK_S
            self.window(bytes_per_tick, now)
        return now


def test_two_snapshots_may_be_on_the_way_on_an_unknown_link() -> None:
    assert Path().window(100, 0.0) == LEAST_BYTES
    assert Path().window(4000, 0.0) == 8000


def test_the_rate_is_what_has_been_acknowledged() -> None:
    path = Path()
    path.stream(2.0, 320)
    assert path.flow.rate == 320 / TICK_S


def test_three_round_trips_of_the_rate_may_be_on_the_way_or_one_and_a_half_on_a_long_link() -> None:
    for rtt_s, hold_s in ((0.1, 0.3), (0.2, 0.6), (0.3, HOLD_S_MAX), (1.0, 1.5)):
        path = Path()
        path.flow.answered(rtt_s, 0, 0.0)
        now = path.stream(2.0, 3200)
        assert path.window(10, now) == int(path.flow.rate * (hold_s + TICK_S))


def test_a_fall_of_the_rate_is_known_after_a_second() -> None:
    path = Path()
    now = path.stream(2.0, 3200)
    fast = path.flow.rate
    path.stream(2.0, 320, now)
    assert path.flow.rate == fast / 10


def test_the_shortest_round_trip_counts() -> None:
    pacing = Path().flow
    for now, rtt_s in enumerate((0.09, 0.05, 0.2, 0.07)):
        pacing.answered(rtt_s, 0, float(now))
    assert pacing.least_rtt_s == 0.05


def test_a_full_link_does_not_count_as_a_long_one() -> None:
    path = Path()
    now = path.stream(2.0, 320) + SAMPLE_S
    path.outstanding = 10**6
    assert path.window(320, now) < path.flow.outstanding == 10**6  # the link is full
    path.flow.answered(0.1, 512, now)
    assert path.flow.least_rtt_s == 0.1 - 512 / path.flow.rate


def test_a_path_that_is_always_full_is_emptied_once_a_minute() -> None:
    path = Path(10**6)
    path.flow.answered(0.05, 0, 0.0)
    now = path.stream(RTT_WINDOW_S, 320)
    assert path.window(320, now) > 0
    now = path.stream(1.0, 320, now)
    assert path.window(320, now) == 0
    path.flow.answered(0.05, 0, now)
    assert path.window(320, now) > 0


def test_a_path_that_is_never_full_is_never_emptied() -> None:
    path = Path()
    path.flow.answered(0.05, 0, 0.0)
    now = path.stream(3 * RTT_WINDOW_S, 320)
    assert path.window(320, now) > 0


def test_a_path_that_mostly_holds_snapshots_back_is_narrow_and_gets_small_ones_until_it_does_not() -> None:
    path = Path()
    path.flow.answered(0.05, 0, 0.0)
    now = path.stream(2.0, 320) + SAMPLE_S
    path.outstanding = 500
    wide = path.window(1000, now)
    assert wide == 2000
    assert path.flow.room(wide) == 1500
    path.outstanding = 10**6
    now = path.stream(0.5, 320, now)  # a stall
    path.outstanding = 500
    path.flow.look()
    assert path.flow.room(wide) == 1500
    path.outstanding = 10**6
    now = path.stream(1.5, 320, now)
    window = path.window(1000, now)
    assert window == int(path.flow.rate * (0.05 + 2 * TICK_S)) < wide
    path.outstanding = 0
    assert path.flow.room(window) == int(path.flow.rate * NARROW_S)
    now = path.stream(2.0, 320, now)
    assert path.window(1000, now) == wide


def test_the_system_is_asked_only_if_that_decides_and_no_byte_is_missed() -> None:
    path = Path()
    path.window(100, 0.0)
    assert (path.asked, path.flow.outstanding) == (1, 0)
    for sent in range(1, 5):  # 512 bytes may be on the way
        path.flow.sent_bytes += 100
        path.outstanding = 60 * sent
        path.window(100, 0.01 * sent)
        assert (path.asked, path.flow.outstanding) == (1, 100 * sent)
    path.flow.sent_bytes += 100
    path.outstanding = 300
    path.window(100, 0.05)  # another snapshot might not fit
    assert (path.asked, path.flow.outstanding) == (2, 300)
    path.outstanding = 60
    path.window(100, SAMPLE_S)
    assert (path.asked, path.flow.outstanding) == (3, 60)


def test_without_the_system_unacknowledged_snapshots_are_on_the_way() -> None:
    path = Path(None)
    path.window(100, 0.0)
    for tick in range(100):  # a client that waits for terrain acknowledges nothing
        path.flow.sent_bytes += 100
        path.flow.sent(tick)
    path.flow.look()
    assert path.flow.outstanding == 0
    path.flow.acked(99)
    for tick in (101, 102, 103):
        path.flow.sent_bytes += 100
        path.flow.sent(tick)
    path.flow.look()
    assert path.flow.outstanding == 300
    path.flow.acked(102)
    path.flow.sent_bytes += 1000  # terrain counts only with the next snapshot, or nothing would ever be sent again
    path.flow.look()
    assert path.flow.outstanding == 100
    path.outstanding = 700  # our own buffers are full, whatever the client acknowledges
    path.flow.acked(103)
    path.flow.look()
    assert path.flow.outstanding == 700
