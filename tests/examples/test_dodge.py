"""Dodge over slow links in simulated time: own abilities show at once, hits are counted, and nothing diverges."""

import random
from typing import Any

import pytest

from sovereign_netcode.client_sdk.core import Core
from sovereign_netcode.client_sdk.events import Announced, Happened
from sovereign_netcode.examples.dodge import PLAYERS, Dodge
from sovereign_netcode.examples.dodge_behaviours import BEHAVIOURS
from sovereign_netcode.examples.dodge_brain import DodgePlayer, wish
from sovereign_netcode.playtest import PRESETS, Link, Match, Player, check_behaviours
from sovereign_netcode.shared.inputs import NEUTRAL, Input, make_input
from sovereign_netcode.shared.scene import load_scene
from tests.examples.played import check, played
from tests.lengths import contained, long, long_but

DASH, FIRE = 2, 4
"""Bits of the buttons, which are "jump", "dash" and "fire"."""
LINKS = long_but(["regional", "far"], PRESETS)


class Small(Dodge):
    """Dodge without players of the server's own."""

    players_min = 0


@pytest.mark.parametrize(("seconds", "seed"), [*contained((3, 1)), *long((8, 902))], ids=["short", "long"])
@pytest.mark.parametrize("link", LINKS)
def test_bots_play(link: str, seconds: float, seed: int) -> None:
    match = played(Small(), [DodgePlayer() for _ in range(3)], link, seconds, seed)
    game = match.game.api
    hits = [game.get(entity, "hits", 0) for entity in game.entities() if game.template(entity) in PLAYERS]
    scores = [game.get(entity, "score", 0) for entity in game.entities() if game.template(entity) in PLAYERS]
    assert sum(scores) == sum(hits) >= (seconds > 9)
    announced = {event.name for player in match.players for event in player.events if isinstance(event, Announced)}
    assert announced >= ({"throw"} if seconds < 9 else {"throw", "hit", "dash", "double jump"})


@pytest.mark.parametrize(("ticks", "processes"), [(40, 0), *long((600, 1))])
def test_turns_compute_the_same_again(ticks: int, processes: int) -> None:
    check_behaviours(Small(), ticks=ticks, processes=processes, players=2, seed=902)


class Hand:
    """A policy whose input a test sets, with the buttons down for one tick."""

    def __init__(self) -> None:
        self.next = NEUTRAL
        self.frames: list[tuple[int, str, set[int]]] = []
        """Frames: the predicted tick, the own template there, and the own balls in the view."""

    def __call__(self, core: Core, rng: random.Random) -> Input:
        prediction = core.prediction
        assert prediction is not None
        assert core.timeline is not None
        world, me = prediction.predicted, core.entity
        if me in world:
            view = core.view(self.player.local)
            balls = {each.entity for each in view.others if each.template == "ball"}
            self.frames.append((world.tick, world.scene.templates[world.state(me)[1]].name, balls))
        now, self.next = self.next, NEUTRAL
        return now

    player: Player


def alone(delay_s: float, **options: Any) -> tuple[Match, Player, Hand]:
    """Returns a match with one player who stands on the ground."""
    match, hand = Match(load_scene(Dodge.scene), 3, rules=Small()), Hand()
    hand.player = match.join(hand, Link(delay_s), Core("Ann", behaviours=BEHAVIOURS, **options))
    match.run(2.5)
    return match, hand.player, hand


DELAYS = [0.075, *long(0.0, 0.025, 0.15, 0.3)]


@pytest.mark.parametrize("delay_s", DELAYS)
def test_the_own_dash_and_the_own_ball_are_there_in_the_next_tick(delay_s: float) -> None:
    match, player, hand = alone(delay_s)
    hand.next = make_input(1, 0, buttons=DASH | FIRE, aim=(1, 0, 0.5))
    hand.frames.clear()
    match.run(0.2)
    (before, template, balls), (after, now, mine), *_ = hand.frames
    assert (template, balls) == ("player", set())
    assert (after, now, len(mine)) == (before + 1, "dashing", 1)
    match.run(0.9 + 2 * delay_s)  # the server has confirmed it
    later = [balls for tick, _, balls in hand.frames if tick > before]
    shown = later.index(set()) if set() in later else len(later)
    assert all(balls == mine for balls in later[:shown])
    assert not any(later[shown:]), "one ball, under one number, until it is gone"
    assert player.core.stats.corrections == 0
    check(match)


def test_the_second_jump_is_higher_and_there_is_no_third() -> None:
    match, player, hand = alone(0.05)
    heights = []
    for tick in range(40):
        if tick in (1, 13, 25):
            hand.next = make_input(0, 0, jump=True)
        match.run(1 / 32)
        heights.append(match.game.api.position(player.core.entity)[2])
    names = [event.name for event in player.events if isinstance(event, Announced)]
    assert names == ["double jump"]
    assert 2.5 < max(heights) - heights[0] < 3.5
    assert player.core.stats.corrections == 0


