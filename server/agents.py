"""A game as an environment for learning agents: PettingZoo's parallel API, in one process, without waiting for a clock.

    env = Arena("meadow", agents=4, rules=Tag, reward="score", seconds=60)
    observations, infos = env.reset(seed=1)
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)

It runs the server's own `Game` tick by tick without connections, so what an agent learns here holds on a server.
Policies of bots work in it unchanged: `policy(env.world, env.entity(agent))` is an action. The same seed gives the same
episode.
"""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from server.config.limits import Limits
from server.extras import install
from server.game import Game
from server.game.session import Session
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld
from server.players.input_queue import InputQueue
from server.rules import Rules, prepared
from shared.aim import AIM_MAX, NO_AIM
from shared.checks import finite, text, whole
from shared.fields import NAME_MAX
from shared.inputs import MOVE_MAX, NEUTRAL, Input, checked_input, clamp
from shared.layout import FALLING, FLAGS, ID, TEMPLATE, VX, Int64s, X
from shared.messages import Command
from shared.payloads import pack_value
from shared.scene import Scene, load_scene
from shared.units import BLOCK, BLOCK_SHIFT, RANGE_BLOCKS, SEGMENT, SEGMENT_SHIFT, SPEED, SPEED_MAX
from shared.world import World

try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
except ImportError as missing:
    raise ImportError(f"agents need PettingZoo, which is not installed here: {install('agents')}") from missing

MANY = 1 << 20
"""Maximum number of agents, and of ticks per action."""
OTHERS = 8
"""Number of other entities, the nearest ones, in an observation."""
OTHER_COLUMNS = 8
"""Numbers per other entity: position and velocity relative to the own, template, and 1 (0 in unused rows)."""
OWN_COLUMNS = 8
"""Numbers of the own entity: position, velocity, template, and whether it falls."""
AROUND = (-3, 4), (-3, 4), (-1, 4)
"""Ranges of the blocks in an observation along x, y, z, relative to the block with the feet; the ends are excluded."""
NO_BLOCK = 255
"""Kind in an observation for places that are not loaded. Such places stop every entity."""

Array = npt.NDArray[Any]
Observation = dict[str, Array]
Reward = Callable[[GameApi, int], float]


