"""The names of a scene's buttons and their bits."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest

from shared.checks import SceneError
from shared.inputs import JUMP
from shared.scene import Scene, load_scene
from tests.worlds import scene

EIGHT = tuple("abcdefgh")


def test_jump_is_always_the_first_bit_and_the_others_follow_in_order() -> None:
    assert scene().button_bits == {"jump": JUMP} == {"jump": 1}
    assert scene(buttons=("jump", "dash", "fire")).button_bits == {"jump": 1, "dash": 2, "fire": 4}
    assert scene(buttons=["dash", "jump", "fire"]).button_bits == {"dash": 2, "jump": 1, "fire": 4}
    assert scene(buttons=("dash", "fire")).button_bits == {"dash": 2, "fire": 4}
    assert scene(buttons=()).button_bits == {}
    for names in permutations(("jump", "dash", "fire")):
        bits = scene(buttons=names).button_bits
        assert list(bits) == list(names)
        assert bits["jump"] == JUMP
        assert [bits[name] for name in names if name != "jump"] == [2, 4]


def test_there_is_room_for_eight_with_jump_and_for_seven_without() -> None:
    full = scene(buttons=("jump", *EIGHT[:7]))
    assert sorted(full.button_bits.values()) == [1 << k for k in range(8)]
    assert max(scene(buttons=EIGHT[:7]).button_bits.values()) == 128
    with pytest.raises(SceneError, match=r"^buttons: 8 of them; must be at most 7 besides 'jump'"):
        scene(buttons=EIGHT)
    with pytest.raises(SceneError, match=r"^buttons: 9 of them; must be at most 8"):
        scene(buttons=("jump", *EIGHT))


@pytest.mark.parametrize(
    "wrong",
    ["jump", None, 5, {"jump": 1}, ("jump", "jump"), ("",), ("x" * 33,), (5,), (None,), ("a\ud800",), b"ab"],
)
def test_wrong_buttons_of_a_scene_are_named(wrong: Any) -> None:
    with pytest.raises(SceneError, match=r"^buttons\b"):
        scene(buttons=wrong)


@pytest.mark.parametrize("wrong", [1, 0, "yes", None])
def test_aim_is_a_truth_value(wrong: Any) -> None:
    with pytest.raises(SceneError, match=r"^aim = "):
        scene(aim=wrong)


def test_an_unknown_button_is_named_with_the_known_ones() -> None:
    made = scene(buttons=("jump", "dash"))
    for wrong in ("fire", "Jump", "", 5, None, ["jump"]):
        with pytest.raises(SceneError, match=r"^button = .*: no such button \(there are jump, dash\)"):
            made.button(wrong)
    with pytest.raises(SceneError, match=r"there are none"):
        scene(buttons=()).button("jump")


def test_bits_of_several_buttons() -> None:
    made = scene(buttons=("jump", "dash", "fire"))
    assert made.buttons_bits(()) == 0
    assert made.buttons_bits("dash") == 2
    assert made.buttons_bits(["fire", "jump", "fire"]) == 5
    assert made.buttons_bits({"fire", "dash"}) == 6
    assert made.buttons_bits({"fire": True, "dash": False, "jump": np.True_}) == 5
    assert made.buttons_bits({"fire": 1, "dash": 0}) == 4
    for wrong in (5, None, b"dash", ("dash", 5), {"dash": "no"}, {"dash": None}, {5: True}):
        with pytest.raises(SceneError, match=r"^buttons"):
            made.buttons_bits(wrong)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match=r"^button = 'tash'"):
        made.buttons_bits({"tash": False, "nash": True, "dash": True} | {"tash": True})


def test_a_scene_without_them_is_what_it_was() -> None:
    """Fingerprint and fields of a scene from before there were buttons and aim."""
    flat = load_scene("flat")
    assert flat.fingerprint.hex() == "9ba51f35d51362c3682bd0c1c841e9c8"
    assert {"buttons", "aim"}.isdisjoint(flat.to_table())
    assert {"buttons", "aim"}.isdisjoint(flat.digests)
    assert scene(buttons=["jump"], aim=False).fingerprint == scene().fingerprint


def test_they_survive_a_round_trip_and_are_part_of_the_fingerprint() -> None:
    made = scene(buttons=("dash", "jump"), aim=True)
    again = Scene.from_table(made.to_table())
    assert again == made
    assert again.buttons == ("dash", "jump")
    assert again.aim is True
    others = (scene(), scene(buttons=("jump", "dash"), aim=True), scene(buttons=("dash", "jump")), scene(aim=np.True_))
    assert len({made.fingerprint, *(other.fingerprint for other in others)}) == 5
