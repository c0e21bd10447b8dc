"""Tests of a world on many processes, in simulated time: equal replicas, kills of every part, late batches."""

import random
from collections import Counter

import msgpack
import pytest

from client_sdk.core import Core
from client_sdk.events import (
    Answered,
    Corrected,
    Disconnected,
    Diverged,
    EventsDropped,
    HandedOver,
    Happened,
    Resumed,
    Resynchronised,
)
from client_sdk.netsim.links import PRESETS, Link
from server.config.limits import Limits
from server.journal.recorded_world import RecordedWorld
from server.scale import checkpoint, moves
from server.scale.wire import record_of
from shared.inputs import Input, make_input
from shared.scene import load_scene
from sovereign_netcode.playtest.match import wander
from sovereign_netcode.playtest.scaled import ScaledMatch, Seat
from tests.lengths import contained, long
from tests.scaling import PATH, ROUGH, Tally, asks, calm, causes, edits, hashes_agree, roam, torment


def test_a_player_who_is_alone_has_no_corrections() -> None:
    match = ScaledMatch(load_scene("hills"), 1, edges=3)
    player = match.join(edits, PATH)
    match.run(20)
    assert causes(player) == Counter()
    assert player.core.stats.inputs_used > 500
    assert player.core.stats.inputs_substituted == 0
    assert {event.done for event in player.events if isinstance(event, Answered)} >= {True}
    hashes_agree(match)


def test_all_edges_encode_the_same_changes() -> None:
    match = ScaledMatch(load_scene("meadow"), 2, edges=3, rules=Tally)
    sent: Counter[str] = Counter()
    for _ in range(4):
        match.join(asks(sent), PATH)
    compared = 0
    for _ in range(40):
        match.run(0.1)
        logs = [edge.core.log for edge in match.edges if edge.core.world.tick == match.edges[0].core.world.tick]
        for ago in (0, 1, 7):
            deltas = [log.since(max(match.edges[0].core.world.tick - ago, 0)) for log in logs]
            for segment in match.scene.segments():
                assert len({delta[segment] for delta in deltas}) == 1
                compared += len(deltas) > 1
    assert compared > 100
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, 2, *long(*range(3, 7))])
def test_no_kill_loses_or_doubles_a_command(seed: int) -> None:
    match = ScaledMatch(load_scene("meadow"), seed, edges=4, standbys=2, rules=Tally, bus=ROUGH)
    sent: Counter[str] = Counter()
    for _ in range(4):
        match.join(asks(sent), PATH)
    match.run(3)
    torment(match, 12, seed)
    calm(match)
    shared = match.sequencer.core.api.shared
    assert match.sequencer.core.epoch > 2
    for player in match.players:
        answered = Counter(event.number for event in player.events if isinstance(event, Answered))
        assert player.core.state == "playing"
        assert set(answered.values()) == {1}, "each command is answered once"
        assert shared[player.core.name] == sent[player.core.name] == len(answered), "and was carried out once"
        assert not any(isinstance(event, Diverged) for event in player.events)
    hashes_agree(match)


@pytest.mark.parametrize("seed", [5, *long(6, 7)])
def test_late_batches_are_late_inputs_and_nothing_else(seed: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=2, bus={"stop": (1.0, 0.15), "twice": 0.1})
    player = match.join(wander, PATH)
    match.run(40)
    assert sum(edge.clock.late for edge in match.edges) > 5
    assert set(causes(player)) <= {"late input"}
    assert player.core.stats.inputs_substituted > 0
    assert player.core.stats.divergences == 0
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(*range(2, 7))])
def test_a_player_who_is_alone_is_corrected_for_late_inputs_only_when_parts_are_killed(seed: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=3, standbys=2, bus=ROUGH)
    player = match.join(edits, PATH)
    match.run(3)
    torment(match, 15, seed)
    calm(match)
    assert player.core.state == "playing"
    assert set(causes(player)) <= {"late input"}
    assert not any(isinstance(event, Diverged) for event in player.events)
    hashes_agree(match)