class Arena(ParallelEnv):  # type: ignore[misc]  # it has no type information
    """A game whose agents join at the start of an episode and play until its time is over.

    Observations are a `Dict` of "own" [8] and "others" [8, 8] (float32; blocks and blocks/s), and "blocks" [5, 7, 7]
    (uint8; kinds by z, y, x around the feet). An action is three whole numbers: move_x (east) and move_y (north) in
    -127..127, and the bits of the buttons (`Scene.button`): 1 to jump. In a scene with aim, its three parts in
    -32767..32767 follow. Any `Input` is an action, too.

    Args:
        scene: the name or path of a scene, or a scene; None: the rules' own, otherwise "flat".
        agents: number of agents.
        rules: makes the rules of the game, once per episode.
        reward: the name of an attribute whose change is the reward, or a function of the game API and the entity.
        over: the name of an attribute. When it is true for an agent's entity, the agent leaves the episode.
        seconds: the length of an episode.
        repeat: number of ticks per action.
        compiled: whether the kernel is compiled, as for `World`.

    Raises:
        SceneError: the scene cannot be used.
        ValueError: a number is not positive.
    """

    metadata = {"name": "sovereign", "render_modes": []}  # noqa: RUF012 - as PettingZoo wants it
    render_mode = None

    def __init__(
        self,
        scene: str | Scene | None = None,
        agents: int = 4,
        *,
        rules: Callable[[], Rules] = Rules,
        reward: str | Reward = "score",
        over: str = "over",
        seconds: float = 30.0,
        repeat: int = 1,
        compiled: bool | None = None,
    ) -> None:
        whole(agents, "agents", -MANY, MANY)
        whole(repeat, "repeat", -MANY, MANY)
        if min(agents, finite(seconds, "seconds"), repeat) <= 0:
            raise ValueError(f"agents = {agents}, seconds = {seconds}, repeat = {repeat}: must be positive")
        first = rules()
        named = scene if scene is not None else first.scene or "flat"
        self._bare = load_scene(named) if isinstance(named, str) else named
        self.scene = prepared(first, self._bare)
        self.possible_agents = [f"player_{i}" for i in range(agents)]
        self.agents: list[str] = []
        self._rules, self._over, self._repeat = rules, over, repeat
        self._reward = reward if callable(reward) else _attribute(reward)
        self._scores_change = not callable(reward)
        self._ticks = max(round(seconds * self.scene.tick_rate), 1)
        self._blank = World(self.scene, compiled=compiled)
        self._blank.load_terrain()
        self._seed = 0
        self._spaces = _observations(len(self.scene.templates))
        self._actions = {agent: _actions(self.scene) for agent in self.possible_agents}
        self._table, self._corner, self._loaded = np.zeros((1, 1, 1), np.int64), np.zeros(3, np.int64), -1

    def observation_space(self, agent: str) -> spaces.Dict:
        """Returns the space of an agent's observations, the same for all agents."""
        return self._spaces

    def action_space(self, agent: str) -> spaces.Box:
        """Returns the space of an agent's actions."""
        return self._actions[agent]

    @property
    def world(self) -> World:
        """The present world, for policies. Do not change it."""
        return self._game.world

    @property
    def api(self) -> GameApi:
        """The game API of the running game."""
        return self._game.api

    def entity(self, agent: str) -> int:
        """Returns the number of an agent's entity."""
        return self._seats[agent].entity

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Starts a new episode with a new game.

        Args:
            seed: seed of the game; None: that of the last episode plus one.
            options: ignored.

        Returns:
            The observations and infos of all agents.

        Raises:
            ValueError: there is no room to spawn all agents.
        """
        self._seed = self._seed + 1 if seed is None else seed
        world = RecordedWorld(self.scene, compiled=self._blank.compiled)
        world.restore(self._blank)
        rules = self._rules()
        prepared(rules, self._bare)
        game = self._game = Game(self.scene, limits=Limits(resume_s=0.0), world=world, rules=rules, seed=self._seed)
        game.tick(0.0, 0.0)  # lets the rules prepare the world before agents join
        self.agents = list(self.possible_agents)
        self._seats = {agent: Session(_Nobody(), 0.0) for agent in self.agents}
        self._queues: dict[str, InputQueue] = {}
        for agent, seat in self._seats.items():
            with game.api.turn:
                player = game.roster.enter(seat, agent)
            if player is None:
                raise ValueError(f"{len(self.agents)} agents: no room to spawn {agent} in {self.scene.name}")
            self._queues[agent] = player.inputs
            player.inputs.override = NEUTRAL
        self._number, self._end = 0, game.world.tick + self._ticks
        self._scores = {agent: self._reward(game.api, self.entity(agent)) for agent in self.agents}
        return self._look(), {agent: {"verdicts": []} for agent in self.agents}

    def command(self, agent: str, name: str, data: Any = None) -> int:
        """Sends a command of an agent with the next step, as `Client.command` does.

        Args:
            agent: the agent.
            name: name of the command; "edit" places or removes a block.
            data: data of the command, any MessagePack value; for "edit": [x, y, z, kind].

        Returns:
            The number of the command. The next step's `infos[agent]["verdicts"]` has its result, as (number, verdict).

        Raises:
            ValueError: the name or the data are too long (32 characters, 1,024 bytes), or no MessagePack value.
        """
        text(name, "name", NAME_MAX)
        payload = pack_value(data)
        player = self._seats[agent].player
        assert player is not None
        self._number += 1
        tick = self.world.tick
        self._game.commands.file(player, Command(self._number, tick + 1, float(tick), name, payload))
        return self._number

    def step(
        self, actions: Mapping[str, Input | Sequence[int] | Array]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Runs `repeat` ticks with the given actions. An agent without an action stands still.

        Returns:
            Observations, rewards, terminations, truncations and infos, each by agent.
        """
        for agent in self.agents:
            given = actions.get(agent)
            self._queues[agent].override = NEUTRAL if given is None else _input(given, self.scene)
        for _ in range(self._repeat):
            self._game.tick(0.0, 0.0)
        truncated, api = self.world.tick >= self._end, self._game.api
        rewards, over, infos = {}, {}, {}
        for agent in self.agents:
            player = self._seats[agent].player
            assert player is not None
            score = self._reward(api, player.entity)
            rewards[agent] = score - self._scores[agent] if self._scores_change else score
            self._scores[agent] = score
            over[agent] = bool(api.get(player.entity, self._over))
            infos[agent] = {"verdicts": list(player.verdicts)}
            player.verdicts.clear()
        observations = self._look()
        truncations = dict.fromkeys(self.agents, truncated)
        for agent in [agent for agent in self.agents if over[agent] or truncated]:
            self.agents.remove(agent)
            self._game.lost(self._seats[agent], 0.0)
        return observations, rewards, over, truncations, infos

    # -- inside --------------------------------------------------------------------------------------------

    def _look(self) -> dict[str, Observation]:
        """Returns the observations of all agents."""
        states = self.world.states()
        own = np.searchsorted(states[:, ID], [self.entity(agent) for agent in self.agents])
        seen = _in_blocks(states)
        others, blocks = _nearest(seen, own), self._around(states[own, X : X + 3])
        return {
            agent: {"own": seen[at].astype(np.float32), "others": others[i], "blocks": blocks[i]}
            for i, (agent, at) in enumerate(zip(self.agents, own, strict=True))
        }

    def _around(self, places: Int64s) -> npt.NDArray[np.uint8]:
        """Returns the kinds of the blocks around positions ([n, 3], in grid steps), [n, z, y, x]."""
        blocks = self.world.blocks
        if self._loaded != len(blocks.rows):
            self._loaded = len(blocks.rows)
            rows = np.fromiter(blocks.rows.values(), np.int64, self._loaded)
            self._corner = blocks.segments[rows].min(axis=0) - 1
            at = blocks.segments[rows] - self._corner
            self._table = np.zeros(at.max(axis=0) + 2, np.int64)
            self._table[tuple(at.T)] = rows
        inside = SEGMENT - 1
        index: list[Int64s] = []
        offsets: list[Int64s] = []
        for axis, (low, span) in enumerate(zip(self._corner, AROUND, strict=True)):
            at = (places[:, axis, None] >> BLOCK_SHIFT) + np.arange(*span)  # [n, blocks along this axis]
            shape = [len(at), 1, 1, 1]
            shape[3 - axis] = at.shape[1]
            segment = np.clip((at >> SEGMENT_SHIFT) - low, 0, self._table.shape[axis] - 1)
            index.append(segment.reshape(shape))
            offsets.append(((at & inside) << SEGMENT_SHIFT * axis).reshape(shape))
        found = self._table[tuple(index)]
        kinds: npt.NDArray[np.uint8] = blocks.kinds[found, offsets[0] | offsets[1] | offsets[2]]
        kinds[found == 0] = NO_BLOCK
        return kinds


