"""A correction is hidden for a moment only."""

import pytest

from client_sdk.interpolation.smoothing import HALF_LIFE_S, TELEPORT_BLOCKS, Smoothing


def test_without_a_correction_there_is_no_offset() -> None:
    assert Smoothing().offset(12345.0) == (0.0, 0.0, 0.0)


def test_at_first_the_thing_is_shown_where_it_was() -> None:
    smoothing = Smoothing()
    smoothing.add((1.0, -0.5, 0.25), 7.0)
    assert smoothing.offset(7.0) == (1.0, -0.5, 0.25)


def test_the_offset_halves_with_every_half_life_however_often_it_is_looked_at() -> None:
    often, once = Smoothing(), Smoothing()
    for each in (often, once):
        each.add((1.0, 0.0, -2.0), 0.0)
    for step in range(1, 33):
        often.offset(step * HALF_LIFE_S / 16)
    assert often.offset(2 * HALF_LIFE_S) == once.offset(2 * HALF_LIFE_S) == (0.25, 0.0, -0.5)
    assert max(map(abs, once.offset(20 * HALF_LIFE_S))) < 1e-5


def test_a_second_correction_adds_to_what_is_left_of_the_first() -> None:
    smoothing = Smoothing()
    smoothing.add((2.0, 0.0, 0.0), 0.0)
    smoothing.add((0.0, 1.0, 0.0), HALF_LIFE_S)
    assert smoothing.offset(HALF_LIFE_S) == (1.0, 1.0, 0.0)
    assert smoothing.offset(2 * HALF_LIFE_S) == (0.5, 0.5, 0.0)


@pytest.mark.parametrize(("blocks", "hidden"), [(TELEPORT_BLOCKS, True), (TELEPORT_BLOCKS + 2**-20, False)])
def test_a_long_way_is_shown_as_the_jump_it_is(blocks: float, hidden: bool) -> None:
    smoothing = Smoothing()
    smoothing.add((0.0, blocks, 0.0), 0.0)
    assert smoothing.offset(0.0) == ((0.0, blocks, 0.0) if hidden else (0.0, 0.0, 0.0))


def test_corrections_that_add_up_to_a_long_way_are_a_jump_too() -> None:
    smoothing = Smoothing()
    smoothing.add((3.0, 0.0, 0.0), 0.0)
    smoothing.add((3.0, 0.0, 0.0), 0.0)
    assert smoothing.offset(0.0) == (0.0, 0.0, 0.0)


def test_a_clock_that_stands_or_goes_back_does_not_make_it_grow() -> None:
    smoothing = Smoothing()
    smoothing.add((1.0, 0.0, 0.0), 5.0)
    assert smoothing.offset(4.0) == smoothing.offset(5.0) == (1.0, 0.0, 0.0)