def test_an_edge_far_behind_the_sequencer_keeps_its_clients() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=0, bus={"far": {"edge 1": 0.7}})
    player = match.join(wander, PATH)
    match.run(12)
    assert player.core.state == "playing"
    assert set(causes(player)) <= {"late input"}
    assert not any(isinstance(event, Disconnected) for event in player.events)
    hashes_agree(match)


def test_the_clients_of_an_edge_that_is_cut_off_go_on_at_another_one() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=2)
    player = match.join(wander, PATH)
    match.run(3)
    entity, edge = player.core.entity, player.edge
    assert edge is not None
    match.bus.hold(edge.name, "sequencer", 60.0)
    match.run(4)
    assert (player.core.state, player.core.entity) == ("playing", entity)
    assert player.edge not in (None, edge)
    hashes_agree(match)


def test_a_player_may_come_back_for_long_after_a_takeover(monkeypatch: pytest.MonkeyPatch) -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=2, standbys=1)
    player = match.join(wander, PATH)
    match.run(3)
    entity, edge = player.core.entity, player.edge
    assert edge is not None
    match.kill(match.sequencer)
    match.run(1)
    with monkeypatch.context() as patch:
        patch.setattr(match, "route", lambda path: "no edge answers")
        match.kill(edge)
        match.run(5)
    match.run(10)
    assert (player.core.state, player.core.entity) == ("playing", entity)
    hashes_agree(match)


def test_commands_wait_while_time_stands_still() -> None:
    match = ScaledMatch(load_scene("flat"), 1, edges=1, standbys=0, rules=Tally)
    sent: Counter[str] = Counter()
    player = match.join(asks(sent), PATH)
    match.run(3)
    match.bus.hold(match.sequencer.name, "log", 3.0)
    match.run(3)
    calm(match, 8)
    answers = [event for event in player.events if isinstance(event, Answered)]
    assert len(answers) == sent[player.core.name]
    assert {event.verdict for event in answers} == {"done"}
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(2)])
def test_a_lost_batch_is_sent_again(seed: int) -> None:
    match = ScaledMatch(load_scene("meadow"), seed, edges=2, rules=Tally, bus={"lost": 0.01, "twice": 0.02})
    sent: Counter[str] = Counter()
    for _ in range(2):
        match.join(asks(sent), PATH)
    match.run(20)
    calm(match)
    assert sum(edge.clock.late for edge in match.edges) > 5
    for player in match.players:
        answered = Counter(event.number for event in player.events if isinstance(event, Answered))
        assert set(answered.values()) == {1}
        assert match.sequencer.core.api.shared[player.core.name] == sent[player.core.name] == len(answered)
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(2)])
def test_a_replica_from_a_checkpoint_goes_on_as_the_others(seed: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=1, rules=Tally)
    sent: Counter[str] = Counter()
    match.join(asks(sent), PATH)
    match.join(edits, PATH)
    match.run(6)
    source = match.standbys[0].replica
    fresh = RecordedWorld(match.scene)
    fresh.load_terrain()
    replica, last = checkpoint.decoded(checkpoint.encoded(source, "1:7:a"), fresh)
    assert last == "1:7:a"
    assert replica.world.state_hash() == source.world.state_hash()
    assert (replica.homes, replica.batches, replica.events) == (source.homes, source.batches, source.events)
    match.standbys[0].alive = False
    match.edges.append(match._edge(replica))
    second = match.join(wander, PATH)
    second.core.travel.path = match.edges[-1].name
    match.run(6)
    assert second.core.shared == match.players[0].core.shared
    hashes_agree(match)


def test_a_checkpoint_of_another_format_is_refused() -> None:
    fresh = RecordedWorld(load_scene("flat"))
    fresh.load_terrain()
    data = msgpack.packb([0, "", [], [], [], [], []])
    with pytest.raises(ValueError, match="format 0"):
        checkpoint.decoded(data, fresh)


