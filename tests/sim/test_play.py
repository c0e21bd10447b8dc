"""Slow programs, suspended programs, input delay and crowds behave in defined ways."""

import random

import pytest

from client_sdk.core import Core
from client_sdk.events import Diverged, Left, Resynchronised, SegmentLoaded
from client_sdk.netsim.links import PRESETS
from shared.bounds import UPDATE_S
from shared.inputs import JUMP, Input
from shared.messages import Command, decode_from_client
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, Player, wander
from tests.lengths import contained, long


def joined(match: Match, *players: Player) -> None:
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 30)


def ahead(player: Player) -> int:
    assert player.core.prediction is not None
    return player.core.prediction.predicted.tick - player.core.prediction.confirmed.tick


@pytest.mark.parametrize(
    ("frames_per_s", "seconds"),
    [*contained((12, 20), (60, 20)), *long((5, 60), (12, 60), (30, 60), (60, 60), (144, 60))],
)
def test_any_frame_rate_plays(frames_per_s: int, seconds: float) -> None:
    match = Match(load_scene("hills"), 3)
    player = match.join(wander, Link(0.05, 0.01))
    player.frame_s = 1 / frames_per_s
    joined(match, player)
    match.run(5)  # the lead has learned how long a frame is
    stats = player.core.stats
    substituted, corrections = stats.inputs_substituted, stats.corrections
    match.run(seconds)
    if frames_per_s >= 30:
        assert stats.corrections == corrections
        assert stats.inputs_substituted == substituted
    assert stats.inputs_substituted - substituted < 0.01 * seconds * 32
    assert stats.resyncs == 0
    assert stats.inputs_sent >= seconds * 32
    assert set(stats.corrections_by_cause) <= {"late input"}
    # Only new terrain causes a replay.
    assert stats.repredictions <= sum(isinstance(event, SegmentLoaded) for event in player.events)


class Counted(Core):
    updates = 0

    def update(self, now: float) -> None:
        self.updates += 1
        super().update(now)


@pytest.mark.parametrize("preset", ["typical", *long("lan", "wifi")])
def test_a_program_that_sleeps_until_the_next_update_wakes_once_per_tick_and_ping(preset: str) -> None:
    match, core = Match(load_scene("hills"), 6), Counted()
    player = match.join(wander, PRESETS[preset], core)
    joined(match, player)
    match.run(10)
    updates, sent = core.updates, core.stats.inputs_sent
    match.run(20)
    sent = core.stats.inputs_sent - sent
    assert sent >= 20 * 32 - 10
    assert core.updates - updates <= 1.05 * sent + 20


@pytest.mark.parametrize("seconds", [0.3, 2.0, *long(1.0, 5.0, 12.0)])
def test_a_suspended_program_begins_anew_without_a_spiral(seconds: float) -> None:
    match = Match(load_scene("hills"), 4)
    player = match.join(wander, Link(0.05, 0.01))
    joined(match, player)
    match.run(5)
    stats = player.core.stats
    player.events.clear()
    steps = stats.replayed_ticks + stats.inputs_sent
    player.suspend(seconds)
    match.run(seconds + 1)
    assert stats.resyncs == (seconds > UPDATE_S)
    assert [type(event) for event in player.events if isinstance(event, Resynchronised)] == [
        Resynchronised
    ] * stats.resyncs
    # The missed ticks are not caught up.
    assert stats.replayed_ticks + stats.inputs_sent - steps < 200
    assert ahead(player) < 16
    corrections = stats.corrections
    match.run(20)
    assert stats.corrections == corrections
    assert player.closed is None
    assert set(stats.corrections_by_cause) <= {"late input"}


