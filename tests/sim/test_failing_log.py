"""Tests of a world on many processes whose log fails, in simulated time."""

import random
from collections import Counter

import pytest

from client_sdk.events import Answered, Corrected, Resumed
from server.scale.clients import EdgeInputs
from server.scale.wire import record_of
from shared.bounds import bounds
from shared.fields import INPUT_ROW_BYTES
from shared.inputs import NEUTRAL, make_input, row
from shared.layout import MOVE_X
from shared.messages import REPEATED, USED, Held, Inputs
from shared.scene import load_scene
from sovereign_netcode.playtest.log import FAILURES, Failure
from sovereign_netcode.playtest.scaled import ScaledMatch, Seat
from tests.lengths import contained, long
from tests.scaling import PATH, ROUGH, Tally, asks, calm, causes, hashes_agree, played_right, roam, slow_walk, torment

FAILS = (2.5, 2.0)
"""A log that fails about every 2.5 s, for up to 2 s."""


def heal(match: ScaledMatch) -> None:
    """Ends all failures of the log, those to come, too."""
    match.log.fails = None
    match.log.heal()


@pytest.mark.parametrize("seconds", [0.2, *long(0.9), 3.0])
@pytest.mark.parametrize("how", FAILURES)
def test_a_log_that_fails_costs_time_and_nothing_else(how: Failure, seconds: float) -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=2, standbys=1, rules=Tally)
    sent: Counter[str] = Counter()
    match.join(asks(sent), PATH)
    match.run(2)
    match.log.fail(how, seconds)
    match.run(seconds)
    calm(match, 4)
    assert match.log.failures > 0 or seconds < 0.5
    assert set(causes(match.players[0])) <= {"late input"}
    played_right(match, sent)


def test_time_stands_still_while_the_log_is_full() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=0)
    match.join(slow_walk, PATH)
    match.run(2)
    before = len(match.log.records)
    match.log.fail("full", 2.0)
    match.run(2)
    assert match.sequencer.still > 40
    assert len(match.log.records) <= before + 1
    calm(match, 4)
    assert len(match.log.records) > before + 100
    played_right(match)


def test_of_a_sequencer_and_a_standby_one_goes_on_when_the_log_does() -> None:
    ends = set()
    for seed in (0, 3, 5):
        match = ScaledMatch(load_scene("flat"), seed, edges=1, standbys=2)
        match.join(slow_walk, PATH)
        match.run(1)
        match.log.fail("full", 1.0 + seed / 40)
        match.run(3)
        epochs = [record.epoch for record in map(record_of, match.log.records)]
        assert epochs == sorted(epochs)
        ends.add(epochs[-1])
        played_right(match)
    assert len(ends) > 1, "at times the sequencer goes on, and at times a standby"


@pytest.mark.parametrize(
    ("seed", "seconds"),
    [*contained((3, 4)), *long(*((seed, 15) for seed in (2, 24, 25, 44)))],
)
def test_nothing_is_lost_or_doubled_while_the_log_fails_and_parts_are_killed(seed: int, seconds: float) -> None:
    match = ScaledMatch(load_scene("meadow"), seed, edges=3, standbys=2, rules=Tally, bus=ROUGH, fails=FAILS)
    sent: Counter[str] = Counter()
    rng = random.Random(seed)
    for _ in range(3 if seconds > 4 else 1):
        match.join(asks(sent), PATH)
    match.run(3)

    roam(match, rng, 0.7)
    torment(match, seconds, seed)
    heal(match)
    calm(match, 10 if seconds > 4 else 5)
    played_right(match, sent)


@pytest.mark.parametrize(("seed", "seconds"), [*contained((2, 4)), *long(*((seed, 15) for seed in (1, 11, 14)))])
def test_a_player_who_is_alone_is_corrected_for_late_inputs_only_while_the_log_fails(seed: int, seconds: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=2, standbys=2, bus=ROUGH, fails=FAILS)
    player = match.join(slow_walk, PATH)
    match.run(3)
    disturb(match, player, seconds, seed)
    heal(match)
    match.add_standby()
    calm(match, 5)
    assert set(causes(player)) <= {"late input"}
    played_right(match)


