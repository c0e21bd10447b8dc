"""Every value of a scene that no world can hold is refused, and the message names its field."""

import math
from typing import Any

import pytest

from client_sdk.events import Joined
from shared.checks import SceneError, vector
from shared.inputs import MOVE_MAX, Input, clamp, make_input
from shared.scene import SCENES, Scene, Template, load_scene
from shared.terrain import generate
from shared.units import BLOCK, RANGE_BLOCKS, SPEED, SPEED_MAX, rounded, to_position, to_velocity
from tests.worlds import TEMPLATES, scene

NO_NUMBERS = (math.nan, math.inf, -math.inf, 10**400, "3", None, True)


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("name", ("", "x" * 65, 3, None)),
        ("tick_rate", (0, -1, 241, 32.0, True, math.nan)),
        ("gravity", (*NO_NUMBERS, -1, 1e300, 5e-324, 1e-9)),
        ("terminal_speed", (*NO_NUMBERS, -1, 0, 1e300, 1024.5, 5e-324)),
        ("integrator", ("explicit", "", None, 1)),
        ("entity_collision", (1, "yes", None)),
        ("reach", (-0.1, 1025.0, float("nan"), "6", None, True)),
        ("size", ((0, 1, 1), (1, 1), (1.0, 1, 1), "abc", (1, 1, 1 << 17), (1 << 9, 1 << 9, 1))),
        ("origin", ((1 << 24, 0, 0), (0, -(1 << 24), 0), ((1 << 23) - 1, 0, 0), (0.5, 0, 0), None)),
        ("terrain", ({}, {"generator": 3}, "flat", None)),
        ("spawns", ((), "ab", None, ((0, 0),), ((0, 0, math.nan),), ((0, 1e300, 0),), ((10**400, 0, 0),))),
        ("templates", ((), TEMPLATES * 2, tuple(Template(f"t{i}") for i in range(256)))),
        ("player", ("nobody", None)),
    ],
)
def test_a_field_of_a_scene(field: str, values: tuple[Any, ...]) -> None:
    for value in values:
        with pytest.raises(SceneError, match=rf"^{field}\b"):
            scene(**{field: value})


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("field", ["box_offset", "box_size"])
def test_a_box_of_a_template(field: str, axis: int) -> None:
    for value in (*NO_NUMBERS, 1e300, 33.0, -33.0):
        sides: list[object] = [1.0, 1.0, 1.0]
        sides[axis] = value
        with pytest.raises(SceneError, match=rf"^templates\.odd\.box.*{'xyz'[axis]}\b"):
            Template("odd", **{field: tuple(sides)})  # type: ignore[arg-type]
    for shape in ((1, 1), (1, 1, 1, 1), 5, None):
        with pytest.raises(SceneError, match=rf"^templates\.odd\.{field}"):
            Template("odd", **{field: shape})  # type: ignore[arg-type]


@pytest.mark.parametrize("field", ["walk_speed", "jump_speed"])
def test_a_speed_of_a_template(field: str) -> None:
    for value in (*NO_NUMBERS, -1, 1024.1, 1e300):
        with pytest.raises(SceneError, match=rf"^templates\.odd\.{field} = "):
            Template("odd", **{field: value})  # type: ignore[arg-type]
    assert Template("fast", walk_speed=1024, jump_speed=1024.0).row()[8] == 1024 * SPEED


def test_unknown_and_missing_fields() -> None:
    for table, match in (
        ({"name": "x", "gravitation": 3}, r"^gravitation: no such field"),
        ({}, r"^name: missing"),
        ({"name": "x", "templates": [{"name": "player", "mass": 3}]}, r"^templates\.mass: no such field"),
        ({"name": "x", "templates": [{}]}, r"^templates\.name: missing"),
        ({"name": "x", "templates": [3]}, r"^templates: 3 must be a table"),
        ({"name": "x", "templates": 3}, r"^templates = 3"),
        ({"name": "x", "templates": [{"name": ""}]}, r"^templates\.name"),
        ({"name": "x", "templates": [{"name": "player", "solid": 1}]}, r"^templates\.player\.solid"),
    ):
        with pytest.raises(SceneError, match=match):
            Scene.from_table(table)


def test_files(tmp_path: Any) -> None:
    with pytest.raises(SceneError, match="built in are arena, flat, hills, meadow, topdown"):
        load_scene("nowhere")
    broken = tmp_path / "broken.toml"
    broken.write_text("gravity = = 3")
    with pytest.raises(SceneError, match="not valid TOML"):
        load_scene(str(broken))
    broken.write_text("gravity = nan")
    with pytest.raises(SceneError, match=r"broken\.toml: gravity = nan: must be finite"):
        load_scene(str(broken))
    broken.write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene(str(broken))


