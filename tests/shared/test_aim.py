"""Aim: one rule for its length, in whole numbers, and one for the directions that programs give."""

import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.aim import AIM_MAX, AIM_PART_MAX, NO_AIM, Aim, checked_aim, direction, make_aim, normalised
from shared.checks import SceneError
from shared.inputs import AIM_ROW, Input, clamp, make_input, row, unpacked
from tests.lengths import examples
from tests.worlds import build

PARTS = st.one_of(
    st.integers(-AIM_PART_MAX, AIM_PART_MAX),
    st.integers(-(1 << 15), (1 << 15) - 1),
    st.integers(-3, 3),
    st.sampled_from([-AIM_PART_MAX, -32768, -AIM_MAX, AIM_MAX, AIM_PART_MAX]),
)
AIMS = st.tuples(PARTS, PARTS, PARTS)


def square(aim: Aim) -> int:
    return sum(part * part for part in aim)


@settings(max_examples=examples(300), deadline=None)
@given(AIMS)
def test_an_aim_has_its_length_and_keeps_it(aim: Aim) -> None:
    once = normalised(aim)
    assert normalised(once) == once
    assert all(-AIM_MAX <= part <= AIM_MAX for part in once), "it fits into its record"
    if aim == NO_AIM:
        assert once == NO_AIM
    else:
        assert (AIM_MAX - 2) ** 2 <= square(once) <= AIM_MAX**2


@settings(max_examples=examples(300), deadline=None)
@given(AIMS)
def test_an_aim_keeps_its_direction(aim: Aim) -> None:
    """Expects parts that are rounded down to a whole number, or unchanged if the length was right."""
    once, length = normalised(aim), square(aim)
    for part, short in zip(aim, once, strict=True):
        assert short * part >= 0
        if once != aim:
            assert short * short * length <= (AIM_MAX * part) ** 2 < (abs(short) + 1) ** 2 * length


@settings(max_examples=examples(200), deadline=None)
@given(AIMS, st.permutations(range(3)), st.tuples(*[st.sampled_from([1, -1])] * 3))
def test_mirrored_and_turned_aims_stay_so(aim: Aim, order: list[int], signs: tuple[int, ...]) -> None:
    def turned(parts: Aim) -> tuple[int, ...]:
        return tuple(sign * parts[k] for sign, k in zip(signs, order, strict=True))

    x, y, z = turned(aim)
    assert normalised((x, y, z)) == turned(normalised(aim))


def test_every_record_of_a_cheat_becomes_an_aim_of_the_right_length() -> None:
    rng = random.Random(1)
    for _ in range(2000):
        aim = unpacked(rng.randbytes(AIM_ROW.size)).aim
        assert square(clamp(Input(0, 0, 0, aim)).aim) <= AIM_MAX**2
    assert clamp(unpacked(AIM_ROW.pack(127, 0, 0, -32768, -32768, -32768))).aim == (-18918,) * 3


@pytest.mark.parametrize(
    ("given", "aim"),
    [
        ((1, 0, 0), (32767, 0, 0)),
        ((0.0, 0.0, -0.001), (0, 0, -32767)),
        ((1, 1, 0), (23169, 23169, 0)),
        ((0.1, -0.1, 0), (23169, -23169, 0)),
        ([3, 0, 4.0], (19660, 0, 26213)),
        (np.array([0, 5e-324, 0]), (0, 32767, 0)),
        ((1e308, 1e308, 1e308), (18918, 18918, 18918)),
        ((10**300, 0, 1), (32767, 0, 0)),
        ((0, 0, 0), NO_AIM),
        ((0.0, -0.0, 0.0), NO_AIM),
    ],
)
def test_directions_of_programs(given: Any, aim: Aim) -> None:
    assert make_aim(given) == aim == make_input(aim=given).aim
    assert all(type(part) is int for part in make_aim(given))


def test_an_aim_passed_on_is_the_same() -> None:
    rng = random.Random(2)
    for _ in range(500):
        aim = make_aim([rng.uniform(-1, 1) for _ in range(3)])
        assert make_aim(aim) == aim
        assert checked_aim(aim, "aim") == aim
        seen = direction(aim)
        assert seen is not None
        assert math.isclose(math.hypot(*seen), 1.0)
    assert direction(NO_AIM) is None


@pytest.mark.parametrize("wrong", [5, "abc", (1, 2), (1, 2, 3, 4), (1, 2, math.nan), (math.inf, 0, 0), (True, 0, 0)])
def test_a_wrong_direction_is_named(wrong: Any) -> None:
    with pytest.raises(SceneError, match=r"^aim"):
        make_input(aim=wrong)


@pytest.mark.parametrize("wrong", [5, None, [0, 0, 1], (1, 2), (0.5, 0, 0), (1 << 32, 0, 0), (True, 0, 0), ("1", 0, 0)])
def test_a_wrong_aim_of_an_input_is_named_and_nothing_is_done(wrong: Any) -> None:
    world = build([[-8, -8, -1, 8, 8, 0, 1]], aim=True)
    entity = world.spawn("box", (0.0, 0.0, 0.0))
    before = world.tick, world.state_hash()
    with pytest.raises(SceneError, match=rf"^inputs\[{entity}\]\.aim"):
        world.step({entity: Input(0, 0, 0, wrong)})
    assert (world.tick, world.state_hash()) == before


def test_rows_have_an_aim_where_the_scene_asks_for_it() -> None:
    input_ = Input(-1, 127, 255, (-32767, 0, 5))
    assert row(input_) == b"\xff\x7f\xff"
    assert row(input_, aim=True) == b"\xff\x7f\xff\x01\x80\x00\x00\x05\x00"
    assert unpacked(row(input_, aim=True)) == input_
    assert unpacked(row(input_)) == (*input_[:3], NO_AIM)


def test_a_world_keeps_the_aim_with_its_length() -> None:
    world = build([[-8, -8, -1, 8, 8, 0, 1]], aim=True)
    entity = world.spawn("box", (0.0, 0.0, 0.0))
    for aim in ((1, 0, 0), (-AIM_PART_MAX, AIM_PART_MAX, 7), (0, 0, 0), (3, -4, 0), make_aim((1, 2, 3))):
        world.step({entity: Input(0, 0, 0, aim)})
        assert world.state(entity)[12:15] == normalised(aim)
    plain: Any = (1, 2, 3)
    world.step({entity: plain})
    assert world.state(entity)[9:15] == (1, 2, 3, *NO_AIM)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_world_steps_with_and_without_an_aim(compiled: bool) -> None:
    plain = build([[-8, -8, -1, 8, 8, 0, 1]], compiled=compiled)
    aims = build([[-8, -8, -1, 8, 8, 0, 1]], compiled=compiled, aim=True)
    a, b = plain.spawn("box", (0.0, 0.0, 0.0)), aims.spawn("box", (0.0, 0.0, 0.0))
    for tick in range(20):
        short: Any = (127, -5, tick % 2)
        plain.step({a: short if tick % 3 else Input(*short)})
        aims.step({b: Input(127, -5, tick % 2, make_aim((1, tick, 2)) if tick % 4 else NO_AIM)})
    assert aims.position(b) == plain.position(a)
    before = plain.tick
    with pytest.raises(SceneError, match=r"inputs\[1\]\.aim = \(0, 0, 32767\): the scene 'test' has no aim"):
        plain.step({a: make_input(aim=(0, 0, 1))})
    assert plain.tick == before
