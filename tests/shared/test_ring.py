"""A ring forgets values by tick only."""

from hypothesis import given
from hypothesis import strategies as st

from shared.ring import Ring


def test_an_empty_ring_has_nothing() -> None:
    ring: Ring[int] = Ring(4)
    assert [ring.get(tick) for tick in range(-8, 8)] == [None] * 16


def test_a_value_is_kept_until_its_place_is_taken() -> None:
    ring: Ring[str] = Ring(4)
    for tick in range(4):
        ring.put(tick, str(tick))
    assert [ring.get(tick) for tick in range(4)] == ["0", "1", "2", "3"]
    ring.put(4, "4")
    assert [ring.get(tick) for tick in range(5)] == [None, "1", "2", "3", "4"]


def test_a_tick_that_was_left_out_has_no_value_of_an_older_one() -> None:
    ring: Ring[int] = Ring(4)
    ring.put(1, 1)
    assert ring.get(5) is None
    assert ring.get(-3) is None


def test_a_later_value_of_the_same_tick_replaces_the_first() -> None:
    ring: Ring[int] = Ring(2)
    ring.put(7, 1)
    ring.put(7, 2)
    assert ring.get(7) == 2


def test_a_false_value_is_a_value() -> None:
    ring: Ring[int] = Ring(2)
    ring.put(0, 0)
    assert ring.get(0) == 0


@given(st.integers(1, 9), st.lists(st.integers(-30, 30)))
def test_it_holds_what_was_put_last_in_each_place(size: int, ticks: list[int]) -> None:
    ring: Ring[int] = Ring(size)
    places: dict[int, tuple[int, int]] = {}
    for number, tick in enumerate(ticks):
        ring.put(tick, number)
        places[tick % size] = (tick, number)
    for tick in range(-31, 32):
        held = places.get(tick % size)
        assert ring.get(tick) == (held[1] if held and held[0] == tick else None)