@pytest.mark.parametrize(
    "terrain",
    [
        {"generator": "caves"},
        {"generator": "flat", "hight": 3},
        {"generator": "boxes"},
        {"generator": "boxes", "fill": [[0, 0, 0, 1, 1, 1]]},
        {"generator": "boxes", "fill": [[0, 0, 0, 1, 1, 1.0, 1]]},
        {"generator": "boxes", "fill": [[0, 0, 0, 1, 1, 1, 256]]},
        {"generator": "hills", "scale": 0},
        {"generator": "hills", "seed": 1.5},
        {"generator": "flat", "height": math.nan},
        {"generator": "flat", "height": 1 << 40},
    ],
)
def test_terrain_that_cannot_be_made(terrain: dict[str, Any]) -> None:
    with pytest.raises(SceneError, match=r"^terrain"):
        generate(scene(terrain=terrain).terrain, (0, 0, 0))


@pytest.mark.parametrize("name", sorted(file.stem for file in SCENES.glob("*.toml")))
def test_built_in_scenes_survive_a_round_trip(name: str) -> None:
    original = load_scene(name)
    again = Scene.from_table(original.to_table())
    assert again == original
    assert again.fingerprint == original.fingerprint
    changed = Scene.from_table(original.to_table() | {"terminal_speed": 15})
    assert changed.fingerprint != original.fingerprint


def test_a_fingerprint_does_not_depend_on_how_a_number_is_written() -> None:
    assert scene(gravity=16).fingerprint == scene(gravity=16.0).fingerprint
    assert scene(size=[2, 2, 2]).fingerprint == scene(size=(2, 2, 2)).fingerprint


def test_rounding_is_away_from_zero_at_halves() -> None:
    assert [rounded(v) for v in (0.5, -0.5, 1.5, -1.5, 2.49, -2.49, 0.49999999999999994, -0.0, 5e-324)] == [
        1, -1, 2, -2, 2, -2, 0, 0, 0,
    ]  # fmt: skip
    assert to_position(-0.3, "x") == -to_position(0.3, "x") == -round(0.3 * BLOCK)
    assert to_velocity(1024, "v") == 1024 * SPEED


@pytest.mark.parametrize(
    ("x", "y"), [(127, 127), (-127, 127), (1000, 1), (127, 1), (89, 91), (10**9, -(10**9)), (0, 200)]
)
def test_a_direction_is_shortened_to_a_length_of_127(x: int, y: int) -> None:
    """The result is never longer, and shorter by less than one in each part; it is symmetric in all four quadrants."""
    short = clamp(Input(x, y, 5))
    assert short.buttons == 5
    assert short.move_x**2 + short.move_y**2 <= MOVE_MAX**2
    assert (abs(short.move_x) + 1) ** 2 + (abs(short.move_y) + 1) ** 2 > MOVE_MAX**2
    assert clamp(Input(-x, -y, 5)) == Input(-short.move_x, -short.move_y, 5)
    assert clamp(short) == short


def test_a_direction_within_the_range_is_left_alone() -> None:
    for input_ in (Input(127, 0), Input(-3, 4, 1), Input(89, 90), Input()):
        assert clamp(input_) == input_
    assert make_input(1, 1) == clamp(Input(127, 127))
    assert make_input(0.5, -0.5, jump=True, buttons=2) == Input(64, -64, 3)


def test_an_event_that_is_printed_does_not_show_the_whole_scene() -> None:
    assert repr(Joined(1, load_scene("meadow"), 7)) == (
        "Joined(entity=1, scene=<Scene 'meadow', 64 x 64 x 32 blocks, 32 ticks/s>, tick=7)"
    )


def test_a_vector_of_floats_is_checked_like_any_other() -> None:
    """The short cut for a tuple of floats accepts and refuses the same values as the check of any other sequence."""
    huge = (1e308, 1e308, 1e308)
    assert vector(huge, "at") == vector(list(huge), "at") == huge
    assert vector((1, 2.5, 3), "at") == (1.0, 2.5, 3.0)
    for bad in (math.nan, math.inf, -math.inf, "1", True, None):
        for axis in range(3):
            parts: list[object] = [0.5, 1.5, 2.5]
            parts[axis] = bad
            said = []
            for value in (parts, tuple(parts)):
                with pytest.raises(SceneError) as error:
                    vector(value, "at")
                said.append(str(error.value))
            assert said[0] == said[1]
            assert said[0].startswith(f"at.{'xyz'[axis]} = ")
    for convert, most in ((to_position, RANGE_BLOCKS), (to_velocity, SPEED_MAX)):
        assert [convert(most, "x"), convert(-most, "x")] == [convert(float(most), "x"), convert(-float(most), "x")]
        for number in (math.nan, math.inf, -math.inf, math.nextafter(most, math.inf), -math.nextafter(most, math.inf)):
            with pytest.raises(SceneError, match=r"^x = "):
                convert(number, "x")
