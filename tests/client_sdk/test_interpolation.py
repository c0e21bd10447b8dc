"""Places where other entities are drawn, to the bit: times and places are sums of powers of two, and 100 ms are 4
ticks."""

import numpy as np
import pytest

from client_sdk.interpolation import Interpolation
from client_sdk.interpolation.interpolation import (
    CALM_S,
    EXTRAPOLATE_S,
    FALL_S_PER_S,
    KEPT_S,
    LONG_CALM_S,
    LONG_FALL,
    LONG_S,
    LONG_SHARE,
)
from shared.layout import TEMPLATE, VX, Int64s
from shared.units import BLOCK, SPEED

RATE = 40.0


def states(**blocks: float) -> Int64s:
    """Returns states of the entities a (1), b (2) and c (3) at these x."""
    rows = [(ord(name) - 96, 0, 0, int(x * BLOCK), 0, 0, 0, 0, 0, 0, 0, 0) for name, x in sorted(blocks.items())]
    return np.array(rows, np.int64).reshape(-1, 12)


def shown(interpolation: Interpolation, tick: float) -> dict[str, float]:
    """Returns the drawn x by name, with the view tick `tick`."""
    at = interpolation.shown(tick + interpolation.delay_ticks)
    way = interpolation.way(at)
    return {chr(96 + entity): place[0] for entity, place in zip(way.before.ids, way.places(at), strict=True)}


def fed(*snapshots: tuple[int, Int64s]) -> Interpolation:
    interpolation = Interpolation(RATE)
    for tick, rows in snapshots:
        interpolation.push(tick, rows)
    return interpolation


def test_before_the_first_snapshot_there_is_nothing() -> None:
    way = Interpolation(RATE).way(100.0)
    assert (way.before.ids, way.places(100.0)) == ([], [])
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


def moving(blocks_per_s: float, **blocks: float) -> Int64s:
    """Returns states like `states`, with a velocity along x."""
    rows = states(**blocks)
    rows[:, VX] = int(blocks_per_s * SPEED)
    return rows


def test_beyond_the_newest_an_entity_goes_on_by_its_velocity_for_less_than_a_tick() -> None:
    interpolation = fed((10, moving(20, a=0)), (11, moving(20, a=0.5)))
    assert shown(interpolation, 11.5) == {"a": 0.75}
    for tick in (12.0, 500.0):
        assert 0.99 < shown(interpolation, tick)["a"] < 1


def test_beyond_the_newest_at_most_100_ms_are_drawn() -> None:
    interpolation = Interpolation(4.0)
    for tick in (10, 11):
        interpolation.push(tick, moving(8, a=2.0 * tick))
    assert EXTRAPOLATE_S == 0.1
    assert shown(interpolation, 11.25) == {"a": 22.5}
    assert shown(interpolation, 11.75)["a"] == pytest.approx(22.8)


def test_an_entity_that_has_come_to_rest_does_not_go_on() -> None:
    assert shown(fed((10, moving(40, a=0)), (11, states(a=1))), 11.75) == {"a": 1}


def test_the_moment_shown_is_that_of_the_clamped_picture() -> None:
    interpolation = fed((10, states(a=0)), (11, states(a=1)))
    ticks = [(3.0, 10.0), (10.0, 10.0), (10.5, 10.5), (11.5, 11.5)]
    assert [interpolation.shown(tick + interpolation.delay_ticks) for tick, _ in ticks] == [at for _, at in ticks]
    for tick in (12.0, 500.0):
        assert 11.99 < interpolation.shown(tick + interpolation.delay_ticks) < 12
    assert Interpolation(RATE).shown(7.0) == 5.0


def test_an_entity_is_drawn_from_the_tick_it_came_in_to_the_tick_it_went_in() -> None:
    interpolation = fed((10, states(a=0, c=3)), (12, states(b=7, c=5)))
    assert shown(interpolation, 11.0) == {"a": 0, "c": 4}
    assert shown(interpolation, 12.0) == {"b": 7, "c": 5}


def test_snapshots_of_an_empty_world_are_no_trouble() -> None:
    interpolation = fed((10, states()), (11, states(a=1)), (12, states()))
    assert [shown(interpolation, tick) for tick in (10.5, 11.5, 13.0)] == [{}, {"a": 1}, {}]


# -- entities that the rules placed ---------------------------------------------------------------------------


def acts(*snapshots: tuple[int, Int64s, str]) -> Interpolation:
    interpolation = Interpolation(RATE)
    for tick, rows, placed in snapshots:
        interpolation.push(tick, rows, frozenset(ord(name) - 96 for name in placed))
    return interpolation


