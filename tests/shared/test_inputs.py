"""One exact rule for the length of a direction, on both sides."""

import math

import pytest

from shared.inputs import JUMP, MOVE_MAX, NEUTRAL, Input, clamp, make_input, row

BYTES = range(-128, 128)


def test_no_direction_is_to_stand_still() -> None:
    assert Input(0, 0, 0) == NEUTRAL == make_input()


def test_every_clamped_direction_is_at_most_full_speed() -> None:
    for x in BYTES:
        for y in range(-128, 128, 5):
            short = clamp(Input(x, y, 3))
            assert short.move_x**2 + short.move_y**2 <= MOVE_MAX**2
            assert short.buttons == 3
            if x * x + y * y <= MOVE_MAX**2:
                assert short == Input(x, y, 3)


def test_a_row_holds_signed_moves_and_the_buttons() -> None:
    assert row(Input(-1, 127, 255)) == b"\xff\x7f\xff"
    assert row(NEUTRAL) == bytes(3)


def test_clamping_twice_is_clamping_once() -> None:
    for x in BYTES:
        for y in (-128, -91, -90, -1, 0, 60, 127):
            once = clamp(Input(x, y))
            assert clamp(once) == once


def test_a_long_direction_keeps_its_angle_and_is_as_long_as_whole_numbers_allow() -> None:
    for x in BYTES:
        for y in range(-128, 128, 7):
            square = x * x + y * y
            if square <= MOVE_MAX**2:
                continue
            for long, short in zip((x, y), clamp(Input(x, y))[:2], strict=True):
                # |short| = floor(127 |long| / length), by squares so that nothing is rounded
                assert short * long >= 0
                assert short * short * square <= (MOVE_MAX * long) ** 2 < (abs(short) + 1) ** 2 * square


def test_mirrored_directions_stay_mirrored() -> None:
    for x in range(129):
        for y in range(0, 129, 3):
            short = clamp(Input(x, y))
            assert clamp(Input(-x, y)) == Input(-short.move_x, short.move_y)
            assert clamp(Input(y, x)) == Input(short.move_y, short.move_x)


@pytest.mark.parametrize(
    ("direction", "move"),
    [
        ((1, 0), (127, 0)),
        ((0, -1), (0, -127)),
        ((1, 1), (89, 89)),
        ((-1, 1), (-89, 89)),
        ((0.5, 0), (64, 0)),
        ((-0.5, 0), (-64, 0)),
        ((5, 0), (127, 0)),
        ((1e9, -1e9), (89, -89)),
        ((0.0039, 0), (0, 0)),
        ((0.6, 0.8), (75, 101)),
    ],
)
def test_directions_are_rounded_once_and_shortened(direction: tuple[float, float], move: tuple[int, int]) -> None:
    assert make_input(*direction)[:2] == move


def test_buttons_are_kept_and_jump_is_one_of_them() -> None:
    assert make_input(jump=True) == Input(0, 0, JUMP)
    assert make_input(jump=True, buttons=6).buttons == 6 | JUMP
    assert make_input(buttons=6).buttons == 6


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e300])
def test_a_direction_that_is_not_finite_is_refused(wrong: float) -> None:
    for direction in ((wrong, 0.0), (0.0, wrong)):
        with pytest.raises(ValueError, match="must be finite"):
            make_input(*direction)
