"""The decisions of runners and bots in tag: whom they run after, and from whom they run away."""

import math

import pytest

from sovereign_netcode.examples.tag import Tag
from sovereign_netcode.examples.tag_brain import TagPlayer, wish
from sovereign_netcode.shared.inputs import JUMP
from sovereign_netcode.shared.scene import load_scene
from sovereign_netcode.shared.world import World

MEADOW = load_scene("meadow")
HERE = (32.0, 32.0, 9.0)


def test_it_runs_after_the_nearest_player_that_can_be_tagged() -> None:
    places = {1: HERE, 2: (34.0, 32.0, 9.0), 3: (32.0, 40.0, 9.0)}
    assert wish(MEADOW, 1, 0, places, (1.0, 1.0, 0.0), [1], [])[:2] == (1.0, 0.0)
    assert wish(MEADOW, 1, 0, places, (1.0, 1.0, 0.0), [1], [2])[:2] == (0.0, 1.0)


@pytest.mark.parametrize("me", [1, 2, 3])
@pytest.mark.parametrize("angle", range(8))
def test_the_others_run_away_from_it(me: int, angle: int) -> None:
    way = math.cos(angle), math.sin(angle)
    places = {me: HERE, 9: (32 + 6 * way[0], 32 + 6 * way[1], 9.0)}
    x, y, _ = wish(MEADOW, me, 0, places, (1.0, 1.0, 0.0), [9], [])
    assert x * way[0] + y * way[1] < -0.5


def test_no_runner_leaves_the_scene() -> None:
    for scene in (MEADOW, load_scene("hills")):
        east = scene.size[0] * 32.0
        for me in range(1, 9):
            x, _, _ = wish(scene, me, 0, {me: (east - 0.5, east / 2, 9.0)}, (1.0, 1.0, 0.0), [], [])
            assert x < 0


def test_a_blocked_runner_jumps() -> None:
    places = {1: HERE, 2: (36.0, 32.0, 9.0)}
    assert not wish(MEADOW, 1, 0, places, (5.0, 0.0, 0.0), [1], [])[2]
    assert wish(MEADOW, 1, 0, places, (0.0, 0.0, 0.0), [1], [])[2]


def test_a_bot_finds_it_by_template_and_safe_players_by_attribute() -> None:
    scene = Tag().prepare(load_scene(Tag.scene))
    world = World(scene)
    world.load_terrain()
    me = world.spawn("it", (32.0, 32.0, 20.0))
    near, far = world.spawn("player", (35.0, 32.0, 20.0)), world.spawn("player", (32.0, 45.0, 20.0))
    bot = TagPlayer()
    assert bot(world, me)[:2] == (127, 0)
    bot.learn({near: {"safe": world.tick + 1}})
    assert bot(world, me)[:2] == (0, 127)
    bot.learn({near: {"safe": world.tick}, far: {}})
    assert bot(world, me)[:3] == (127, 0, JUMP)
