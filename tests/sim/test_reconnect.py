"""A lost connection, in simulated time: the client reconnects by itself and goes on."""

import itertools
import math

import pytest

from client_sdk.core import Core
from client_sdk.events import Answered, Corrected, Disconnected, Joined, Left, Resumed
from client_sdk.netsim.links import PRESETS, Link
from client_sdk.reconnect import Reconnect
from server.config.limits import Limits
from shared import messages
from shared.messages import Bye, encode
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, Player, wander
from tests.lengths import long


def joined(match: Match, player: Player) -> None:
    match.run_until(lambda: player.core.state == "playing", 30)


def events_of(player: Player, *kinds: type) -> list[object]:
    return [event for event in player.events if isinstance(event, kinds)]


@pytest.mark.parametrize(
    ("preset", "seed"), [("typical", 1), *long(("lan", 1), ("far", 1), ("lan", 2), ("typical", 2), ("far", 2))]
)
def test_a_player_whose_connection_is_lost_goes_on_with_the_same_entity(preset: str, seed: int) -> None:
    match = Match(load_scene("hills"), seed)
    player = match.join(wander, PRESETS[preset], Core("Ann", patience_s=10))
    witness = match.join(wander, PRESETS["lan"])
    joined(match, player)
    joined(match, witness)
    entity = player.core.entity
    for round_ in range(1, 4):
        match.run(5)
        player.disconnect()
        assert player.core.state == "reconnecting"
        match.run(0.1)
        assert entity in match.game.world
        match.run_until(lambda: player.core.state == "playing", 10)
        assert player.core.stats.reconnects == round_
    match.run(10)
    assert player.core.entity == entity
    assert match.game.counters.joined == 2
    assert len(events_of(player, Disconnected)) == len(events_of(player, Resumed)) == 3
    assert not events_of(player, Left)
    assert player.core.stats.divergences == 0
    # Afterwards the client plays as before: its world is the server's.
    assert all(event.cause != "nondeterminism" for event in player.events if isinstance(event, Corrected))
    prediction = player.core.prediction
    assert prediction
    world = match.game.world
    assert prediction.confirmed.tick > world.tick - 64


def test_commands_sent_meanwhile_are_carried_out_once() -> None:
    match = Match(load_scene("flat"), 3)
    player = match.join(lambda core, rng: core.input, Link(0.05), Core(patience_s=10))
    joined(match, player)
    match.run(3)
    x, y, z = (int(part // 1) for part in match.game.world.position(player.core.entity))
    first = player.core.edit(x + 2, y, z, 5)
    match.run(0.01)  # on its way
    player.disconnect()
    second = player.core.edit(x + 2, y, z + 1, 6)
    third = player.core.edit(x + 2, y, z + 1, 0)
    match.run(6)
    answers = [event for event in player.events if isinstance(event, Answered)]
    assert [(answer.number, answer.done) for answer in answers] == [(first, True), (second, True), (third, True)]
    assert match.game.world.blocks.get(x + 2, y, z) == 5
    assert match.game.world.blocks.get(x + 2, y, z + 1) == 0
    prediction = player.core.prediction
    assert prediction
    assert prediction.predicted.blocks.get(x + 2, y, z) == 5
    assert player.core.stats.divergences == 0


def test_a_player_whose_entity_was_not_kept_joins_anew() -> None:
    match = Match(load_scene("flat"), 4, limits=Limits(resume_s=0.1))
    player = match.join(wander, Link(0.05), Core(patience_s=10))
    joined(match, player)
    match.run(3)
    entity = player.core.entity
    player.disconnect()
    number = player.core.edit(0, 0, 0, 5)
    match.run_until(lambda: player.core.state == "playing", 10)
    assert player.core.entity not in (0, entity)
    assert [event.entity for event in player.events if isinstance(event, Joined)] == [entity, player.core.entity]
    assert not events_of(player, Resumed)
    assert [event for event in player.events if isinstance(event, Answered)] == [
        Answered(number, False, "the connection was lost")
    ]
    match.run(5)
    assert player.core.stats.divergences == 0


def test_a_client_without_patience_or_closed_for_good_does_not_reconnect() -> None:
    match = Match(load_scene("flat"), 5)
    impatient = match.join(wander, Link(0.05), Core(patience_s=0))
    rude = match.join(wander, Link(0.05), Core(patience_s=10))
    for player in (impatient, rude):
        joined(match, player)
    impatient.disconnect()
    rude.core._out.append(b"\xff")
    match.run(5)
    for player in (impatient, rude):
        assert player.core.state == "closed"
        assert len(events_of(player, Left)) == 1
        assert not events_of(player, Disconnected)


def test_a_reconnect_whose_hello_was_too_slow_is_tried_again() -> None:
    match = Match(load_scene("flat"), 6)
    player = match.join(wander, Link(0.05), Core(patience_s=10))
    joined(match, player)
    entity = player.core.entity
    player.disconnect()
    match.run_until(lambda: player.session is not None, 5)
    assert player.core.state == "reconnecting"
    player.core.receive(encode(Bye(messages.NO_HELLO, "no hello within 5 s", -1.0)), player.local)
    assert player.core.state == "reconnecting"
    player.disconnect()
    match.run_until(lambda: player.core.state == "playing", 10)
    assert player.core.entity == entity
    assert not events_of(player, Left)


def test_waits_grow_spread_and_end() -> None:
    reconnect = Reconnect(30.0, spread=7)
    now, waits = 100.0, []
    while reconnect.lost(now):
        waits.append(reconnect.retry_at - now)
        now = reconnect.retry_at
        reconnect.trying()
    assert 100.0 + 25 < now < 130.0
    assert 0.25 <= waits[0] <= 0.32
    assert all(a < b or b > 3.9 for a, b in itertools.pairwise(waits))
    assert max(waits) <= 5.0
    assert reconnect.away_s(now) == now - 100.0
    reconnect.back()
    assert reconnect.lost(now)
    assert reconnect.retry_at - now <= 0.32
    firsts = set()
    for spread in range(50):
        other = Reconnect(30.0, spread)
        assert other.lost(0.0, 2.0)
        firsts.add(round(other.retry_at, 3))
    assert len(firsts) == 50
    assert (min(firsts) >= 2.0, max(firsts) <= 2.5) == (True, True)


def test_patience_without_end_has_none() -> None:
    reconnect = Reconnect(math.inf)
    now = 0.0
    for _ in range(2000):
        assert reconnect.lost(now)
        assert 0 < reconnect.retry_at - now <= 5.0
        now = reconnect.retry_at


@pytest.mark.parametrize("spread", range(12))
def test_a_long_wait_that_was_asked_for_is_waited_and_not_taken_from_the_patience(spread: int) -> None:
    reconnect = Reconnect(30.0, spread)
    assert reconnect.lost(0.0, 300.0)
    assert 300 <= reconnect.retry_at <= 375
    back, now = reconnect.retry_at, reconnect.retry_at
    while reconnect.lost(now):
        now = reconnect.retry_at
    assert 20 < now - back <= 30
