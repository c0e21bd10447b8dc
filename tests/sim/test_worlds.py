"""A match with several worlds in simulated time: players find worlds, are sent on, lose connections, and come back."""

import random
from typing import Any

import pytest

from client_sdk.core import Core
from client_sdk.events import Disconnected, Joined, Left, Matched, Moved, Resumed
from client_sdk.netsim.links import PRESETS
from server import Player, Rules
from server.worlds.kinds import Kind, kind_of
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from sovereign_netcode.playtest import Player as Client
from tests.lengths import long

FLAT = load_scene("flat")


class Round(Rules):
    """A round of some seconds, after which all players are sent to the next one."""

    def on_start(self) -> None:
        self.game.after(3, "over")

    def over(self) -> None:
        if self.game.players:
            following = self.game.worlds.create("round")
            for player in tuple(self.game.players.values()):
                self.game.send_away(player, following, {"from": self.game.worlds.name}, "next round")
        self.game.after(1, "over")


def rounds(**limits: Any) -> Kind:
    return kind_of("round", Round, FLAT, **{"players_max": 4, "empty_s": 2.0, **limits})


def story(player: Client) -> list[type]:
    return [type(event) for event in player.events if isinstance(event, Matched | Moved | Joined | Left | Resumed)]


@pytest.mark.parametrize("link", ["regional", *long("wifi", "far")])
def test_players_go_from_round_to_round_together(link: str) -> None:
    match = Match(FLAT, seed=3, worlds=[rounds()])
    players = [match.join(wander, PRESETS[link], to="/match?kind=round") for _ in range(4)]
    match.run(20)
    names = {player.core.travel.world for player in players}
    for player in players:
        moved = [event for event in player.events if isinstance(event, Moved)]
        assert story(player)[:2] == [Matched, Joined]
        assert story(player).count(Joined) == 1 + len(moved) or player.core.state == "joining"
        assert len(moved) >= 4
        assert {event.reason for event in moved} == {"next round"}
        assert player.core.stats.divergences == 0
        assert player.core.stats.reconnects == 0
    assert len(names) <= 2, "they are in the same world, or on the way to the next one"
    assert match.worlds is not None
    assert len(match.worlds.core.worlds) <= 3, "the empty ones have ended"
    assert match.worlds.core.counts["ended"] >= 2


def play(seed: int, seconds: float) -> tuple[Match, list[Client]]:
    """Plays rounds over bad links; connections break at any time, also between two worlds."""
    chance = random.Random(seed)
    match = Match(FLAT, seed=seed, worlds=[rounds(empty_s=1.0)])
    links = [PRESETS[name] for name in ("regional", "typical", "wifi")]
    players = [
        match.join(wander, chance.choice(links), Core(f"p{k}", patience_s=10.0), to="/match?kind=round")
        for k in range(6)
    ]
    until = match.now + seconds
    while match.now < until:
        match.run(chance.uniform(0.05, 2.0))
        player = chance.choice(players)
        if player.session is not None and player.closed is None and player.core.travel.world:
            player.disconnect()
    return match, players


@pytest.mark.parametrize("seed", [1, *long(*range(2, 7))])
def test_connections_break_at_any_time(seed: int) -> None:
    """A seat counts once: a connection that breaks between the server's welcome and its arrival may cost it."""
    match, players = play(seed, 20)
    match.run(5)
    for kind in (Disconnected, Resumed, Moved):
        assert any(isinstance(event, kind) for player in players for event in player.events)
    assert match.worlds is not None
    assert [world.game.counters.rules_failed for world in match.worlds.core.worlds.values() if world.ticking].count(0)
    inside = {
        player.name: name for name, world in match.worlds.core.worlds.items() for player in world.game.players.values()
    }
    for k, player in enumerate(players):
        assert player.core.stats.divergences == 0
        if player.core.state == "closed":
            (left,) = [event for event in player.events if isinstance(event, Left)]
            assert "the seat has expired" in left.reason or "there is no world" in left.reason
        elif player.core.state == "playing":
            assert inside[f"p{k}"] == player.core.travel.world
    assert sum(player.core.state != "closed" for player in players) >= 4


def test_one_seed_is_one_course_of_events() -> None:
    courses = []
    for _ in range(2):
        match, players = play(7, 8)
        courses.append(
            [(event if not isinstance(event, Joined) else event.tick) for p in players for event in p.events]
        )
        assert match.worlds is not None
    hidden = [[event for event in course if not isinstance(event, Matched)] for course in courses]  # has random tokens
    assert hidden[0] == hidden[1]


def test_the_default_world_is_the_game_of_the_match() -> None:
    ticks: list[int] = []
    match = Match(FLAT, seed=1, worlds=[rounds()])
    match.on_tick.append(lambda: ticks.append(match.game.world.tick))
    player = match.join(wander)
    match.run(2)
    assert (player.core.state, player.core.travel.world) == ("playing", "")
    assert ticks == list(range(1, 1 + match.game.world.tick))
    assert len(match.game.players) == 1


def test_a_path_that_leads_nowhere() -> None:
    match = Match(FLAT, seed=1, worlds=[rounds()])
    player = match.join(wander, to="/round-7")
    match.run(1)
    (left,) = player.events
    assert isinstance(left, Left)
    assert left.reason == "there is no world 'round-7'"


def test_who_is_sent_away_carries_nothing_of_the_old_world() -> None:
    handed: list[Any] = []

    class Kept(Round):
        def on_join(self, player: Player) -> None:
            handed.append(player.handed)

    match = Match(FLAT, seed=1, worlds=[kind_of("round", Kept, FLAT, players_max=4)])
    player = match.join(wander, PRESETS["typical"], to="/match?kind=round")
    match.run(5)
    assert handed == [None, {"from": "round-1"}]
    assert player.core.travel.path == "/round-2"
