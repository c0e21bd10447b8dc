"""The first inputs of a player: every correction that they cause has a cause."""

import random
from unittest import mock

import pytest

from client_sdk.core import Core
from client_sdk.events import Corrected
from client_sdk.netsim.links import PRESETS
from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match
from tests.lengths import contained, long, long_but


def walking(core: Core, rng: random.Random) -> Input:
    return Input(127, 0, 0)


@pytest.mark.parametrize("seed", long_but([0, 1], range(5)))
def test_late_first_inputs_are_named_as_the_cause_of_corrections(seed: int) -> None:
    """A key is held while joining, and the link stalls when the first inputs leave. The server has no earlier input to
    repeat."""
    match = Match(load_scene("flat"), seed)
    player = match.join(walking, Link(0.02))
    player.core.set_input(Input(127, 0, 0))
    match.run_until(lambda: player.core.state == "playing", 30)
    send, until = player.up.send, match.now + 0.15

    def held(message: bytes) -> None:
        match.at(max(until, match.now), lambda: send(message))

    with mock.patch.object(player.up, "send", held):
        match.run(0.1)
    match.run(4)
    causes = [event.cause for event in player.events if isinstance(event, Corrected)]
    assert causes
    assert set(causes) == {"late input"}
    assert player.core.stats.divergences == 0


@pytest.mark.parametrize("players", [*contained(5), *long(20)])
def test_keys_that_are_held_while_joining_over_bad_lines_are_explained(players: int) -> None:
    for preset in ("typical", "far"):
        match = Match(load_scene("flat"), 1)
        for _ in range(players):
            player = match.join(walking, PRESETS[preset])
            player.core.set_input(Input(127, 0, 0))
            match.run(0.137)
        match.run(3)
        for player in match.players:
            assert player.core.stats.divergences == 0
            assert "nondeterminism" not in player.core.stats.corrections_by_cause
