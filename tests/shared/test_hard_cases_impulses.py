"""Hard cases of acceleration, friction, air control and gravity per template. Numbers are exact; no tolerance."""

import itertools
import math
import random
from typing import Any

import pytest

from shared import kernel, layout
from shared.checks import SceneError
from shared.inputs import NEUTRAL, Input
from shared.scene import SCENES, Scene, Template, load_scene
from shared.units import BLOCK, SPEED, SPEED_MAX
from shared.world import World
from tests.worlds import EAST, NORTH, TEMPLATES, WEST, build, floor, high, settle, steps

BOX: dict[str, Any] = {"box_offset": (0, 0, 0), "box_size": (5 / 8, 5 / 8, 7 / 4)}
PLAYER = Template("slow", **BOX, walk_speed=3, jump_speed=8, acceleration=16, friction=8)


def world_of(*templates: Template, compiled: bool, fill: Any = None, **changes: Any) -> World:
    """A world of the hard cases with further templates, on a floor."""
    fill = [floor()] if fill is None else fill
    return build(fill, compiled=compiled, templates=(*TEMPLATES, *templates), **changes)


def with_options(**options: Any) -> Template:
    return Template("slow", **(BOX | {"walk_speed": 3.0, "jump_speed": 8.0} | options))


def test_speeds_up_and_slows_down_by_equal_steps_and_ends_exactly(compiled: bool) -> None:
    world = world_of(PLAYER, compiled=compiled)
    me = world.spawn("slow", (0, 0, 0))
    world.step({me: EAST})
    for tick in range(1, 13):
        assert world.velocity(me) == (tick / 4, 0, 0)
        world.step()
    for _ in range(50):
        assert world.velocity(me) == (3, 0, 0)
        world.step()
    x = world.position(me)[0]
    world.step({me: NEUTRAL})
    for tick in range(1, 25):
        assert world.velocity(me) == (3 - tick / 8, 0, 0)
        world.step()
    assert world.velocity(me) == (0, 0, 0)
    assert world.position(me)[0] - x == sum(3 - tick / 8 for tick in range(1, 25)) / 64
    assert not world.awake(me)


@pytest.mark.parametrize("integrator", ["mean", "semi"])
@pytest.mark.parametrize("tick_rate", [1, 7, 20, 30, 32, 60, 64, 128, 240])
def test_every_tick_rate_stops_at_zero_and_sleeps(tick_rate: int, integrator: str, compiled: bool) -> None:
    world = world_of(
        with_options(acceleration=6, friction=6), Template("crate", (0, 0, 0), (1, 1, 1), friction=6),
        compiled=compiled, tick_rate=tick_rate, integrator=integrator, fill=[floor(0, 32)],
    )  # fmt: skip
    me, crate = world.spawn("slow", (0, 0, 0)), world.spawn("crate", (-20, 5, 0), (3, 0, 0))
    # At this gravity, entities at rest lie on the floor at once.
    steps(world, math.ceil(tick_rate / 2) + 1, {me: EAST})
    assert world.velocity(me) == (3, 0, 0)
    assert world.velocity(crate) == (0, 0, 0)
    steps(world, math.ceil(tick_rate / 2) + 1, {me: NEUTRAL})
    assert world.velocity(me) == (0, 0, 0)
    assert settle(world, 2) <= 1


def test_four_quadrants_are_mirrors_of_each_other(compiled: bool) -> None:
    """Inputs, pushes and turns in mid-air; the boxes have their positions in the middle."""
    rng = random.Random(3)
    script = [
        (rng.randint(-127, 127), rng.randint(-127, 127), rng.uniform(-20, 20), rng.uniform(-9, 9)) for _ in range(40)
    ]
    ends = []
    for east, north, turned in itertools.product((1, -1), (1, -1), (False, True)):
        middle = Template(
            "slow", (-0.25, -0.25, 0), (0.5, 0.5, 1), walk_speed=3.3, jump_speed=8,
            acceleration=13.7, friction=5.1, air_control=0.3,
        )  # fmt: skip
        world = world_of(middle, compiled=compiled)
        me = world.spawn("slow", (0, 0, 0))
        for x, y, push_x, push_y in script:
            move, push = (x * east, y * north), (push_x * east, push_y * north)
            if turned:
                move, push = move[::-1], push[::-1]
            world.add_velocity(me, (*push, 4))
            steps(world, 9, {me: Input(*move, 1)})
            world.place(me, (0, 0, world.position(me)[2]))
            steps(world, 3)
        state = list(world.state(me))
        for at in (3, 6, 9):
            state[at], state[at + 1] = (state[at + 1], state[at]) if turned else (state[at], state[at + 1])
            state[at] *= east
            state[at + 1] *= north
        ends.append(state)
    assert ends == [ends[0]] * 8


