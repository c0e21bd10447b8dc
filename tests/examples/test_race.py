"""The race over slow links in simulated time: boosts show at once, laps are counted, and nothing diverges."""

import random

import pytest

from sovereign_netcode.client_sdk.core import Core
from sovereign_netcode.client_sdk.events import Announced, Happened
from sovereign_netcode.examples.race import GRID, Race
from sovereign_netcode.examples.race_behaviours import BEHAVIOURS
from sovereign_netcode.examples.race_brain import GATES, PADS, RacePlayer, drive
from sovereign_netcode.playtest import PRESETS, Link, Match, Player, check_behaviours
from sovereign_netcode.shared.checks import SceneError
from sovereign_netcode.shared.inputs import NEUTRAL, Input, make_input
from sovereign_netcode.shared.scene import load_scene
from tests.examples.played import check, played
from tests.lengths import contained, long, long_but

BOOST = 2
"""Bit of the button "boost"."""
LINKS = long_but(["outage", "thin"], PRESETS)


class Small(Race):
    """The race without cars of the server's own."""

    players_min = 0


@pytest.mark.parametrize(("seconds", "seed"), [*contained((8, 1)), *long((14, 902))], ids=["short", "long"])
@pytest.mark.parametrize("link", LINKS)
def test_bots_race(link: str, seconds: float, seed: int) -> None:
    match = played(Small(), [RacePlayer() for _ in range(3)], link, seconds, seed)
    game = match.game.api
    passed = [len(GATES) * game.get(car, "score") + game.get(car, "gate") for car in game.entities()]
    assert min(passed) >= seconds // 8
    announced = {event.name for player in match.players for event in player.events if isinstance(event, Announced)}
    assert announced == {"boost", "refuel"}


@pytest.mark.parametrize(("ticks", "processes"), [(40, 0), *long((600, 1))])
def test_turns_compute_the_same_again(ticks: int, processes: int) -> None:
    check_behaviours(Small(), ticks=ticks, processes=processes, players=2, seed=902)


class Hand:
    """A policy whose input a test sets."""

    def __init__(self) -> None:
        self.now = NEUTRAL
        self.templates: list[tuple[int, str]] = []
        """Predicted ticks: the number, and the own template."""

    def __call__(self, core: Core, rng: random.Random) -> Input:
        assert core.prediction is not None
        world = core.prediction.predicted
        if core.entity in world:
            self.templates.append((world.tick, world.scene.templates[world.state(core.entity)[1]].name))
        return self.now


def alone(delay_s: float) -> tuple[Match, Player, Hand]:
    """Returns a match with one car that stands at the start."""
    match, hand = Match(load_scene(Race.scene), 3, rules=Small()), Hand()
    player = match.join(hand, Link(delay_s), Core("Ann", behaviours=BEHAVIOURS, patience_s=30.0))
    match.run(1.5)
    return match, player, hand


@pytest.mark.parametrize("delay_s", [0.15, *long(0.0, 0.025, 0.075)])
def test_the_own_boost_is_there_in_the_next_tick_and_burns_fuel(delay_s: float) -> None:
    match, player, hand = alone(delay_s)
    game, me = match.game.api, player.core.entity
    fuel = game.field(me, "fuel")
    hand.now = make_input(1, 0, buttons=BOOST)
    hand.templates.clear()
    match.run(0.5)
    (first, before), (second, after), *_ = hand.templates
    assert (before, after, second) == ("player", "boosting", first + 1)
    hand.now = make_input(0, 0)
    match.run(1)
    assert game.template(me) == "player"
    assert fuel - 17 <= game.field(me, "fuel") <= fuel - 15
    assert player.core.stats.corrections == 0
    player.disconnect()
    match.run_until(lambda: player.core.state == "playing", 5)
    hand.now = make_input(1, 0, buttons=BOOST)
    match.run(3)
    assert game.field(me, "fuel") < fuel - 40, "play goes on after a reconnect"
    check(match)


def test_a_car_drifts() -> None:
    match, player, hand = alone(0.05)
    game, me = match.game.api, player.core.entity
    hand.now = make_input(1, 0)
    match.run(1.5)
    east = game.velocity(me)[0]
    hand.now = make_input(0, 1)
    match.run(0.7)
    assert east > 9
    assert all(part > 2 for part in game.velocity(me)[:2])
    hand.now = make_input(0, 0)
    match.run(0.5)
    assert all(part > 1 for part in game.velocity(me)[:2]), "it rolls on"
    assert player.core.stats.corrections == 0


def test_a_pad_fills_the_tank() -> None:
    match, player, _ = alone(0.05)
    game, me = match.game.api, player.core.entity
    game.place(me, (PADS[0][0] + 0.5, PADS[0][1] + 0.5, 1))
    game.throw(me, (0.5, 0, 0))
    match.run(0.3)
    assert game.field(me, "fuel") == 96
    check(match)


def test_gates_count_in_their_order_and_laps_win() -> None:
    match, player, _ = alone(0.01)
    game, me = match.game.api, player.core.entity
    for gate in (1, 0, 2, 1, 2, 3):
        game.place(me, (*GATES[gate], 1))
        match.run(0.1)
    assert (game.get(me, "gate"), game.get(me, "score")) == (0, 1)
    for _ in range(Race.laps - 1):
        for x, y in GATES:
            game.place(me, (x, y, 1))
            match.run(0.1)
    match.run(0.2)
    told = [(event.name, event.data) for event in player.events if isinstance(event, Happened)]
    assert told[0] == ("lap", {"who": me, "laps": 1})
    assert told[-1] == ("won", {"who": me})
    assert (game.get(me, "gate"), game.get(me, "score")) == (0, 0)
    assert game.position(me)[:2] in [place[:2] for place in GRID]
    check(match)


def test_the_server_fills_the_field_up() -> None:
    match = Match(load_scene(Race.scene), 4, rules=Race())
    match.run(5)
    assert len(match.game.api.entities()) == Race.players_min
    assert any(match.game.api.get(car, "gate") for car in match.game.api.entities())
    with pytest.raises(SceneError, match="topdown"):
        Match(load_scene("hills"), 4, rules=Race())


def test_a_bot_drives_to_its_gate_and_slows_down_before_it() -> None:
    assert drive((20.0, 6.0, 1.0), (0.0, 0.0, 0.0), 0, 96) == (1.0, 0.0, True)
    assert drive((20.0, 6.0, 1.0), (0.0, 0.0, 0.0), 0, 8) == (1.0, 0.0, False)
    x, _, boost = drive((52.0, 6.0, 1.0), (17.0, 0.0, 0.0), 0, 96)
    assert (x, boost) == (-1.0, False)