@pytest.mark.parametrize("far", [0.125, 1.75, 10, 1000])
def test_an_entity_that_was_placed_is_drawn_where_it_was_and_then_where_it_is(far: float) -> None:
    interpolation = acts((10, states(a=0, b=0), ""), (11, states(a=far, b=far), "a"))
    drawn = [shown(interpolation, tick) for tick in (10.0, 10.25, 10.75, 11.0, 11.75)]
    assert [picture["a"] for picture in drawn] == [0, 0, 0, far, far]
    assert [picture["b"] for picture in drawn] == [0, far / 4, far * 3 / 4, far, far]


def test_an_entity_that_was_placed_in_tick_after_tick_is_nowhere_between() -> None:
    interpolation = acts(*[(tick, states(a=tick % 3), "a") for tick in range(10, 20)])
    assert [shown(interpolation, tick / 4)["a"] for tick in range(40, 77)] == [tick // 4 % 3 for tick in range(40, 77)]


def test_an_entity_that_was_placed_while_snapshots_were_skipped_is_drawn_where_it_was_until_the_next_snapshot() -> None:
    interpolation = acts((10, states(a=0), ""), (18, states(a=4), "a"), (19, states(a=5), ""))
    assert [shown(interpolation, tick)["a"] for tick in (10.0, 14.0, 17.75, 18.0, 18.5)] == [0, 0, 0, 4, 4.5]


def test_a_thing_that_is_placed_and_changed_is_drawn_as_it_was_until_then() -> None:
    after = states(a=4)
    after[:, TEMPLATE] = 3
    interpolation = acts((10, states(a=0), ""), (11, after, "a"))
    ways = [interpolation.way(tick) for tick in (10.0, 10.5, 11.0, 11.5)]
    assert [way.before.states[0, TEMPLATE] for way in ways] == [0, 0, 3, 3]
    assert shown(interpolation, 10.5) == {"a": 0}


def test_a_placed_entity_that_was_not_there_before_and_one_that_is_gone_are_no_trouble() -> None:
    interpolation = acts((10, states(a=0), "a"), (11, states(b=1), "abc"), (12, states(), "b"))
    assert [shown(interpolation, tick) for tick in (10.5, 11.5, 12.5)] == [{"a": 0}, {"b": 1}, {}]


def test_the_history_is_bounded() -> None:
    interpolation = fed(*[(tick, states(a=tick)) for tick in range(1000)])
    assert shown(interpolation, 0.0) == {"a": 1000 - KEPT_S * RATE}


def test_the_delay_rises_at_once_by_what_was_missing() -> None:
    interpolation = fed((10, states(a=0)))
    interpolation.advance(12.0, 0.0)
    assert interpolation.delay_ticks == 2.0
    interpolation.advance(15.5, 0.125)
    assert interpolation.delay_ticks == 5.5


def test_the_delay_falls_slowly_and_only_after_a_while_of_calm() -> None:
    interpolation = fed((10, states(a=0)))
    interpolation.advance(16.0, 1.0)
    assert interpolation.delay_ticks == 6.0 <= LONG_S * RATE
    interpolation.push(100, states(a=0))
    interpolation.advance(100.0, 1.0 + CALM_S)
    assert interpolation.delay_ticks == 6.0
    interpolation.advance(100.0, 2.0 + CALM_S)
    assert interpolation.delay_ticks == 6.0 - FALL_S_PER_S * RATE


def test_a_long_delay_falls_soon_and_faster_the_longer_it_is() -> None:
    interpolation = fed((10, states(a=0)))
    interpolation.advance(50.0, 1.0)
    assert interpolation.delay_ticks == 40.0
    interpolation.push(200, states(a=0))
    interpolation.advance(50.0, 1.0 + LONG_CALM_S)
    assert interpolation.delay_ticks == 40.0
    interpolation.advance(50.0, 1.25 + LONG_CALM_S)
    assert interpolation.delay_ticks == 40.0 - 0.25 * RATE * (LONG_FALL + LONG_SHARE * (1.0 - LONG_S))


def test_a_step_of_the_servers_time_does_not_show_the_past_again() -> None:
    interpolation = fed((100, states(a=0)))
    interpolation.advance(140.0, 1.0)  # the server stood still, and its time seemed to go on
    shown_before = interpolation.shown(140.0)
    interpolation.shift(-30.0)
    assert interpolation.shown(110.0) == shown_before
    delay_ticks = interpolation.delay_ticks
    interpolation.shift(30.0)  # ahead: the view tick goes along
    assert interpolation.delay_ticks == delay_ticks


def test_the_delay_falls_no_lower_than_one_tick_and_the_history() -> None:
    interpolation = fed((10, states(a=0)))
    for second in range(4, 900):
        interpolation.advance(11.5, float(second))
    assert interpolation.delay_ticks == pytest.approx(1.5)
    interpolation.push(20, states(a=0))
    for second in range(900, 990):
        interpolation.advance(20.0, float(second))
    assert interpolation.delay_ticks == 1.0