@pytest.mark.parametrize("seed", range(4))
def test_no_step_passes_the_wish_or_gains_energy(seed: int) -> None:
    """The arithmetic alone, from one step to the fastest: monotone, never past the wish, and at the wish in the end."""
    rng = random.Random(seed)
    top = round(SPEED_MAX * SPEED)
    for _ in range(2000):
        size = rng.choice((1, 3, 50, 7000, SPEED, top))
        v = [rng.randint(-size, size) for _ in range(2)]
        wish = [0, 0] if rng.random() < 0.4 else [rng.randint(-size, size) for _ in range(2)]
        away = kernel.length(wish[0] - v[0], wish[1] - v[1])
        assert away == math.isqrt((wish[0] - v[0]) ** 2 + (wish[1] - v[1]) ** 2)
        rate = max(1, rng.choice((1, 2, size // 60, size // 7, 2 * size)))
        new = [kernel.toward(a, b, rate, away) for a, b in zip(v, wish, strict=True)]
        for a, b, c in zip(v, new, wish, strict=True):
            assert min(a, c) <= b <= max(a, c)
        assert (new == wish) == (away <= rate or math.dist(new, wish) == 0)
        assert new != v or v == wish
        assert math.hypot(*new) <= max(math.hypot(*v), math.hypot(*wish)) + 1
        if away > rate:
            assert abs(math.dist(v, new) - rate) < 2
    for size in (0, 1, 2, (1 << 30) + (1 << 26)):
        assert kernel.length(size, -size) == math.isqrt(2 * size * size)


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1)])
def test_the_fastest_push_decays_by_friction_to_the_bit(way: tuple[int, int], compiled: bool) -> None:
    """A push of 1024 blocks/s in free air: its speed falls in every tick, along its line, and ends at 0."""
    flier = with_options(friction=4096, acceleration=16, gravity=0)
    world = world_of(flier, compiled=compiled, fill=[], size=(2, 2, 1))
    me = world.spawn("slow", (0, 0, -8))
    world.add_velocity(me, (1024 * way[0], 1024 * way[1], 0))
    world.add_velocity(me, (1024 * way[0], 1024 * way[1], 0))
    assert world.velocity(me)[:2] == (1024 * way[0], 1024 * way[1]), "each part of the sum is limited"
    before = math.inf
    for _ in range(40):
        world.place(me, (0, 0, -8))
        world.step()
        x, y, z = world.velocity(me)
        assert (abs(x), abs(y)) == (abs(way[0]) * max(abs(x), abs(y)), abs(way[1]) * max(abs(x), abs(y)))
        assert math.hypot(x, y) < before or before == 0
        before = math.hypot(x, y)
        assert z == 0
    assert world.velocity(me) == (0, 0, 0)


def test_a_push_stops_at_a_thin_wall(compiled: bool) -> None:
    world = world_of(PLAYER, compiled=compiled, fill=[floor(), [9, -9, 0, 10, 9, 4, 1]])
    me = world.spawn("slow", (0, 0, 0))
    world.add_velocity(me, (1024, 0, 0))
    world.step()
    assert high(world, me)[0] == 9
    assert world.velocity(me) == (0, 0, 0)
    assert settle(world) <= 1


def test_a_wall_takes_one_axis_and_leaves_the_other(compiled: bool) -> None:
    """Pressed diagonally into a wall for 300 ticks: x is on the face, y reaches its own part of the speed exactly."""
    world = world_of(PLAYER, compiled=compiled, fill=[floor(), [8, -30, 0, 9, 30, 4, 1]])
    me = world.spawn("slow", (7, -20, 0))
    world.step({me: Input(90, 89)})
    for _ in range(300):
        world.step()
    assert high(world, me)[0] == 8
    assert world.velocity(me)[0] == 0
    wished = round(3 * SPEED * 89 / 127) / SPEED
    assert 0 < world.velocity(me)[1] <= wished
    before = world.velocity(me)[1]
    world.step()
    assert world.velocity(me)[1] == before, "it has settled"


def test_above_the_walking_speed_friction_counts_whatever_the_input(compiled: bool) -> None:
    for input_ in (EAST, WEST, NEUTRAL):
        world = world_of(with_options(acceleration=64, friction=8), compiled=compiled, fill=[floor(0, 32)])
        me = world.spawn("slow", (-25, 0, 0))
        world.step({me: input_})
        world.set_velocity(me, (9, 0, 0))
        for tick in range(1, 40):
            world.step()
            assert world.velocity(me) == (9 - tick / 8, 0, 0)


