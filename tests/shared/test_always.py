"""Turns in every tick (`Behaviour.always`), and fields that a turn sets to the value that they have."""

import pytest

from shared.arrays import FEW
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.checks import SceneError
from shared.scene import Scene, load_scene
from shared.world import World


class Counts(Behaviour):
    templates = ("player",)
    always = True
    turns = field(bits=16)
    same = field(bits=8, start=7)

    def turn(self, me: Body) -> None:
        me.turns += 1
        me.same = 7


class Rests(Behaviour):
    templates = ("crate",)
    turns = field(bits=16)

    def turn(self, me: Body) -> None:
        me.turns += 1


class Sets(Behaviour):
    """Sets its field to one value in every tick."""

    templates = ("player",)
    always = True
    same = field(bits=8)

    def turn(self, me: Body) -> None:
        me.same = 9


def world(scene: Scene, count: int) -> World:
    made = World(scene)
    made.load_terrain()
    for k in range(count):
        made.spawn("player", (20 + 2 * k, 64, 8))
    return made


@pytest.mark.parametrize("count", [1, FEW + 1])
def test_an_entity_that_stands_still_has_turns_if_its_behaviour_has_always(count: int) -> None:
    made = world(load_scene("hills").with_behaviours([Counts, Rests]), 0)
    players = [made.spawn("player", (20 + 2 * k, 64, 28)) for k in range(count)]
    crates = [made.spawn("crate", (20 + 2 * k, 80, 28)) for k in range(count)]
    for _ in range(200):
        made.step()
    rested = [made.field(crate, "turns") for crate in crates]
    for _ in range(50):
        made.step()
    assert [made.field(player, "turns") for player in players] == [250] * count
    assert [made.field(crate, "turns") for crate in crates] == rested


def test_a_field_that_is_set_to_the_value_that_it_has_is_no_change() -> None:
    made = world(load_scene("flat").with_behaviours([Sets]), 2)
    made.step()
    assert len(made.fields_set) == 2
    for _ in range(3):
        made.step()
        assert not made.fields_set


def test_always_is_a_truth_value() -> None:
    class Odd(Sets):
        always = "yes"  # type: ignore[assignment]

    with pytest.raises(SceneError, match=r"behaviours\.Odd\.always = 'yes'"):
        load_scene("flat").with_behaviours([Odd])


def test_a_turn_finds_the_number_of_a_kind_of_blocks() -> None:
    class Finds(Behaviour):
        templates = ("player",)
        always = True
        found = field(bits=8)

        def turn(self, me: Body) -> None:
            me.found = me.kind("water")

    scene = load_scene("flat").with_kind("water", 9, solid=False).with_behaviours([Finds])
    made = world(scene, 1)
    made.step()
    assert made.field(1, "found") == 9