class _Nobody:
    """The link of a player without a client."""

    def send(self, message: bytes) -> None:
        """Discards the message."""

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        """Does nothing."""


def _attribute(name: str) -> Reward:
    def value(api: GameApi, entity: int) -> float:
        found = api.get(entity, name, 0.0)
        return float(found) if isinstance(found, int | float) else 0.0

    return value


def _actions(scene: Scene) -> spaces.Box:
    """Returns the space of an agent's actions in a scene."""
    buttons = functools.reduce(operator.or_, scene.button_bits.values(), 0)
    aim = [AIM_MAX] * 3 if scene.aim else []
    low = [-MOVE_MAX, -MOVE_MAX, 0, *(-part for part in aim)]
    return spaces.Box(np.array(low), np.array([MOVE_MAX, MOVE_MAX, buttons, *aim]), dtype=np.int64)


def _input(action: Input | Sequence[int] | Array, scene: Scene) -> Input:
    """Returns the input that an action is: an `Input`, or the numbers of the action space.

    Raises:
        SceneError: it is neither.
    """
    if not isinstance(action, Input):
        x, y, buttons, *aim = map(int, action)
        action = Input(x, y, buttons, tuple(aim) or NO_AIM)  # type: ignore[arg-type]
    input_ = clamp(checked_input(action, "action"))
    scene.check_aim(input_.aim, "action.aim")
    return input_


def _observations(templates: int) -> spaces.Dict:
    place, speed = [float(RANGE_BLOCKS)] * 3, [SPEED_MAX] * 3
    own = np.array([*place, *speed, templates - 1, 1], np.float32)
    low = np.array([*(-own[:6]), 0, 0], np.float32)
    others = np.repeat(np.array([[*(2 * own[:6]), templates - 1, 1]], np.float32), OTHERS, axis=0)
    below = np.repeat(np.array([[*(2 * low[:6]), 0, 0]], np.float32), OTHERS, axis=0)
    return spaces.Dict(
        {
            "own": spaces.Box(low, own),
            "others": spaces.Box(below, others),
            "blocks": spaces.Box(0, NO_BLOCK, [high - low for low, high in reversed(AROUND)], np.uint8),
        }
    )


def _in_blocks(states: Int64s) -> npt.NDArray[np.float64]:
    """Converts states [n, 12] to positions, velocities, template and whether the entity falls, [n, 8]."""
    seen = np.empty((len(states), OWN_COLUMNS))
    seen[:, :3] = states[:, X : X + 3] / BLOCK
    seen[:, 3:6] = states[:, VX : VX + 3] / SPEED
    seen[:, 6] = states[:, TEMPLATE]
    seen[:, 7] = states[:, FLAGS] & FALLING
    return seen


def _nearest(seen: npt.NDArray[np.float64], own: Int64s) -> npt.NDArray[np.float32]:
    """Returns the nearest other entities of each own entity, nearest first, [n, 8, 8].

    Args:
        seen: all entities, as `_in_blocks` returns them.
        own: rows of the agents' entities.
    """
    away = seen[own, None, :3] - seen[None, :, :3]
    way = np.einsum("ijk,ijk->ij", away, away)
    way[np.arange(len(own)), own] = np.inf
    near = np.argsort(way, axis=1, kind="stable")[:, :OTHERS]
    there = np.take_along_axis(way, near, axis=1) < np.inf
    found = np.zeros((len(own), OTHERS, OTHER_COLUMNS), np.float32)
    rows = seen[near]
    rows[..., :6] -= seen[own, None, :6]
    rows[..., 7] = 1
    found[:, : near.shape[1]] = np.where(there[..., None], rows, 0)
    return found