def test_a_long_sleep_ends_the_connection_with_a_reason() -> None:
    match = Match(load_scene("flat"), 5)
    player = match.join(wander, Link(0.05))
    joined(match, player)
    match.run(1)  # the loss of the connection is reported
    player.suspend(20)
    match.run(21)
    left = [event for event in player.events if isinstance(event, Left)]
    assert [event.reason for event in left] == ["no message received for 15 s"]
    assert match.game.sessions == []
    assert len(match.game.world) == 1, "the client may reconnect for a while"
    match.run(match.game.limits.resume_s)
    assert len(match.game.world) == 0


def test_the_input_delay_changes_in_mid_play_without_a_correction() -> None:
    match = Match(load_scene("arena"), 6)
    player = match.join(wander, Link(0.05, 0.01))
    joined(match, player)
    depths = {}
    for ticks in (0, 3, 1, 2, 0):
        player.core.set_input_delay(ticks)
        match.run(10)
        depths[ticks] = ahead(player)
    assert depths[3] < depths[0]
    assert player.core.stats.corrections == 0
    with pytest.raises(ValueError, match="ticks = 4"):
        player.core.set_input_delay(4)


@pytest.mark.parametrize("preset", ["typical", *long("far")])
def test_a_command_carries_the_view_tick_of_the_last_drawn_picture(preset: str) -> None:
    """At 60 frames/s, a command carries the view tick of the picture drawn last, not that of the update in between. It
    is never 100 ms beyond what is known."""
    match = Match(load_scene("flat"), 21)
    players = [match.join(wander, PRESETS[preset]) for _ in range(2)]
    joined(match, *players)
    player, core = players[0], players[0].core
    match.run(2)
    told: list[bool] = []
    ahead_of_news: list[float] = []

    def frame() -> None:
        drawn = core.view(player.local).seen
        assert core.prediction is not None
        ahead_of_news.append(drawn - core.prediction.confirmed.tick)
        match.at(match.now + 1 / 60, lambda: act(drawn))

    def act(drawn: float) -> None:
        core.update(player.local)
        core.edit(1, 1, 1, 0)
        sent = core.outgoing()
        (command,) = [order for order in map(decode_from_client, sent) if isinstance(order, Command)]
        told.append(command.seen == drawn)
        for message in sent:
            player.up.send(message)

    for number in range(100):
        match.at(match.now + number / 5, frame)
    match.run(21)
    assert told == [True] * 100
    assert max(ahead_of_news) <= 3.2


class Crowd:
    """A policy that presses to the middle, jumps, and sometimes goes away, so that players block each other and jump on
    heads."""

    def __init__(self) -> None:
        self._input = Input()

    def __call__(self, core: Core, rng: random.Random) -> Input:
        assert core.prediction is not None
        if rng.random() < 0.06:
            x, y, _ = core.prediction.predicted.position(core.entity)
            sign = -1 if rng.random() < 0.2 else 1
            way = (
                rng.randint(20, 127) * sign * (1 if x < 64 else -1),
                rng.randint(20, 127) * sign * (1 if y < 64 else -1),
            )
            self._input = Input(*way, JUMP if rng.random() < 0.3 else 0)
        return self._input


def crowd(size: int, seconds: float, neighbours: bool, seed: int = 7) -> tuple[Match, list[Player]]:
    match = Match(load_scene("flat"), seed)
    players = [match.join(Crowd(), Link(0.05, 0.01), Core(neighbours=neighbours)) for _ in range(size)]
    joined(match, *players)
    match.run(seconds)
    return match, players


@pytest.mark.parametrize(("size", "seconds"), [*contained((8, 6)), *long((12, 10), (30, 10))])
def test_a_crowd_has_no_nondeterminism_and_predicting_neighbours_pays(size: int, seconds: float) -> None:
    corrections = {}
    for neighbours in (True, False):
        _, players = crowd(size, seconds, neighbours)
        causes = {cause for player in players for cause in player.core.stats.corrections_by_cause}
        assert causes <= {"other entity", "late input"}
        assert not any(isinstance(event, Diverged) for player in players for event in player.events)
        corrections[neighbours] = sum(player.core.stats.corrections for player in players)
    assert 0 < corrections[True] < corrections[False]
