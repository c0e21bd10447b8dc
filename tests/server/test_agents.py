"""The game as an environment: PettingZoo's own test, observations, and policies that play here and over the wire."""

import asyncio
import random
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="needs the extra [agents]")
with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # its own examples
    from pettingzoo.test import parallel_api_test, parallel_seed_test

from client_sdk.async_client import AsyncClient
from client_sdk.bots import POLICIES, Bot, Builder, Policy, Wander
from client_sdk.core import Core
from server.agents import NO_BLOCK, OTHERS, Arena, Observation
from server.players.player import Player
from server.rules import Rules
from shared.checks import SceneError
from shared.inputs import make_input
from shared.messages import DONE, OUT_OF_REACH
from sovereign_netcode.examples.tag import Tag
from tests.client_sdk.servers import real_server
from tests.worlds import scene

ROOT = Path(__file__).resolve().parents[2]
YARD = scene(
    [[-8, -8, -1, 8, 8, 0, 1], [2, 0, 0, 3, 1, 1, 7]],
    spawns=[(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, -4.0, 0.0)],
    tick_rate=32,
)


class Race(Rules):
    """Rules of a race: the score is how far east a player is; a player who falls out of the yard is out."""

    def on_join(self, player: Player) -> None:
        self.game.set(player.entity, "score", self.game.position(player.entity)[0])

    def on_tick(self) -> None:
        for entity in self.game.players:
            self.game.set(entity, "score", self.game.position(entity)[0])

    def on_fell_out(self, entity: int) -> bool:
        self.game.set(entity, "over", True)
        return False


def arena(**changes: Any) -> Arena:
    values: dict[str, Any] = {"scene": YARD, "agents": 3, "rules": Race, "seconds": 2.0, "compiled": False}
    return Arena(**(values | changes))


@pytest.mark.parametrize("rules", [Rules, Race])
def test_it_is_what_pettingzoo_takes_for_an_environment(rules: type[Rules]) -> None:
    parallel_api_test(arena(rules=rules), num_cycles=200)
    parallel_seed_test(lambda: arena(rules=rules))


