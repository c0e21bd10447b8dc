"""The check of behaviours finds one offender of each kind, with tick, entity, field and behaviour; honest ones pass."""

import random
import re
import time
from collections.abc import Callable
from typing import Any

import pytest

from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.checks import SceneError
from shared.scene import Scene, load_scene
from sovereign_netcode.examples.dodge import Dodge
from sovereign_netcode.examples.race import Race
from sovereign_netcode.playtest import BehaviourCheckError, check_behaviours
from tests.behaving import Playground
from tests.behaving import scene as playground
from tests.lengths import long

NAMES = {"ann", "bob", "cid", "dan", "eve", "fay", "gus", "hal", "ida", "jim", "kay", "lea"}


class Clock(Behaviour):
    templates = ("player",)
    calm = field(bits=8)
    mood = field(bits=16)

    def turn(self, me: Body) -> None:
        if me.move != (0, 0):
            me.mood = time.perf_counter_ns() // 64 & 0xFFFF


class Dice(Behaviour):
    templates = ("player",)
    mood = field(bits=30)

    def turn(self, me: Body) -> None:
        if me.pressed("jump"):
            me.mood = random.randrange(1 << 30)


class Remembers(Behaviour):
    templates = ("player",)
    mood = field(bits=30)

    def __init__(self) -> None:
        self.turns = 0

    def turn(self, me: Body) -> None:
        self.turns += 1
        me.mood = self.turns


class Unordered(Behaviour):
    templates = ("player",)
    mood = field(bits=40)

    def turn(self, me: Body) -> None:
        if me.move != (0, 0):
            me.mood = sum(ord(name[0]) % 8 << 3 * k for k, name in enumerate(NAMES))


class Throws(Behaviour):
    templates = ("player",)
    mood = field(bits=40)

    def turn(self, me: Body) -> None:
        if me.pressed("jump"):
            me.mood = -1


class Honest(Behaviour):
    templates = ("player",)
    mood = field(bits=30)

    def turn(self, me: Body) -> None:
        if me.pressed("jump"):
            me.mood = me.chance(1 << 30)


def game(code: type[Behaviour]) -> Rules:
    """Returns rules with one behaviour."""
    return type("Game", (Rules,), {"behaviours": (code,)})()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (Clock, r"tick \d+: entity \d, Clock\.mood = \d+, but \d+ when its tick was played again.*clock"),
        (Dice, r"tick \d+: entity \d, Dice\.mood = \d+, but \d+ when its tick was played again.*random"),
        (Remembers, r"tick \d+: entity \d, Remembers\.mood = \d+, but \d+ when its tick was played again.*variable"),
        (Unordered, r"tick \d+: entity \d, Unordered\.mood = \d+, but \d+ in another process.*order of a set"),
        (Throws, r"tick \d+: entity \d, Throws: the turn has failed: .*mood = -1"),
    ],
)
def test_an_offender_is_found_with_tick_entity_field_and_behaviour(code: type[Behaviour], text: str) -> None:
    with pytest.raises(BehaviourCheckError) as caught:
        check_behaviours(game(code), ticks=40, players=2, processes=1)
    assert re.search(text, str(caught.value), re.DOTALL)


@pytest.mark.parametrize(
    ("rules", "scene", "ticks", "processes"),
    [
        (lambda: game(Honest), None, 30, 0),
        (Playground, lambda: playground(()), 30, 0),
        *long(
            (lambda: game(Honest), None, 60, 3),
            (Playground, lambda: playground(()), 800, 3),
            (Rules, lambda: load_scene("hills"), 100, 3),
            (Dodge, None, 300, 1),
            (Race, None, 300, 1),
        ),
    ],
)
def test_honest_behaviours_pass(
    rules: Callable[[], Rules], scene: Callable[[], Scene] | None, ticks: int, processes: int
) -> None:
    check_behaviours(rules(), None if scene is None else scene(), ticks=ticks, players=2, processes=processes)


def test_a_class_that_another_process_cannot_import_is_refused() -> None:
    class Local(Honest):
        pass

    with pytest.raises(ValueError, match="Local: another process cannot import it"):
        check_behaviours(game(Local), ticks=1, players=1, processes=1)


@pytest.mark.parametrize("name", ["ticks", "players", "processes"])
def test_wrong_arguments_are_refused_by_name(name: str) -> None:
    wrong: dict[str, Any] = {name: -1}
    with pytest.raises(SceneError, match=name):
        check_behaviours(game(Honest), **wrong)