def test_friction_alone_walks_at_once_and_is_knocked_back(compiled: bool) -> None:
    world = world_of(with_options(friction=16), compiled=compiled)
    me = world.spawn("slow", (0, 0, 0))
    world.step({me: EAST})
    assert world.velocity(me) == (3, 0, 0)
    world.step({me: WEST})
    assert world.velocity(me) == (-3, 0, 0)
    world.add_velocity(me, (12, 0, 0))
    world.step()
    assert world.velocity(me) == (8.75, 0, 0)


def test_no_friction_glides_for_ever_and_can_be_steered(compiled: bool) -> None:
    world = world_of(with_options(acceleration=16, friction=0), compiled=compiled, fill=[floor(0, 32)])
    me = world.spawn("slow", (-25, 0, 0))
    world.set_velocity(me, (6, 0, 0))
    world.step()
    steps(world, 100)
    assert world.velocity(me) == (6, 0, 0)
    world.step({me: WEST})
    assert world.velocity(me) == (5.75, 0, 0)


def test_without_options_a_throw_of_a_walker_vanishes_and_a_stone_slides_on(compiled: bool) -> None:
    world = world_of(compiled=compiled)
    me, stone = world.spawn("box", (0, 0, 0)), world.spawn("stone", (0, 5, 0))
    for entity in (me, stone):
        world.add_velocity(entity, (4, 0, 0))
    steps(world, 5)
    assert world.velocity(me) == (0, 0, 0)
    assert world.velocity(stone) == (4, 0, 0)


def test_a_crate_slides_as_far_as_its_friction_says(compiled: bool) -> None:
    world = world_of(Template("crate", (0, 0, 0), (1, 1, 1), friction=8), compiled=compiled)
    crate = world.spawn("crate", (0, 0, 0), (4, 0, 0))
    settle(world)
    assert world.position(crate) == (62 / 64, 0, 0)


def test_a_crate_flies_freely_and_is_slowed_on_the_ground(compiled: bool) -> None:
    world = world_of(Template("crate", (0, 0, 0), (1, 1, 1), friction=8), compiled=compiled)
    crate = world.spawn("crate", (0, 0, 0), (4, 0, 4))
    while world.falling(crate):
        assert world.velocity(crate)[0] == 4
        world.step()
    world.step()
    assert world.velocity(crate)[0] == 4 - 1 / 8


@pytest.mark.parametrize("air_control", [0, 0.5, 1, None])
def test_air_control_is_a_share_of_both(air_control: float | None, compiled: bool) -> None:
    share = 1 if air_control is None else air_control
    world = world_of(with_options(acceleration=16, friction=8, air_control=air_control), compiled=compiled)
    me = world.spawn("slow", (0, 0, 0))
    world.step({me: Input(0, 0, 1)})
    world.step({me: NORTH})
    assert world.velocity(me)[1] == share / 4
    world.step()
    world.step({me: NEUTRAL})
    assert world.velocity(me)[1] == share * (2 / 4 - 1 / 8)
    assert world.falling(me)


def test_a_jump_pad_has_the_apex_of_a_jump(compiled: bool) -> None:
    for entity in ("box", "slow"):
        world = world_of(PLAYER, compiled=compiled)
        me = world.spawn(entity, (0, 0, 0))
        settle(world)
        world.add_velocity(me, (0, 0, 8))
        peak = 0.0
        while world.awake(me):
            world.step()
            peak = max(peak, world.position(me)[2])
        assert peak == 2


def test_gravity_per_template(compiled: bool) -> None:
    """A balloon floats where it is; a feather and a stone fall side by side, each by its own gravity."""
    templates = (
        Template("balloon", (0, 0, 0), (1, 1, 1), gravity=0, jump_speed=8, walk_speed=3),
        Template("feather", (0, 0, 0), (1, 1, 1), gravity=2),
        Template("anvil", (0, 0, 0), (1, 1, 1), gravity=32),
    )
    for gravity in (16.0, 0.0):
        world = world_of(*templates, compiled=compiled, gravity=gravity)
        ids = [world.spawn(name, (4 * i, 0, 20)) for i, name in enumerate(("balloon", "feather", "anvil", "stone"))]
        steps(world, 16, {ids[0]: Input(0, 0, 1)})
        fallen = [20 - world.position(entity)[2] for entity in ids]
        assert fallen == [0, 2 / 32, 1, gravity / 32]
        assert world.falling(ids[0]) is False
        assert world.awake_count == (3 if gravity else 2), "the balloon sleeps with a button pressed"


