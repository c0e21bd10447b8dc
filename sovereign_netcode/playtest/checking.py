"""The check of a game's behaviours: their turns must compute the same, whenever and wherever they are computed.

    from sovereign_netcode.playtest import check_behaviours

    def test_behaviours() -> None:
        check_behaviours(MyGame())

A turn that reads a clock, `random` or a variable that turns change computes something else when a client plays its tick
again. A turn that depends on the order of a set of texts, or on `hash` or `id`, computes something else in another
process. The check plays a match and looks for both.
"""

import io
import itertools
import random

import numpy as np

from client_sdk.core import Core
from client_sdk.events import BehaviourFailed, Corrected, Diverged
from client_sdk.netsim.links import Link
from client_sdk.prediction.prediction import NONDETERMINISM
from server.rules import Rules
from shared.behaviours import Behaviour
from shared.checks import whole
from shared.inputs import Input, make_input
from shared.layout import CELL, ID, TEMPLATE, Int64s
from shared.scene import Scene, load_scene
from sovereign_netcode.playtest.elsewhere import played_elsewhere
from sovereign_netcode.playtest.match import Match, Player

FAR = Link(0.15, 0.04)
"""The link of the players: a client is about ten ticks ahead, so each tick is played again about ten times."""
HOLD_TICKS = 12
"""Greatest number of ticks for which the players press the same buttons."""
JOIN_S = 30.0
"""Simulated time until all players must have joined, in seconds."""
HASH_SEEDS = (0, 1, 2)
"""Seeds of the hashes of texts (PYTHONHASHSEED) in the other processes."""
AGAIN = "when its tick was played again. Look for a clock, `random`, or a variable that a turn changes"
ELSEWHERE = "in another process. Look for the order of a set, `hash` or `id`, or a file or clock"


class BehaviourCheckError(AssertionError):
    """A turn of a behaviour has failed, or computes something else when it is computed again."""


class RandomPlayer:
    """A policy that presses the scene's buttons, walks and aims at random. Each input lasts some ticks."""

    def __init__(self) -> None:
        self._left, self._input = 0, Input()

    def __call__(self, core: Core, rng: random.Random) -> Input:
        self._left -= 1
        if self._left < 0:
            assert core.scene is not None
            self._left, self._input = rng.randrange(HOLD_TICKS), _pressed(core.scene, rng)
        return self._input


def check_behaviours(
    rules: Rules,
    scene: str | Scene | None = None,
    *,
    ticks: int = 600,
    seed: int = 1,
    players: int = 3,
    processes: int = len(HASH_SEEDS),
) -> None:
    """Plays a match with players who press random buttons, and checks the turns of the game's behaviours.

    In every tick, each client plays all ticks again that the server has not confirmed (the sync test). Then other
    processes replay the recording of the match. All states must be the same bits.

    Args:
        rules: the rules of the game.
        scene: a scene, or its name; None: the rules' own, otherwise "flat".
        ticks: number of ticks of the match.
        seed: seed of the match.
        players: number of players.
        processes: number of other processes, 0 to 3; each takes about as long as the match. They import the modules of
            the behaviours.

    Raises:
        BehaviourCheckError: a turn computes something else when it is computed again, or has raised an exception. The
            message has the tick, the entity, the field and the behaviour.
        SceneError: an argument is out of range.
        ValueError: a behaviour cannot be imported in another process.
    """
    whole(ticks, "ticks", 1, 1 << 20)
    whole(players, "players", 1, 255)
    whole(processes, "processes", 0, len(HASH_SEEDS))
    named = scene if scene is not None else rules.scene or "flat"
    match = Match(load_scene(named) if isinstance(named, str) else named, seed, rules=rules)
    recording, states = io.BytesIO(), {}
    world = match.game.world
    world.record(recording)
    for _ in range(players):
        match.join(RandomPlayer(), FAR)

    def check() -> None:
        states[world.tick] = world.states()
        for player in match.players:
            _check_again(player, world.scene)

    match.on_tick.append(check)
    match.run_until(lambda: all(player.core.state == "playing" for player in match.players), JOIN_S)
    match.run(ticks / world.scene.tick_rate)
    world.end_recording()
    for player in match.players:
        _check_events(player)
    for hash_seed in HASH_SEEDS[:processes]:
        for tick, there in played_elsewhere(recording.getvalue(), classes_of(world.scene), hash_seed):
            if tick in states and there.tobytes() != states[tick].tobytes():
                raise BehaviourCheckError(difference(world.scene, tick, states[tick], there, ELSEWHERE))


