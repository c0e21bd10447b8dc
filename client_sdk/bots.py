"""Bots: players whose inputs a policy chooses, a function that gets the world once per tick.

A policy knows nothing of networks. So one policy can play over a connection (in a client's predicted world) and inside
a server. All its chance comes from the random source that it is given, so a seed repeats its play.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

from client_sdk.core import Core
from shared.edits import Edit
from shared.inputs import NEUTRAL, Input, make_input
from shared.layout import ID, TEMPLATE, VX, X
from shared.units import BLOCK, SEGMENT
from shared.world import World


class Random(Protocol):
    """The part of `random.Random` that a policy uses."""

    def random(self) -> float:
        """Returns a number from 0 up to, but not including, 1."""
        ...


class Policy(Protocol):
    """A function that chooses the inputs of one player."""

    def __call__(self, world: World, me: int) -> Input:
        """Returns the input for the next tick.

        Args:
            world: the world at the end of the tick before.
            me: number of the player's entity, which is in the world.
        """
        ...


@runtime_checkable
class Builder(Policy, Protocol):
    """A policy that also places and removes blocks."""

    def edit(self, world: World, me: int) -> Edit | None:
        """Returns the edit for the next tick, or None. Called once per tick, after the input was chosen."""
        ...


@runtime_checkable
class Learner(Policy, Protocol):
    """A policy that uses the attributes of the entities that its player sees."""

    def learn(self, attributes: Mapping[int, Mapping[str, Any]]) -> None:
        """Receives the attributes by entity, before each input. The mapping changes when snapshots arrive."""
        ...


class Bot:
    """A policy that controls a client: `AsyncClient.connect(..., before_update=Bot(Wander(Random(1))))`."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._learner = policy if isinstance(policy, Learner) else None
        self._builder = policy if isinstance(policy, Builder) else None
        self._tick = -1

    def __call__(self, core: Core) -> None:
        """Sets the input of the next tick, and sends the policy's edit, once per tick."""
        if core.prediction is None:
            return
        world = core.prediction.predicted
        if world.tick != self._tick and core.entity in world:
            self._tick = world.tick
            if self._learner is not None:
                self._learner.learn(core.prediction.attributes)
            core.set_input(self._policy(world, core.entity))
            if self._builder is not None and core.state == "playing":
                edit = self._builder.edit(world, core.entity)
                if edit is not None:
                    core.edit(*edit)


class Stand:
    """Stands still."""

    def __init__(self, random: Random) -> None:
        pass

    def __call__(self, world: World, me: int) -> Input:
        return NEUTRAL


class Wander:
    """Walks in a random direction for 0.5 to 2 s, then chooses another. One in five is a pause, one in five a jump."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._until = 0
        self._input = NEUTRAL

    def __call__(self, world: World, me: int) -> Input:
        if world.tick >= self._until:
            self._until = world.tick + _ticks(world, 0.5 + 1.5 * self._random.random())
            pause, jump = self._random.random() < 0.2, self._random.random() < 0.2
            self._input = NEUTRAL if pause else _heading(self._random, jump=jump)
        return self._input


class RunAndJump:
    """Runs at full speed and jumps whenever it can. Turns every 2 to 6 s, and soon after something blocked it."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._until = 0
        self._input = NEUTRAL

    def __call__(self, world: World, me: int) -> Input:
        vx, vy = world.state(me)[VX : VX + 2]
        stuck = vx == 0 == vy and self._input is not NEUTRAL
        if world.tick >= self._until or (stuck and self._random.random() < 0.2):
            self._until = world.tick + _ticks(world, 2.0 + 4.0 * self._random.random())
            self._input = _heading(self._random, jump=True)
        return self._input


class Follow:
    """Runs after another player up to 1 block from it, and jumps when blocked. Chooses another one every 3 to 7 s."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._until = 0
        self._target = 0

    def __call__(self, world: World, me: int) -> Input:
        if world.tick >= self._until or self._target not in world:
            self._until = world.tick + _ticks(world, 3.0 + 4.0 * self._random.random())
            self._target = self._pick(world, me)
        if not self._target:
            return NEUTRAL
        x, y, _ = world.position(me)
        to_x, to_y, _ = world.position(self._target)
        way = max(abs(to_x - x), abs(to_y - y))
        if way < 1.0:
            return NEUTRAL
        vx, vy = world.state(me)[VX : VX + 2]
        return make_input((to_x - x) / way, (to_y - y) / way, jump=vx == 0 or vy == 0)

    def _pick(self, world: World, me: int) -> int:
        """Returns one of the four nearest entities of the own template; 0 if there is none."""
        states = world.states()
        mine = states[states[:, ID] == me][0]
        alike = states[(states[:, ID] != me) & (states[:, TEMPLATE] == mine[TEMPLATE])]
        if not len(alike):
            return 0
        way = (alike[:, X : X + 2] - mine[X : X + 2]) / BLOCK
        nearest = alike[(way * way).sum(axis=1).argsort(kind="stable")[:4], ID].tolist()
        return int(nearest[int(self._random.random() * len(nearest))])


class DigAndPlace:
    """Wanders, and about twice per second removes a block near itself, or places one where there is air.

    It leaves the lowest layer of the scene alone, so that the world keeps its floor.
    """

    def __init__(self, random: Random) -> None:
        self._random = random
        self._wander = Wander(random)
        self._next = 0

    def __call__(self, world: World, me: int) -> Input:
        return self._wander(world, me)

    def edit(self, world: World, me: int) -> Edit | None:
        """Returns an edit about twice per second, otherwise None."""
        if world.tick < self._next:
            return None
        self._next = world.tick + _ticks(world, 0.2 + 0.6 * self._random.random())
        x, y, z = (int(part // 1) + self._pick(low) for part, low in zip(world.position(me), (-2, -2, -1), strict=True))
        kind = world.blocks.get(x, y, z)
        if kind is None or z <= world.scene.origin[2] * SEGMENT:
            return None
        return Edit(x, y, z, 0 if kind else 1 + int(self._random.random() * 4))

    def _pick(self, low: int) -> int:
        """Returns a random whole number from `low` to 2."""
        return low + int(self._random.random() * (3 - low))


POLICIES: dict[str, Callable[[Random], Policy]] = {
    "stand": Stand,
    "wander": Wander,
    "run-and-jump": RunAndJump,
    "follow": Follow,
    "dig-and-place": DigAndPlace,
}
"""Policies by name."""


def _heading(random: Random, *, jump: bool) -> Input:
    """Returns an input for a random direction at full speed."""
    while True:
        x, y = 2 * random.random() - 1, 2 * random.random() - 1
        length = (x * x + y * y) ** 0.5
        if 0.1 < length <= 1:
            return make_input(x / length, y / length, jump=jump)


def _ticks(world: World, seconds: float) -> int:
    return max(1, round(seconds * world.scene.tick_rate))