def test_what_becomes_a_balloon_no_longer_falls_and_a_floating_thing_that_becomes_a_stone_does(compiled: bool) -> None:
    balloon = Template("balloon", (0, 0, 0), (5 / 8, 5 / 8, 7 / 4), gravity=0, friction=16)
    world = world_of(balloon, compiled=compiled, fill=[])
    entity = world.spawn("stone", (0, 0, 9))
    steps(world, 16)
    assert world.velocity(entity)[2] == -4
    world.set_template(entity, "balloon")
    world.step()
    assert world.velocity(entity)[2] == -3.75, "friction acts on the vertical part, too"
    assert not world.falling(entity)
    assert settle(world) == 15
    world.set_template(entity, "stone")
    world.step()
    assert world.falling(entity)
    assert world.velocity(entity)[2] == -0.25


def test_a_rider_of_a_floating_thing_stands_and_wakes_when_it_leaves(compiled: bool) -> None:
    lift = Template("lift", (0, 0, 0), (2, 2, 0.5), gravity=0)
    world = world_of(lift, compiled=compiled, fill=[])
    under, rider = world.spawn("lift", (0, 0, 4)), world.spawn("stone", (0.5, 0.5, 4.5))
    settle(world)
    assert world.position(rider)[2] == 4.5
    world.set_velocity(under, (8, 0, 0))
    steps(world, 64)
    assert world.falling(rider)


@pytest.mark.parametrize(
    ("field", "value", "more"),
    [
        ("gravity", -1, {}), ("gravity", math.nan, {}), ("gravity", "3", {}), ("gravity", 1e-9, {}),
        ("gravity", True, {}), ("gravity", 1e300, {}),
        ("acceleration", 0, {}), ("acceleration", -3, {}), ("acceleration", math.inf, {}), ("acceleration", 1e-9, {}),
        ("acceleration", 1e9, {}), ("acceleration", [3], {}),
        ("friction", -1, {}), ("friction", 1e-9, {}), ("friction", 5e-324, {}), ("friction", math.nan, {}),
        ("friction", 1e-9, {"walk_speed": 0.0}),
        ("air_control", 1.01, {"acceleration": 9}), ("air_control", -0.1, {"acceleration": 9}),
        ("air_control", 1e-9, {"acceleration": 9}), ("air_control", math.nan, {"acceleration": 9}),
        ("air_control", 0.5, {}), ("air_control", 0.5, {"friction": 3}), ("air_control", "1", {"acceleration": 9}),
    ],
)  # fmt: skip
def test_a_value_that_cannot_work_is_refused_by_name(field: str, value: Any, more: dict[str, Any]) -> None:
    named = "acceleration" if value == 1e-9 and field == "air_control" else field
    with pytest.raises(SceneError, match=rf"^templates\.slow\.{named}\b"):
        Scene("test", (with_options(**{field: value}, **more),), player="slow")


def test_gravity_of_a_template_needs_a_terminal_speed() -> None:
    with pytest.raises(SceneError, match=r"^templates\.slow\.gravity = 3: terminal_speed = 0"):
        Scene("test", (with_options(gravity=3),), player="slow", gravity=0.0, terminal_speed=0.0)


def test_scenes_without_the_options_keep_their_bytes_and_those_with_them_survive_a_round_trip() -> None:
    options = {"gravity", "acceleration", "friction", "air_control"}
    for file in SCENES.glob("*.toml"):
        for template in load_scene(file.stem).to_table()["templates"]:
            assert not options & template.keys()
    made = Scene("test", (with_options(gravity=0, acceleration=9, friction=0, air_control=1),), player="slow")
    again = Scene.from_table(made.to_table())
    assert again == made
    assert again.fingerprint == made.fingerprint
    assert options < made.to_table()["templates"][0].keys()
    assert made.fingerprint != Scene("test", (with_options(),), player="slow").fingerprint


def test_a_displacement_never_vanishes_while_a_velocity_does_not() -> None:
    """The follower's rule needs it: a part of a velocity that is not 0 moves the entity or is stopped."""
    for rate in range(1, 241):
        p = [0] * 13
        p[layout.RATE] = rate
        p[layout.EXACT] = 128 // rate if 128 % rate == 0 else 0
        assert abs(kernel.displacement(p, 2)) == abs(kernel.displacement(p, -2)) >= 1
    assert BLOCK // SPEED // 240 >= 1
