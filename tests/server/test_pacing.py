"""How much may be on the way: by hand-made paths."""

from server.pacing import HOLD_S_MAX, LEAST_BYTES, NARROW_TICKS, RTT_WINDOW_S, Pacing

TICK_S = 1 / 32


def stream(pacing: Pacing, seconds: float, bytes_per_tick: int, outstanding: int, start: float = 0.0) -> float:
    """Sends evenly while so much is on the way; the time afterwards."""
    now = start
    for _ in range(int(seconds / TICK_S)):
        pacing.sent_bytes += bytes_per_tick
        now += TICK_S
        pacing.window(outstanding, bytes_per_tick, TICK_S, now)
    return now


def test_of_an_unknown_path_two_snapshots_may_be_on_the_way() -> None:
    assert Pacing().window(0, 100, TICK_S, 0.0) == LEAST_BYTES
    assert Pacing().window(0, 4000, TICK_S, 0.0) == 8000


def test_the_rate_is_what_has_been_acknowledged() -> None:
    pacing = Pacing()
    stream(pacing, 2.0, 320, 0)
    assert pacing.rate == 320 / TICK_S


def test_three_round_trips_of_the_rate_may_be_on_the_way_and_of_a_long_path_one_and_a_half() -> None:
    for rtt_s, hold_s in ((0.1, 0.3), (0.2, 0.6), (0.3, HOLD_S_MAX), (1.0, 1.5)):
        pacing = Pacing()
        pacing.answered(rtt_s, 0, 0.0)
        now = stream(pacing, 2.0, 3200, 0)
        assert pacing.window(0, 10, TICK_S, now) == int(pacing.rate * (hold_s + TICK_S))


def test_a_fall_of_the_rate_is_known_after_a_second() -> None:
    pacing = Pacing()
    now = stream(pacing, 2.0, 3200, 0)
    fast = pacing.rate
    stream(pacing, 2.0, 320, 0, now)
    assert pacing.rate == fast / 10


def test_the_shortest_round_trip_counts() -> None:
    pacing = Pacing()
    for now, rtt_s in enumerate((0.09, 0.05, 0.2, 0.07)):
        pacing.answered(rtt_s, 0, float(now))
    assert pacing.least_rtt_s == 0.05


def test_of_a_full_path_the_width_is_no_distance() -> None:
    pacing = Pacing()
    now = stream(pacing, 2.0, 320, 0)
    assert pacing.window(10**6, 320, TICK_S, now) < 10**6  # full
    pacing.answered(0.1, 512, now)
    assert pacing.least_rtt_s == 0.1 - 512 / pacing.rate


def test_a_path_that_is_always_full_is_emptied_once_a_minute() -> None:
    pacing = Pacing()
    pacing.answered(0.05, 0, 0.0)
    now = stream(pacing, RTT_WINDOW_S, 320, 10**6)
    assert pacing.window(10**6, 320, TICK_S, now) > 0
    now = stream(pacing, 1.0, 320, 10**6, now)
    assert pacing.window(10**6, 320, TICK_S, now) == 0
    pacing.answered(0.05, 0, now)
    assert pacing.window(10**6, 320, TICK_S, now) > 0


def test_a_path_that_is_never_full_is_never_emptied() -> None:
    pacing = Pacing()
    pacing.answered(0.05, 0, 0.0)
    now = stream(pacing, 3 * RTT_WINDOW_S, 320, 0)
    assert pacing.window(0, 320, TICK_S, now) > 0


def test_a_path_that_mostly_holds_snapshots_back_is_narrow_and_gets_small_ones_until_it_does_not() -> None:
    pacing = Pacing()
    pacing.answered(0.05, 0, 0.0)
    now = stream(pacing, 2.0, 320, 0)
    wide = pacing.window(0, 1000, TICK_S, now)
    assert wide == 2000
    assert pacing.room(wide, 500) == 1500
    now = stream(pacing, 0.5, 320, 10**6, now)  # a stall
    assert pacing.room(wide, 500) == 1500
    now = stream(pacing, 1.5, 320, 10**6, now)
    window = pacing.window(10**6, 1000, TICK_S, now)
    assert window == int(pacing.rate * (0.05 + 2 * TICK_S)) < wide
    assert pacing.room(window, 0) == int(pacing.rate * NARROW_TICKS * TICK_S)
    now = stream(pacing, 2.0, 320, 0, now)
    assert pacing.window(0, 1000, TICK_S, now) == wide
