"""Tests of kills of each part at each kind of instant, in simulated time.

A tick of the sequencer is at offset 0. On this bus a message takes 1 to 2 ms. So the offsets are before and after the
record is appended, before and after its acknowledgement, before and after it has come to the edges, before and after a
batch has come, and between two ticks. The run they are tried in has a hand-over, a join, and players with commands.
"""

from collections import Counter

import pytest

from client_sdk.events import Joined
from shared.scene import load_scene
from sovereign_netcode.playtest.parts import Part
from sovereign_netcode.playtest.scaled import ScaledMatch, Seat
from tests.scaling import PATH, Tally, asks, calm, played_right

OFFSETS_MS = (-6.0, -3.0, 0.1, 1.1, 1.6, 2.5, 3.5, 5.0, 15.0)
"""Instants within a tick, in ms after it."""
TICKS = range(24)
"""Ticks of the hand-over and of the join."""
STEP, SILENCE_STEP = 19, 5
"""Distances of the instants that a long run plays. Both have no divisor in common with the number of offsets, so all
offsets are among these instants."""
SILENCE_TICKS = range(7, 11)
"""Ticks after the end of a sequencer in which a standby begins the next epoch."""
PARTS = ("sequencer", "former edge", "next edge", "standby", "sequencer and former edge", "standby that takes over")


def play(who: str, tick: int, offset_ms: float, *, lossy: bool) -> None:
    """Plays a run in which a part is killed at an instant, and checks it."""
    match = ScaledMatch(load_scene("flat"), tick + 1, edges=2, standbys=2, rules=Tally)
    sent: Counter[str] = Counter()
    player = match.join(asks(sent), PATH)
    match.run(1.5)
    former = player.edge
    assert former is not None
    other = next(edge for edge in match.edges if edge is not former)
    begins = match.sequencer._began + (match.sequencer._ticks + 1) / match.rate
    parts: dict[str, list[Part]] = {
        "sequencer": [match.sequencer],
        "former edge": [former],
        "next edge": [other],
        "standby": [match.standbys[0]],
        "sequencer and former edge": [match.sequencer, former],
        "standby that takes over": [match.standbys[0]],
    }

    def kill() -> None:
        for part in parts[who]:
            leads = who == "standby that takes over" and match.sequencer.name == part.name
            match.kill(match.sequencer if leads else part, lossy=lossy)
        if not any(edge.alive for edge in match.edges if edge is not former):
            match.add_edge()

    if who == "standby that takes over":
        match.at(begins, lambda: match.kill(match.sequencer))
    match.at(begins, lambda: handed_over(player, other.address))
    match.at(begins + 0.3, lambda: joins(match, sent))
    match.at(begins + tick / match.rate + offset_ms / 1e3, kill)
    match.run(2.0)
    calm(match, 3.0)
    second = match.players.pop()
    if any(isinstance(event, Joined) for event in second.events):
        match.players.append(second)
    else:  # the edge was killed before the player had joined, and then its program has to connect again
        assert second.core.state == "closed"
    played_right(match, sent)


def handed_over(player: Seat, address: str) -> None:
    """Begins a hand-over if the edge of the player lives."""
    edge = player.match.at_address(address)
    if edge is not None:
        player.move(edge)


def joins(match: ScaledMatch, sent: Counter[str]) -> None:
    """Lets a second player join."""
    match.join(asks(sent), PATH)


def instants(who: str) -> list[tuple[int, float]]:
    """Returns all ticks and offsets of a part."""
    ticks = SILENCE_TICKS if who == "standby that takes over" else TICKS
    return [(tick, offset) for tick in ticks for offset in OFFSETS_MS]


@pytest.mark.parametrize("who", PARTS)
def test_a_kill_loses_and_doubles_nothing(who: str) -> None:
    tick, offset_ms = instants(who)[len(who) % 20]
    play(who, tick, offset_ms, lossy=True)


@pytest.mark.slow
@pytest.mark.parametrize("lossy", [False, True], ids=["sent", "lost"])
@pytest.mark.parametrize("who", PARTS)
def test_a_kill_at_any_instant_loses_and_doubles_nothing(who: str, lossy: bool) -> None:
    step = SILENCE_STEP if who == "standby that takes over" else STEP
    for tick, offset_ms in instants(who)[lossy::step]:
        play(who, tick, offset_ms, lossy=lossy)
