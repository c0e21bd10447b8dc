"""Every example game in every scene, and trees where there is little room for them."""

from collections.abc import Callable
from itertools import product
from random import Random

import pytest

from sovereign_netcode import new_game
from sovereign_netcode.client_sdk.bots import Follow, RunAndJump
from sovereign_netcode.examples.dodge import Dodge
from sovereign_netcode.examples.freeze import Freeze
from sovereign_netcode.examples.tag import LEAVES, TRUNK, Tag
from sovereign_netcode.playtest import Match, bot
from sovereign_netcode.server.rules import Rules
from sovereign_netcode.shared.scene import SCENES, Scene, load_scene
from sovereign_netcode.shared.units import SEGMENT
from tests.lengths import long_but


def skeleton() -> Rules:
    """Returns the game that `scripts/new-game` writes."""
    space: dict[str, type[Rules]] = {}
    exec(new_game.RULES.format(name="mine", title="Mine"), space)
    return space["Mine"]()


SHORT = [(Rules, "arena"), (Tag, "flat"), (Freeze, "hills"), (skeleton, "topdown")]
EVERY = product([Rules, Tag, Dodge, Freeze, skeleton], sorted(path.stem for path in SCENES.glob("*.toml")))


@pytest.mark.parametrize(("make", "scene"), long_but(SHORT, EVERY))
def test_every_game_plays_in_every_scene(make: Callable[[], Rules], scene: str) -> None:
    match = Match(load_scene(scene), seed=3, rules=make())
    players = [match.join(bot(RunAndJump(Random(1)))), match.join(bot(Follow(Random(2))))]
    match.run(15)
    assert match.game.counters.rules_failed == 0
    for player in players:
        assert player.core.state == "playing"
        assert player.core.stats.divergences == 0


def scene(**changes: object) -> Scene:
    table = {"name": "odd", "size": [1, 1, 1], "spawns": [[16, 16, 24]], "terrain": {"generator": "flat", "height": 8}}
    return Scene.from_table(table | changes)


ROOMS = {
    "one segment": scene(),
    "spawns at the rims": scene(spawns=[[0.5, 0.5, 24], [31.5, 31.5, 24], [0.5, 31.5, 24]]),
    "below and west of zero": scene(
        origin=[-1, -1, -1], spawns=[[-16, -16, -8]], terrain={"generator": "flat", "height": -20}
    ),
    "no ground": scene(terrain={"generator": "boxes", "fill": [[15, 15, 20, 18, 18, 22, 1]]}),
    "the lowest block": scene(terrain={"generator": "boxes", "fill": [[0, 0, 0, 32, 32, 1, 1]]}),
    "just room": scene(terrain={"generator": "flat", "height": 25}, spawns=[[16, 16, 28]]),
    "no room": scene(terrain={"generator": "flat", "height": 26}, spawns=[[16, 16, 28]]),
    "full": scene(terrain={"generator": "flat", "height": 32}, spawns=[[16, 16, 32]]),
    "high": scene(size=[1, 1, 3], terrain={"generator": "flat", "height": 40}, spawns=[[16, 16, 60]]),
}


@pytest.mark.parametrize("room", long_but(["spawns at the rims", "below and west of zero", "no room"], ROOMS))
def test_trees_stand_on_the_ground_and_within_the_world(room: str) -> None:
    trees = 0
    for seed in range(8):
        match = Match(ROOMS[room], seed, rules=Tag())
        match.run(0.2)
        assert match.game.counters.rules_failed == 0
        kinds = match.game.world.blocks.kinds.reshape(-1, SEGMENT, SEGMENT, SEGMENT)
        trees += int((kinds == TRUNK).sum()) // 4
        assert bool((kinds == LEAVES).any()) is bool((kinds == TRUNK).any())
    assert (trees == 0) is (room in ("no room", "full"))
