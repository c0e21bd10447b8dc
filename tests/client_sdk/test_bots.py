"""Policies in a world of their own, without a client and without a server."""

import random
from collections.abc import Mapping
from typing import Any

import pytest

from client_sdk.bots import POLICIES, Bot, Follow, Wander
from client_sdk.core import Core
from shared.inputs import MOVE_MAX, NEUTRAL, Input
from shared.scene import Scene, load_scene
from shared.world import World
from sovereign_netcode.playtest import Match, bot
from tests.lengths import long

FLAT = load_scene("flat")


def world_of(scene: Scene, *places: tuple[float, float, float]) -> tuple[World, list[int]]:
    world = World(scene)
    world.load_terrain()
    return world, [world.spawn("player", place) for place in places]


def wishes(name: str, seed: int, ticks: int = 400, scene: Scene = FLAT) -> list[Input]:
    world, (me,) = world_of(scene, scene.spawns[0])
    policy = POLICIES[name](random.Random(seed))
    found = []
    for _ in range(ticks):
        found.append(policy(world, me))
        world.step({me: found[-1]})
    return found


@pytest.mark.parametrize("name", POLICIES)
def test_the_seed_decides(name: str) -> None:
    assert wishes(name, 1) == wishes(name, 1)
    if name in ("wander", "run-and-jump"):
        assert wishes(name, 1) != wishes(name, 2)


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("scene", ["arena", *long("hills"), "topdown"])
def test_every_policy_plays_every_scene(name: str, scene: str) -> None:
    for input_ in wishes(name, 7, 200, load_scene(scene)):
        assert input_.move_x**2 + input_.move_y**2 <= MOVE_MAX**2


def test_stand_stands() -> None:
    assert set(wishes("stand", 1)) == {NEUTRAL}


def test_wander_gets_about() -> None:
    world, (me,) = world_of(FLAT, FLAT.spawns[0])
    policy = Wander(random.Random(3))
    cells = set()
    for _ in range(2000):
        world.step({me: policy(world, me)})
        x, y, _z = world.position(me)
        cells.add((x // 4, y // 4))
    assert len(cells) >= 4


def test_run_and_jump_leaves_the_ground() -> None:
    assert sum(input_.buttons for input_ in wishes("run-and-jump", 1)) > 300


def test_follow_catches_up_and_stays_close() -> None:
    x, y, z = FLAT.spawns[0]
    world, (me, other) = world_of(FLAT, (x, y, z), (x + 8, y + 5, z))
    policy = Follow(random.Random(1))
    for _ in range(32 * 6):
        world.step({me: policy(world, me)})
    a, b = world.position(me), world.position(other)
    assert max(abs(a[0] - b[0]), abs(a[1] - b[1])) < 1.2


def test_follow_alone_stands() -> None:
    assert set(wishes("follow", 1)) == {NEUTRAL}


def test_a_bot_that_is_not_in_a_world_yet_sets_no_input() -> None:
    core = Core()
    Bot(Wander(random.Random(1)))(core)
    assert core.state == "joining"


class Attentive(Wander):
    """A policy that keeps the attributes that it is given."""

    learnt: Mapping[int, Mapping[str, Any]] | None = None

    def learn(self, attributes: Mapping[int, Mapping[str, Any]]) -> None:
        self.learnt = attributes


def test_a_policy_with_learn_gets_the_attributes_of_entities() -> None:
    match = Match(FLAT, 1)
    policy = Attentive(random.Random(1))
    player = match.join(bot(policy))
    match.run(3)
    assert policy.learnt == {player.core.entity: {"name": "player 0"}}