def test_a_player_who_stands_still_is_hit_knocked_back_and_put_out() -> None:
    match, player, _ = alone(0.05)
    hand = Hand()
    hand.player = match.join(hand, Link(0.05))
    match.run(2)
    game, me, foe = match.game.api, player.core.entity, hand.player.core.entity

    def throw() -> None:
        """Puts the opponent beside the player, and lets it throw until it has hit."""
        (x, y, z), health = game.position(me), game.field(me, "health")
        game.place(foe, (x - 3, y, z + 0.5))
        match.run(0.5)
        way = tuple(b - a for a, b in zip(game.position(foe), game.position(me), strict=True))
        hand.next = make_input(0, 0, buttons=FIRE, aim=way)
        match.run_until(lambda: game.field(me, "health") < health, 2)

    x = game.position(me)[0]
    throw()
    match.run(0.5)
    assert game.position(me)[0] > x + 0.5
    throw()
    throw()
    match.run(0.1)
    assert game.template(me) == "out"
    assert game.get(foe, "score") == game.get(me, "hits") == 3
    assert sum(game.shared["points"].values()) == 1
    match.run(3.2)
    assert {"by": foe, "who": me} in [event.data for event in player.events if isinstance(event, Happened)]
    assert (game.template(me), game.field(me, "health")) == ("player", 3)
    check(match)


def test_play_goes_on_after_a_reconnect() -> None:
    match, player, hand = alone(0.05, patience_s=30.0)
    player.disconnect()
    match.run_until(lambda: player.core.state == "playing", 5)
    match.run(1)
    hand.next = make_input(0, 1, buttons=DASH | FIRE)
    hand.frames.clear()
    match.run(1)
    assert (hand.frames[1][1], len(hand.frames[1][2])) == ("dashing", 1)
    assert match.game.api.field(player.core.entity, "ready_at") == hand.frames[0][0] + 1 + 48
    check(match)


def test_teams_are_even_and_a_round_ends() -> None:
    class Short(Dodge):
        round_s = 2.0

    match = Match(load_scene(Dodge.scene), 4, rules=Short())
    ann = match.join(lambda core, rng: NEUTRAL)
    match.run(1.5)
    game = match.game.api
    everybody = game.entities("player")
    assert sorted(game.field(entity, "team") for entity in everybody) == [0, 0, 0, 1, 1, 1]
    assert all(game.get(entity, "team") == game.field(entity, "team") for entity in everybody)
    game.soon(game.share, "points", {"blue": 1, "yellow": 2})
    match.run(1)
    assert set(game.shared["points"].values()) == {0}
    assert game.shared["ends"] == 1 + 2 * game.ticks(Short.round_s)
    match.run_until(lambda: game.shared["ends"] > 1 + 2 * game.ticks(Short.round_s), 3)
    match.run(0.2)
    said = [event.data["winner"] for event in ann.events if isinstance(event, Happened) and event.name == "round"]
    assert said == ["yellow", "nobody"]
    check(match)


class Field:
    """A world with entities at given positions, for `wish`."""

    def __init__(self, *entities: tuple[tuple[float, float], int, tuple[float, float]]) -> None:
        self._entities = entities

    def position(self, entity: int) -> tuple[float, float, float]:
        return (*self._entities[entity][0], 8.0)

    def velocity(self, entity: int) -> tuple[float, float, float]:
        return (*self._entities[entity][2], 0.0)

    def field(self, entity: int, name: str) -> int:
        return self._entities[entity][1] if name == "team" else 0


MIDDLE = (32.0, 32.0, 8.0)


def test_a_bot_throws_at_the_nearest_opponent_and_never_at_its_own_team() -> None:
    field = Field(((32, 32), 0, (0, 0)), ((34, 32), 0, (0, 0)), ((32, 40), 1, (0, 0)), ((10, 32), 1, (0, 0)))
    made = wish(field, MIDDLE, 0, 8, range(4), [])
    assert made.aim is not None
    assert made.aim[:2] == (0, 8)
    assert "fire" in made.buttons
    assert wish(field, MIDDLE, 0, 8, [0, 1], []).buttons == ()


def test_a_bot_dashes_across_the_way_of_a_ball() -> None:
    field = Field(((32, 32), 0, (0, 0)), ((38, 32), 1, (0, 0)), ((35, 32), 1, (-14, 0)), ((29, 32), 0, (14, 0)))
    made = wish(field, MIDDLE, 0, 8, [0, 1], [2, 3])
    assert "dash" in made.buttons
    assert made.x == 0 != made.y