def test_a_deposed_sequencer_is_refused_and_ends() -> None:
    match = ScaledMatch(load_scene("flat"), 3, edges=2, standbys=1)
    player = match.join(wander, PATH)
    match.run(3)
    old = match.sequencer
    match.bus.hold(old.name, "log", 1.0)
    match.run(3)
    assert match.sequencer is not old
    assert not old.alive
    assert match.log.refused > 0
    assert {record_of(data).epoch for data in match.log.records} == {1, 2}
    assert player.core.state == "playing"
    hashes_agree(match)


def test_a_new_edge_catches_up_and_serves() -> None:
    match = ScaledMatch(load_scene("meadow"), 4, edges=1, rules=Tally)
    sent: Counter[str] = Counter()
    match.join(asks(sent), PATH)
    match.run(5)
    edge = match.add_edge()
    core = Core("late", patience_s=60.0)
    core.travel.server = edge.address
    second = match.join(wander, PATH, core)
    match.run(5)
    assert (second.edge, second.core.state) == (edge, "playing")
    assert second.core.shared == match.players[0].core.shared
    hashes_agree(match)


def test_a_player_keeps_its_entity_when_its_edge_is_killed() -> None:
    match = ScaledMatch(load_scene("meadow"), 5, edges=2, rules=Tally)
    sent: Counter[str] = Counter()
    player = match.join(asks(sent), PATH)
    match.run(4)
    entity, edge = player.core.entity, player.edge
    assert edge is not None
    match.kill(edge)
    match.run(4)
    assert (player.core.state, player.core.entity) == ("playing", entity)
    assert player.edge not in (None, edge)
    assert len(match.sequencer.core.api.players) == 1
    hashes_agree(match)


def test_a_player_leaves_and_the_others_see_it() -> None:
    match = ScaledMatch(load_scene("meadow"), 6, edges=2, limits=Limits(resume_s=1.0))
    first, second = match.join(wander, PATH), match.join(wander, PATH)
    match.run(3)
    first.core.close()
    first._flush()
    match.run(3)
    assert len(match.sequencer.core.world) == 1
    assert [len(edge.core.players) for edge in match.edges] == [1, 1]
    assert second.core.state == "playing"
    hashes_agree(match)


def tour(match: ScaledMatch, player: Seat, seconds: float, every: float = 5.0) -> int:
    """Runs a match while a player changes to the next edge every `every` seconds. Returns the number of changes."""
    moves = 0
    until = match.now + seconds
    while match.now < until:
        before = player.edge
        living = [edge for edge in match.edges if edge.alive]
        if before in living and player.move(living[(living.index(before) + 1) % len(living)]):
            match.run(every)
            moves += player.edge not in (before, None)
        else:
            match.run(every)
    return moves


@pytest.mark.parametrize(("seed", "seconds"), [*contained((1, 30)), *long((2, 100))], ids=["short", "long"])
def test_a_lone_player_who_is_moved_between_edges_has_no_corrections(seed: int, seconds: float) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=4)
    player = match.join(edits, Link(delay_s=0.03))  # without jitter, so that no input is late by itself
    match.run(3)
    assert tour(match, player, seconds) == seconds // 5
    stats = player.core.stats
    assert causes(player) == Counter()
    assert (stats.corrections, stats.divergences, stats.reconnects, stats.resyncs) == (0, 0, 0, 0)
    assert stats.inputs_used > 30 * seconds
    assert not any(isinstance(event, (Disconnected, Resumed, Resynchronised)) for event in player.events)
    assert {event.done for event in player.events if isinstance(event, Answered)} >= {True}
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(*range(2, 6))])
def test_a_change_while_batches_of_the_former_edge_are_late_is_exact(seed: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=2, bus={"jitter_s": 0.002})

    def turns(core: Core, rng: random.Random) -> Input:
        held = int(core.prediction.predicted.tick / 40) % 2 if core.prediction else 0  # the same for a second and more
        return make_input(1.0 - 2.0 * held, 0.0)

    player = match.join(turns, PATH)
    match.run(3)
    for _ in range(6):
        here, there = player.edge, next(edge for edge in match.edges if edge is not player.edge)
        assert here is not None
        player.move(there)
        while player.edge is here:
            match.bus.hold(here.name, "sequencer", match.rng.uniform(0.0, 0.2))
            match.run(0.1)
    assert set(causes(player)) <= {"late input"}
    assert player.core.stats.divergences == 0
    hashes_agree(match)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(Link(delay_s=0.03, jitter_s=0.02, loss=0.02), id="loss"),
        pytest.param(Link(delay_s=0.09, jitter_s=0.025, loss=0.02), id="far", marks=pytest.mark.slow),
        pytest.param(PRESETS["wifi"], id="wifi", marks=pytest.mark.slow),
    ],
)
def test_a_hand_over_on_a_bad_line_costs_late_inputs_only(path: Link) -> None:
    match = ScaledMatch(load_scene("hills"), 3, edges=3)
    player = match.join(edits, path)
    match.run(5)
    assert tour(match, player, 20) >= 3
    assert set(causes(player)) <= {"late input"}
    assert (player.core.stats.divergences, player.core.stats.reconnects) == (0, 0)
    hashes_agree(match)


