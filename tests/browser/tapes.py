"""Matches in simulated time with one client on a tape."""

import random
from typing import Any, NamedTuple

from client_sdk.core import Core
from client_sdk.netsim.links import PRESETS, Link
from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from tests.behaving import CLASSES, Playground, Presser
from tests.browser.replayed import Tape
from tests.browser.taped import TapedCore


class Recorded(NamedTuple):
    """A tape, and the statistics and events of the client that recorded it."""

    tape: Tape
    corrections: int
    replayed: int
    sent: int


def walkers(seconds: float, players: int = 12, link: str = "wifi", scene: str = "arena") -> Recorded:
    """Returns the tape of a player among others who walk, with a block placed and a lost connection in between."""
    match = Match(load_scene(scene), seed=5)
    core = TapedCore("taped", patience_s=10.0)
    player = match.join(wander, PRESETS[link], core)
    for _ in range(players - 1):
        match.join(wander, PRESETS[link])
    match.run(seconds / 2)
    assert core.prediction is not None
    x, y, z = core.prediction.predicted.position(core.entity)
    core.edit(int(x) + 1, int(y) + 1, int(z), 1)
    match.run(0.5)
    player.disconnect()
    match.run(seconds / 2)
    return recorded(core, behaves=False)


def acrobats(seconds: float, players: int = 5, link: str = "far") -> Recorded:
    """Returns the tape of a player whose behaviours use all abilities, among others of the same kind."""
    match = Match(load_scene("flat"), seed=8, rules=Playground())
    core = TapedCore("taped", patience_s=10.0, behaviours=CLASSES)
    match.join(Presses(3), PRESETS[link], core)
    for number in range(players - 1):
        match.join(Presses(number), Link() if number == 0 else PRESETS[link])
    core.set_input_delay(1)
    match.run(seconds)
    return recorded(core, behaves=True)


class Presses:
    """A policy that presses buttons at random."""

    def __init__(self, seed: int) -> None:
        self._presser, self._rng = Presser(), random.Random(seed)

    def __call__(self, core: Core, rng: Any) -> Input:
        return self._presser.next(self._rng)


def recorded(core: TapedCore, *, behaves: bool) -> Recorded:
    """Returns the tape of a core that has played."""
    assert core.state == "playing"
    assert core.stats.divergences == 0
    tape = Tape(core.tape(), behaves)
    return Recorded(tape, core.stats.corrections, core.stats.replayed_ticks, core.stats.inputs_sent)
