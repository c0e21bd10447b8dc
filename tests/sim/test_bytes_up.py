"""The bytes that a client sends: a player who walks, and turns now and then."""

import math
import random

import pytest

from client_sdk.core import Core
from client_sdk.events import Corrected
from client_sdk.netsim.links import FRAME_BYTES, PRESETS
from shared.inputs import Input, make_input
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, Player

BYTES_MAX = 250
SECONDS = 30


def walk(core: Core, rng: random.Random) -> Input:
    """Walks all the time, and turns every 1.25 s on average."""
    if core.input == Input() or rng.random() < 1 / 40:
        angle = rng.uniform(0, math.tau)
        return make_input(math.cos(angle), math.sin(angle))
    return core.input


def sent_by(player: Player) -> list[int]:
    """Returns the sizes of the messages that a player sends from now on, in their WebSocket frames."""
    sizes: list[int] = []
    plain = player.up.send

    def send(message: bytes) -> None:
        sizes.append(len(message) + FRAME_BYTES)
        plain(message)

    player.up.send = send  # type: ignore[method-assign]
    return sizes


@pytest.mark.parametrize("link", ["lan", "far"])
def test_a_player_who_walks_and_turns_sends_at_most_250_bytes_a_second(link: str) -> None:
    match = Match(load_scene("arena"), seed=3)
    player = match.join(walk, PRESETS[link])
    match.run_until(lambda: player.core.state == "playing", 30)
    match.run(5)
    sizes = sent_by(player)
    player.events.clear()
    used = player.core.stats.inputs_used
    match.run(SECONDS)
    assert (sum(sizes) + 4 * SECONDS) / SECONDS < BYTES_MAX, "ticks of a server that runs for an hour take 2 bytes more"
    assert player.core.stats.inputs_used - used > 0.97 * SECONDS * 32
    if link == "lan":
        assert player.core.stats.inputs_late == 0
        assert not any(isinstance(event, Corrected) for event in player.events)