@pytest.mark.slow
def test_edits_come_at_their_ticks_while_a_player_changes_edges() -> None:
    match = ScaledMatch(load_scene("hills"), 5, edges=4, hash_every=32)

    def builds(core: Core, rng: random.Random) -> Input:
        if rng.random() < 0.3:
            assert core.prediction is not None
            x, y, z = (int(part) + rng.randint(-1, 1) for part in core.prediction.predicted.position(core.entity))
            core.edit(x, y, z, rng.randint(0, 1))
        return wander(core, rng)

    player = match.join(builds, Link(delay_s=0.03))
    match.run(3)
    assert tour(match, player, 60, every=2.0) == 30
    assert [event for event in player.events if isinstance(event, (Corrected, Diverged, Resynchronised))] == []
    assert sum(isinstance(event, Answered) for event in player.events) > 400


def test_inputs_have_no_gap_while_terrain_is_on_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    match = ScaledMatch(load_scene("hills"), 7, edges=2)
    player = match.join(wander, Link(delay_s=0.03))
    match.run(3)
    here, there = player.edge, next(edge for edge in match.edges if edge is not player.edge)
    player.move(there)
    match.run_until(lambda: any(getattr(each.inputs, "switching", False) for each in there.core.sessions), 3)
    assert player.core.handover is not None
    assert player.core.handover.replica is not None
    monkeypatch.setattr(player.core.handover.replica.confirmed, "grounded", lambda: False)
    match.run(0.1)
    assert player.edge is here
    monkeypatch.undo()
    match.run(3)
    stats = player.core.stats
    assert player.edge is there
    assert (stats.inputs_refused, stats.inputs_substituted, stats.resyncs, stats.corrections) == (0, 0, 0, 0)


def test_an_edge_that_drains_hands_over_all_its_clients_and_takes_no_more() -> None:
    match = ScaledMatch(load_scene("meadow"), 4, edges=3, rules=Tally)
    sent: Counter[str] = Counter()
    players = [match.join(asks(sent), PATH) for _ in range(6)]
    match.run(3)
    edge = match.edges[0]
    here = [player for player in players if player.edge is edge]
    edge.core.drain()
    match.run(4)
    assert here
    assert edge.core.drained
    assert [each.address for each in match.edges[1:]] == sorted(match.edges[0].core.moves.others)
    for player in here:
        assert [type(event) for event in player.events if isinstance(event, (HandedOver, Resumed, Disconnected))] == [
            HandedOver
        ]
    core = Core("late", patience_s=60.0)
    core.travel.server = edge.address
    late = match.join(wander, PATH, core)
    match.run(3)
    assert late.core.state == "playing", "it was sent to another edge before it had joined"
    assert late.edge in match.edges[1:]
    match.kill(edge)
    calm(match)
    for player in players:
        assert [event.data for event in player.events if isinstance(event, Happened)] == [
            *range(1, sent[player.core.name] + 1)
        ]
    hashes_agree(match)