def test_observations_of_an_agent() -> None:
    env = arena()
    seen, infos = env.reset(seed=1)
    assert list(seen) == list(infos) == env.agents == ["player_0", "player_1", "player_2"]
    for agent in env.agents:
        assert env.observation_space(agent).contains(seen[agent])
    places = [env.world.position(env.entity(agent)) for agent in env.agents]
    mine = seen["player_0"]
    assert mine["own"].tolist() == [*places[0], 0, 0, 0, 0, 0]
    others = sorted(places[1:], key=lambda place: np.linalg.norm(np.subtract(place, places[0])))
    for row, place in zip(mine["others"], others, strict=False):
        assert row.tolist() == [*np.subtract(place, places[0]), 0, 0, 0, 0, 1]
    assert mine["others"].shape == (OTHERS, 8)
    assert not mine["others"][2:].any(), "there are no others"
    for agent, place in zip(env.agents, places, strict=True):
        x, y, z = (int(part // 1) for part in place)
        found = [
            [[env.world.blocks.get(x + i, y + j, z + k) for i in range(-3, 4)] for j in range(-3, 4)]
            for k in range(-1, 4)
        ]
        assert seen[agent]["blocks"].tolist() == found
    assert 7 in mine["blocks"]


def test_observations_distinguish_unloaded_blocks_from_air() -> None:
    env = arena(scene=scene(origin=(0, 0, 0), size=(1, 1, 1), spawns=[(1.0, 31.0, 0.0)], gravity=0.0), agents=1)
    seen, _ = env.reset()
    blocks = seen["player_0"]["blocks"]
    outside = np.zeros((5, 7, 7), bool)
    outside[0], outside[:, 4:], outside[:, :, :2] = True, True, True
    assert ((blocks == NO_BLOCK) == outside).all()
    assert not blocks[~outside].any()


def walk(env: Arena, steps: int, **actions: tuple[int, int, int]) -> tuple[dict[str, float], dict[str, bool]]:
    """Runs steps with the same actions. Returns the sum of each agent's rewards, and which agents are over at the
    end."""
    sums: dict[str, float] = dict.fromkeys(env.agents, 0.0)
    over: dict[str, bool] = {}
    for _ in range(steps):
        _, rewards, over, truncations, _ = env.step(actions)
        assert rewards.keys() == over.keys() == truncations.keys()
        for agent, reward in rewards.items():
            sums[agent] += reward
        if any(over.values()):
            break
    return sums, over


def test_actions_move_and_attributes_reward() -> None:
    env = arena()
    env.reset()
    start = {agent: env.world.position(env.entity(agent)) for agent in env.agents}
    sums, _ = walk(env, 32, player_1=(127, 0, 0), player_2=(-1000, 0, 1))
    env.step({})  # the rules see the latest movement only in the next tick
    now = {agent: env.world.position(env.entity(agent)) for agent in env.agents}
    assert now["player_0"] == start["player_0"]
    assert now["player_1"][0] - start["player_1"][0] == 3.0, "3 blocks/s for one second"
    assert now["player_2"][0] - start["player_2"][0] == -3.0, "longer than full speed is full speed"
    assert sums["player_0"] == 0.0
    assert sums["player_1"] == 3.0 - 3 / 32
    custom = arena(reward=lambda game, entity: float(entity))
    custom.reset()
    assert custom.step({})[1] == {agent: float(custom.entity(agent)) for agent in custom.possible_agents}


def test_an_agent_that_is_over_leaves_and_the_others_go_on_to_the_time_limit() -> None:
    env = arena(seconds=8.0)
    env.reset()
    out = env.entity("player_1")
    _, over = walk(env, 256, player_1=(127, 0, 0))
    assert over == {"player_0": False, "player_1": True, "player_2": False}
    assert env.agents == ["player_0", "player_2"]
    env.step({})
    assert out not in env.world
    truncations: dict[str, bool] = {}
    while env.agents:
        _, _, over, truncations, _ = env.step({})
    assert truncations == {"player_0": True, "player_2": True}
    assert env.world.tick == 1 + 8 * 32


def test_commands_are_answered() -> None:
    env = arena(agents=1)
    env.reset()
    for _ in range(8):  # edits have a rate limit
        env.step({})
    near, far = env.command("player_0", "edit", [2, 0, 0, 0]), env.command("player_0", "edit", [-8, -8, 0, 5])
    infos: dict[str, Any] = {}
    verdicts: list[tuple[int, int]] = []
    for _ in range(8):
        _, _, _, _, infos = env.step({})
        verdicts += infos["player_0"]["verdicts"]
    assert verdicts == [(near, DONE), (far, OUT_OF_REACH)]
    assert env.world.blocks.get(2, 0, 0) == 0


class Keeps(Rules):
    """Keeps what the rules learn of the first player's buttons and aim."""

    told: list[Any]

    def on_start(self) -> None:
        self.told = []

    def on_tick(self) -> None:
        for player in [*self.game.players.values()][:1]:
            held = [name for name in self.game.scene.buttons if self.game.held(player, name)]
            self.told.append((held, self.game.aim(player)))


def test_the_space_of_actions_has_the_buttons_and_the_aim_of_the_scene() -> None:
    plain = arena().action_space("player_0")
    assert plain.low.tolist() == [-127, -127, 0]
    assert plain.high.tolist() == [127, 127, 1]
    for buttons, most in ((("jump", "dash", "fire"), 7), (("dash",), 2), ((), 0)):
        space = arena(scene=replace(YARD, buttons=buttons)).action_space("player_0")
        assert space.high.tolist() == [127, 127, most]
    rules = Keeps()
    env = arena(scene=replace(YARD, buttons=("jump", "dash", "fire"), aim=True), rules=lambda: rules, agents=1)
    space = env.action_space("player_0")
    assert space.low.tolist() == [-127, -127, 0, -32767, -32767, -32767]
    assert space.high.tolist() == [127, 127, 7, 32767, 32767, 32767]
    env.reset()
    rules.told.clear()
    actions: list[Any] = [
        (0, 0, 4),
        (0, 0, 2, 0, 0, -5),
        np.array([1, 0, 0, 7, 0, 0]),
        make_input(1, 0, buttons=6, aim=(0, 1, 0)),
    ]
    for action in actions:
        env.step({"player_0": action})
    up, east, north = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    assert rules.told == [(["fire"], None), (["dash"], up), ([], east), (["dash", "fire"], north)]
    for wrong in ((0, 0), (0, 0, 256), (0, 0, 0, 1), (0, 0, 0, 1, 2), (0, 0, 0, 1, 2, 3, 4)):
        with pytest.raises(ValueError, match=r"."):
            env.step({"player_0": wrong})
    without = arena(agents=1)
    without.reset()
    with pytest.raises(SceneError, match=r"^action.aim = \(0, 32767, 0\): the scene 'test' has no aim"):
        without.step({"player_0": make_input(aim=(0, 1, 0))})


def played(env: Arena, policies: dict[str, Policy], seed: int | None = None) -> tuple[bytes, dict[str, Observation]]:
    """Plays a whole episode. Returns the hash of its world and the last observations."""
    seen, _ = env.reset(seed=seed)
    while env.agents:
        actions = {agent: policies[agent](env.world, env.entity(agent)) for agent in env.agents}
        for agent in env.agents:
            assert env.observation_space(agent).contains(seen[agent])
            assert env.action_space(agent).contains(np.array(actions[agent][:3]))
            policy = policies[agent]
            edit = policy.edit(env.world, env.entity(agent)) if isinstance(policy, Builder) else None
            if edit is not None:
                env.command(agent, "edit", list(edit))
        seen, *_ = env.step(actions)
    return env.world.state_hash(), seen


def test_one_seed_is_one_episode_of_tag() -> None:
    def episode(seed: int | None) -> bytes:
        policies: dict[str, Policy] = {agent: Wander(random.Random(i)) for i, agent in enumerate(env.possible_agents)}
        return played(env, policies, seed)[0]

    env = Arena(agents=3, rules=Tag, seconds=4.0)
    first, second, third = episode(5), episode(None), episode(6)
    assert first == episode(5)
    assert second == third, "an episode without a seed has the seed of the last one, plus one"
    assert first != second


@pytest.mark.e2e
async def test_the_same_policies_play_here_and_over_the_wire() -> None:
    env = Arena("flat", agents=len(POLICIES), seconds=1.0, compiled=False)
    policies = [make(random.Random(i)) for i, make in enumerate(POLICIES.values())]
    _, seen = played(env, dict(zip(env.possible_agents, policies, strict=True)))
    speeds = {name: float(np.abs(seen[agent]["own"][3:5]).sum()) for name, agent in zip(POLICIES, seen, strict=True)}
    assert speeds["stand"] == 0.0
    assert speeds["run-and-jump"] > 1.0

    async def plays(url: str, policy: Policy) -> None:
        """Plays over the wire until the policy was asked for a second of ticks."""
        asked: set[int] = set()
        enough = asyncio.Event()
        bot = Bot(policy)

        def act(core: Core) -> None:
            bot(core)
            if core.state == "playing" and core.prediction is not None:
                asked.add(core.prediction.predicted.tick)
                if len(asked) >= 32:
                    enough.set()

        client = await AsyncClient.connect(url, before_update=act, timeout=60.0)
        await asyncio.wait_for(enough.wait(), 60.0)
        await client.close()
        assert client.core.stats.inputs_sent >= 31
        assert client.core.stats.divergences == 0

    with real_server("--scene", "flat") as url:
        await asyncio.gather(*(plays(url, policy) for policy in policies))


def test_without_pettingzoo_it_says_what_to_install() -> None:
    program = "import sys; sys.modules['pettingzoo'] = None; import server.agents"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    way = f"pip install '{ROOT}[agents]'"
    assert last == f"ImportError: agents need PettingZoo, which is not installed here: {way}"