def classes_of(scene: Scene) -> list[type[Behaviour]]:
    """Returns the classes of a scene's behaviours."""
    return [entry.code for entry in scene.behaviours if entry.code is not None]


def difference(scene: Scene, tick: int, was: Int64s, now: Int64s, when: str) -> str:
    """Returns a text about the first difference between two results for the states of one tick.

    Args:
        scene: the scene.
        tick: the tick.
        was: the states, ascending by id.
        now: the states as they were computed again.
        when: how they were computed again, for the end of the text.
    """
    first, second = ({state[ID]: state for state in states.tolist()} for states in (was, now))
    for entity in sorted(first.keys() | second.keys()):
        a, b = first.get(entity), second.get(entity)
        if a is None or b is None:
            there = "is there, but not" if b is None else "is not there, but is"
            return f"tick {tick}: entity {entity} ({_behaviour(scene, a or b)}) {there} {when}"
        for k in np.flatnonzero(np.array(a) != np.array(b)).tolist():
            name = f"{_behaviour(scene, a)}.{_column(scene, a, k)}"
            return f"tick {tick}: entity {entity}, {name} = {a[k]}, but {b[k]} {when}"
    return f"tick {tick}: the states differ {when}"


def _pressed(scene: Scene, rng: random.Random) -> Input:
    """Returns a random input for a scene; each fifth one is neutral."""
    if rng.random() < 0.2:
        return Input()
    buttons = scene.buttons_bits([name for name in scene.buttons if rng.random() < 0.3])
    walk = rng.choice((0.0, rng.uniform(-1, 1))), rng.choice((0.0, rng.uniform(-1, 1)))
    aim = [rng.uniform(-1, 1) for _ in range(3)] if scene.aim and rng.random() < 0.5 else None
    return make_input(*walk, buttons=buttons, aim=aim)


def _check_again(player: Player, scene: Scene) -> None:
    """Runs the sync test of a player's client.

    Raises:
        BehaviourCheckError: it has changed something.
    """
    prediction = player.core.prediction
    if prediction is None or not prediction.begun:
        return
    changed = prediction.sync_test()
    if changed is not None:
        raise BehaviourCheckError(difference(scene, *changed, AGAIN))


def _check_events(player: Player) -> None:
    """Checks the events of a player's client.

    Raises:
        BehaviourCheckError: a turn has failed, or client and server differ without a cause.
    """
    for event in player.events:
        if isinstance(event, BehaviourFailed):
            raise BehaviourCheckError(
                f"tick {event.tick}: entity {event.entity}, {event.behaviour}: the turn has failed: {event.error}"
            )
        if isinstance(event, Diverged) or (isinstance(event, Corrected) and event.cause == NONDETERMINISM):
            raise BehaviourCheckError(f"entity {player.core.entity}: client and server differ: {event}")


def _behaviour(scene: Scene, state: list[int] | None) -> str:
    """Returns the name of the behaviour of a state's entity, or of its template if it has none."""
    assert state is not None
    index = int(scene.extras.behaviour_of[state[TEMPLATE]]) if scene.extras.count else -1
    return scene.behaviours[index].name if index >= 0 else scene.templates[state[TEMPLATE]].name


def _column(scene: Scene, state: list[int], column: int) -> str:
    """Returns the name of a column of a state."""
    extras = scene.extras
    if column < CELL + extras.first or not scene.behaviours:
        return extras.names[column]
    fields = scene.behaviours[extras.behaviour_of[state[TEMPLATE]]].fields
    return next(itertools.islice((each.name for each in fields), column - CELL - extras.first, None), "?")