def disturb(match: ScaledMatch, player: Seat, seconds: float, seed: int) -> None:
    """Holds messages between parts, kills parts and moves the player, by chance."""
    rng, until = random.Random(seed), match.now + seconds

    def act() -> None:
        if match.now > until:
            return
        kind, time_s, edge, leader = rng.randrange(7), rng.uniform(0.05, 1.5), match.some_edge(), match.sequencer.name
        if kind < 4:
            ways = (edge.name, "sequencer"), ("log", edge.name), (leader, "log"), ("log", leader)
            match.bus.hold(*ways[kind], time_s)
        elif kind == 4 and match.sequencer.alive:
            match.add_standby()
            match.kill(match.sequencer, lossy=rng.random() < 0.5)
        elif kind == 5:
            match.add_edge()
            match.kill(edge, lossy=rng.random() < 0.5)
        else:
            player.move(edge)
        if not (match.sequencer.alive or any(standby.alive for standby in match.standbys)):
            match.add_standby()
        match.at(match.now + rng.uniform(0.2, 1.5), act)

    match.at(match.now, act)
    match.run(seconds)


def test_inputs_that_are_withdrawn_after_their_batch_count_as_late() -> None:
    inputs = EdgeInputs(bounds(32), INPUT_ROW_BYTES, NEUTRAL, resumed=False)
    inputs.file(Inputs(5, 0, row(NEUTRAL) * 6), 4, 0.5)
    for tick in range(5, 9):
        inputs.take(tick)
    inputs.restart(7)
    for tick in range(5, 9):
        inputs.confirm(tick, 0)
    assert list(inputs.statuses) == [USED, USED, REPEATED, REPEATED]
    assert (inputs.used, inputs.substituted) == (2, 2)


@pytest.mark.parametrize("beside", [False, True])
def test_an_input_whose_record_comes_before_its_tick_is_taken_holds_from_then_on(beside: bool) -> None:
    inputs, east = EdgeInputs(bounds(32), INPUT_ROW_BYTES, NEUTRAL, resumed=True), make_input(1, 0)
    inputs.file(Inputs(5, 0, row(NEUTRAL) + row(east)), 4, 0.5)
    inputs.hold(Held(1, 0), 4, 0.5)
    assert inputs.take(5) == NEUTRAL
    for tick in (5, 6):
        if beside:
            inputs.skip(tick)
        else:
            inputs.confirm(tick, tick - 5)
    assert inputs.take(7) == east
    if not beside:
        inputs.confirm(7, 0)
        assert list(inputs.statuses) == [REPEATED, USED, REPEATED, USED]


def test_a_command_is_carried_out_once_also_by_a_replica_that_takes_over() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=1, rules=Tally)
    sent: Counter[str] = Counter()
    player = match.join(asks(sent), PATH)
    match.run(3)
    (mine,) = match.standbys[0].replica.kept.players.values()
    assert mine.command == max(mine.settled) >= sent[player.core.name] - 6 > 0


def test_commands_of_a_client_whose_time_went_back_keep_their_order() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=0)
    player = match.join(slow_walk, PATH)
    match.run(3)
    for _ in range(4):
        match.log.fail("full", 1.0)
        match.run(1.6)
    calm(match, 4)
    ticks = [event.number for event in player.events if isinstance(event, Answered)]
    assert ticks == sorted(ticks)
    assert [event for event in player.events if isinstance(event, Corrected) and event.cause != "late input"] == []
    hashes_agree(match)


@pytest.mark.parametrize("killed_s", [0.3, 0.4, 0.5])
def test_an_input_that_does_not_change_is_known_after_a_takeover(killed_s: float) -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=1)
    player = match.join(lambda core, rng: make_input(1.0, 0.0), PATH)
    match.run(2)
    match.bus.hold(match.edges[0].name, "sequencer", 0.6)  # the sequencer neutralises, and so does the log
    match.run(killed_s)
    match.kill(match.sequencer)
    match.run(2)
    assert set(causes(player)) <= {"late input"}
    assert match.sequencer.core.world.state(player.core.entity)[MOVE_X] == 127
    played_right(match)


def test_the_clients_of_an_edge_that_is_killed_play_on_within_a_quarter_second() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=3)
    players = [match.join(slow_walk, PATH) for _ in range(6)]
    match.run(3)
    for edge in match.edges[:2]:
        match.kill(edge)
        match.run(2)
    resumed = [event.away_s for player in players for event in player.events if isinstance(event, Resumed)]
    assert resumed
    assert max(resumed) < 0.25  # most of it is the new terrain: three round trips of 0.06 s
    played_right(match)