def test_a_client_that_ignores_the_request_is_closed_and_comes_back_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    match = ScaledMatch(load_scene("meadow"), 5, edges=2)
    player = match.join(wander, PATH)
    match.run(3)
    edge, entity = player.edge, player.core.entity
    assert edge is not None
    monkeypatch.setattr(player.core, "_begin_handover", lambda asked, now: None)
    edge.core.drain()
    match.run(moves.HANDOVER_S + 3)
    assert (player.core.state, player.core.entity) == ("playing", entity)
    assert player.edge not in (None, edge)
    assert [type(event) for event in player.events if isinstance(event, (Disconnected, Resumed))] == [
        Disconnected,
        Resumed,
    ]


def test_clients_know_the_edges_that_live() -> None:
    match = ScaledMatch(load_scene("flat"), 6, edges=3)
    player = match.join(wander, PATH)
    match.run(3)
    here = player.edge
    others = [edge for edge in match.edges if edge is not here]
    assert sorted(player.core.travel.edges) == [edge.address for edge in others]
    match.kill(others[0])
    match.run(2)
    assert player.core.travel.edges == [others[1].address]
    match.add_standby()
    match.kill(match.sequencer)
    added = match.add_edge()
    match.run(2)
    assert sorted(player.core.travel.edges) == sorted([others[1].address, added.address])
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(*range(2, 6))])
def test_events_and_commands_come_once_over_all_edges(seed: int) -> None:
    match = ScaledMatch(load_scene("meadow"), seed, edges=3, rules=Tally, bus=ROUGH)
    sent: Counter[str] = Counter()
    player, other = match.join(asks(sent), PATH), match.join(asks(sent), PATH)
    match.run(3)
    assert tour(match, player, 20, every=2.0) == 10
    calm(match)
    for each in (player, other):
        assert [event.data for event in each.events if isinstance(event, Happened)] == [
            *range(1, sent[each.core.name] + 1)
        ]
        assert not any(isinstance(event, EventsDropped) for event in each.events)
        answered = Counter(event.number for event in each.events if isinstance(event, Answered))
        assert set(answered.values()) == {1}
        assert match.sequencer.core.api.shared[each.core.name] == sent[each.core.name] == len(answered)
    hashes_agree(match)


@pytest.mark.parametrize("seed", [1, *long(*range(2, 6))])
def test_kills_while_players_move_between_edges(seed: int) -> None:
    match = ScaledMatch(load_scene("meadow"), seed, edges=4, standbys=2, rules=Tally, bus=ROUGH)
    sent: Counter[str] = Counter()
    rng = random.Random(seed)
    for _ in range(3):
        match.join(asks(sent), PATH)
    match.run(3)

    roam(match, rng, 0.4)
    torment(match, 12, seed)
    calm(match)
    for player in match.players:
        answered = Counter(event.number for event in player.events if isinstance(event, Answered))
        assert player.core.state == "playing"
        assert set(answered.values()) == {1}
        assert match.sequencer.core.api.shared[player.core.name] == sent[player.core.name] == len(answered)
        events = [event.data for event in player.events if isinstance(event, Happened)]
        assert events == sorted(set(events)), "each comes once, in order"
        assert not any(isinstance(event, Diverged) for event in player.events)
    hashes_agree(match)


@pytest.mark.parametrize("seed", [4, *long(*range(5, 9))])
def test_a_client_knows_of_a_late_change_although_its_margin_comes_before_the_record_of_its_tick(seed: int) -> None:
    match = ScaledMatch(load_scene("hills"), seed, edges=1, standbys=0)

    def turns(core: Core, rng: random.Random) -> Input:
        return make_input(rng.uniform(-1, 1), rng.uniform(-1, 1)) if rng.random() < 0.15 else core.input

    player = match.join(turns, Link(delay_s=0.03, jitter_s=0.02, loss=0.1))
    for _ in range(60):
        match.bus.hold("log", match.edges[0].name, 0.15)
        match.run(0.25)
    assert player.core.stats.inputs_substituted >= player.core.stats.inputs_late > 0
    assert set(causes(player)) == {"late input"}
    assert player.core.stats.divergences == 0
    hashes_agree(match)
