"""Where others are drawn, to the bit: times and places here are sums of powers of two, and 100 ms are 4 ticks."""

import numpy as np
import pytest

from client_sdk.interpolation import CALM_S, EXTRAPOLATE_S, FALL_S_PER_S, KEPT, Interpolation
from shared.layout import Int64s
from shared.units import BLOCK

RATE = 40.0


def states(**blocks: float) -> Int64s:
    """Entities a (1), b (2), c (3) at these x."""
    rows = [(ord(name) - 96, 0, 0, int(x * BLOCK), 0, 0, 0, 0, 0, 0, 0, 0) for name, x in sorted(blocks.items())]
    return np.array(rows, np.int64).reshape(-1, 12)


def shown(interpolation: Interpolation, tick: float) -> dict[str, float]:
    """x by name, when the moment shown is `tick`."""
    rows, places = interpolation.sample(tick + interpolation.delay_ticks)
    return {chr(96 + row[0]): place[0] for row, place in zip(rows.tolist(), places.tolist(), strict=True)}


def fed(*snapshots: tuple[int, Int64s]) -> Interpolation:
    interpolation = Interpolation(RATE)
    for tick, rows in snapshots:
        interpolation.push(tick, rows)
    return interpolation


def test_before_the_first_snapshot_there_is_nothing() -> None:
    rows, places = Interpolation(RATE).sample(100.0)
    assert (rows.shape, places.shape) == ((0, 12), (0, 3))
    Interpolation(RATE).advance(1.0, 1.0)


def test_with_one_snapshot_all_stand_where_they_were() -> None:
    assert [shown(fed((10, states(a=5))), tick) for tick in (-50.0, 10.0, 99.0)] == [{"a": 5}] * 3


def test_between_two_snapshots_motion_is_even() -> None:
    interpolation = fed((10, states(a=0, b=8)), (12, states(a=1, b=4)))
    assert shown(interpolation, 10.0) == {"a": 0, "b": 8}
    assert shown(interpolation, 10.5) == {"a": 0.25, "b": 7}
    assert shown(interpolation, 12.0) == {"a": 1, "b": 4}


def test_the_two_snapshots_around_the_moment_are_the_ones_that_count() -> None:
    interpolation = fed(*[(tick, states(a=tick * tick / 8)) for tick in range(1, 9)])
    for tick in range(1, 8):
        assert shown(interpolation, tick + 0.5) == {"a": (tick**2 + (tick + 1) ** 2) / 16}


def test_a_moment_before_the_oldest_snapshot_shows_the_oldest() -> None:
    assert shown(fed((10, states(a=1)), (11, states(a=2))), 3.0) == {"a": 1}


def test_beyond_the_newest_motion_goes_on_for_100_ms_and_then_holds() -> None:
    interpolation = fed((10, states(a=0)), (11, states(a=1)))
    assert EXTRAPOLATE_S * RATE == 4
    assert shown(interpolation, 12.0) == {"a": 2}
    assert [shown(interpolation, tick) for tick in (15.0, 500.0)] == [{"a": 5}] * 2


def test_the_moment_shown_is_that_of_the_clamped_picture() -> None:
    interpolation = fed((10, states(a=0)), (11, states(a=1)))
    ticks = [(3.0, 10.0), (10.0, 10.0), (10.5, 10.5), (12.0, 12.0), (15.0, 15.0), (15.5, 15.0), (500.0, 15.0)]
    assert [interpolation.shown(tick + interpolation.delay_ticks) for tick, _ in ticks] == [at for _, at in ticks]
    assert Interpolation(RATE).shown(7.0) == 5.0


def test_who_is_new_stands_where_it_is_and_who_left_is_not_drawn() -> None:
    interpolation = fed((10, states(a=0, c=3)), (12, states(b=7, c=5)))
    assert shown(interpolation, 11.0) == {"b": 7, "c": 4}


def test_snapshots_of_an_empty_world_are_no_trouble() -> None:
    interpolation = fed((10, states()), (11, states(a=1)), (12, states()))
    assert [shown(interpolation, tick) for tick in (10.5, 11.5, 13.0)] == [{"a": 1}, {}, {}]


def test_what_is_kept_is_bounded() -> None:
    interpolation = fed(*[(tick, states(a=tick)) for tick in range(1000)])
    assert shown(interpolation, 0.0) == {"a": 1000 - KEPT}


def test_the_delay_rises_at_once_by_what_was_missing() -> None:
    interpolation = fed((10, states(a=0)))
    interpolation.advance(12.0, 0.0)
    assert interpolation.delay_ticks == 2.0
    interpolation.advance(15.5, 0.125)
    assert interpolation.delay_ticks == 5.5


def test_the_delay_falls_slowly_and_only_after_a_while_of_calm() -> None:
    interpolation = fed((10, states(a=0)))
    interpolation.advance(20.0, 1.0)
    assert interpolation.delay_ticks == 10.0
    interpolation.push(100, states(a=0))
    interpolation.advance(100.0, 1.0 + CALM_S)
    assert interpolation.delay_ticks == 10.0
    interpolation.advance(100.0, 2.0 + CALM_S)
    assert interpolation.delay_ticks == 10.0 - FALL_S_PER_S * RATE


def test_the_delay_falls_no_lower_than_one_tick_nor_than_what_there_is_to_show() -> None:
    interpolation = fed((10, states(a=0)))
    for second in range(4, 900):
        interpolation.advance(11.5, float(second))
    assert interpolation.delay_ticks == pytest.approx(1.5)
    interpolation.push(20, states(a=0))
    for second in range(900, 990):
        interpolation.advance(20.0, float(second))
    assert interpolation.delay_ticks == 1.0
