"""A short press counts in exactly one input; a held button counts while it is held."""

import random

import pytest

from client_sdk.controls import Controls
from shared.inputs import NEUTRAL, Input, make_input
from shared.scene import load_scene

JUMP, OTHER = Input(5, 7, 1), Input(0, 0, 2)


def filled(*wishes: Input) -> Controls:
    controls = Controls()
    for input_ in wishes:
        controls.set(input_)
    return controls


def test_a_press_that_is_over_counts_once() -> None:
    controls = filled(JUMP, NEUTRAL)
    assert [controls.take() for _ in range(3)] == [Input(0, 0, 1), NEUTRAL, NEUTRAL]


def test_the_direction_is_the_newest_one() -> None:
    assert filled(JUMP, Input(-9, 3, 0)).take() == Input(-9, 3, 1)


def test_what_is_held_counts_until_it_is_released() -> None:
    controls = filled(JUMP)
    assert [controls.take() for _ in range(3)] == [JUMP] * 3
    controls.set(JUMP)
    controls.set(NEUTRAL)
    assert controls.take() == NEUTRAL, "it was down in the tick before, and is up now"


def test_a_release_and_a_press_between_two_ticks_are_a_press() -> None:
    controls = filled(JUMP)
    controls.take()
    for input_ in (NEUTRAL, JUMP, NEUTRAL):
        controls.set(input_)
    assert [controls.take().buttons for _ in range(2)] == [1, 0]


def test_each_button_is_one_of_its_own() -> None:
    controls = filled(JUMP, OTHER, NEUTRAL)
    assert [controls.take().buttons for _ in range(2)] == [3, 0]


def aimed(*wishes: Input) -> Controls:
    controls, scene = Controls(), load_scene("flat").with_buttons("fire", "dash", aim=True)
    for input_ in wishes:
        controls.set(input_, scene=scene)
    return controls


FIRE = make_input(0, 0, buttons=2, aim=(1, 0, 0))


@pytest.mark.parametrize("after", [NEUTRAL, make_input(aim=(0, 1, 0))])
def test_a_press_that_is_over_keeps_its_aim_for_one_tick(after: Input) -> None:
    controls = aimed(FIRE, after)
    assert [controls.take() for _ in range(2)] == [FIRE, after]


def test_a_button_that_is_held_has_the_newest_aim() -> None:
    turned = FIRE._replace(aim=make_input(aim=(0, 1, 0)).aim)
    assert aimed(FIRE, turned).take() == turned


def test_a_press_without_an_aim_has_the_newest_aim() -> None:
    after = make_input(aim=(0, 1, 0))
    assert aimed(FIRE._replace(aim=NEUTRAL.aim), after).take() == after._replace(buttons=2)


def test_an_aim_does_not_outlive_the_tick_of_its_press() -> None:
    controls = aimed(FIRE)
    controls.take()
    controls.set(make_input(buttons=4), scene=load_scene("flat").with_buttons("fire", "dash", aim=True))
    controls.set(NEUTRAL)
    assert controls.take() == make_input(buttons=4)


@pytest.mark.parametrize("bit", [1 << place for place in range(8)])
@pytest.mark.parametrize("others", [0, 0b10100101])
def test_a_press_of_any_button_counts_once(bit: int, others: int) -> None:
    held = others & ~bit
    controls = filled(Input(0, 0, held))
    controls.take()
    controls.set(Input(0, 0, held | bit))
    controls.set(Input(0, 0, held))
    assert [controls.take().buttons for _ in range(2)] == [held | bit, held]


def test_the_aim_is_the_newest_one() -> None:
    first, second = make_input(buttons=2, aim=(1, 0, 0)), make_input(aim=(0, 1, 0))
    controls = filled(first, second)
    assert controls.take() == second._replace(buttons=2)
    assert controls.take() == second


def test_a_press_is_forgotten_with_its_tick_and_what_is_held_is_not() -> None:
    controls = filled(JUMP, OTHER)
    controls.forget()
    assert [controls.take() for _ in range(2)] == [OTHER, OTHER]


def test_any_sequence_is_that_of_the_definition() -> None:
    rng, controls = random.Random(1), Controls()
    before, pressed = 0, 0
    for _ in range(5000):
        if rng.random() < 0.3:
            assert controls.take().buttons == before | pressed
            pressed = 0
        else:
            buttons = rng.randrange(256)
            controls.set(Input(0, 0, buttons))
            pressed |= buttons & ~before
            before = buttons
