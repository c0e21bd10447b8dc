"""Game events arrive after the entities that they name, after `Joined`, in order, and are counted if they are lost."""

import random
from collections.abc import Iterator
from typing import Any

import pytest

from client_sdk.core import Core
from client_sdk.events import Answered, Event, EventsDropped, Happened, Joined, Left, Resumed, SegmentLoaded
from client_sdk.netsim.links import PRESETS
from server.config.limits import Limits
from server.players.player import Player as Seat
from server.rules import Rules
from shared.inputs import NEUTRAL, Input
from shared.scene import Scene, load_scene
from sovereign_netcode.playtest import Link, Match, Player, wander
from tests.lengths import contained, long, long_but

FLAT = load_scene("flat")


def still(core: Core, rng: random.Random) -> Input:
    return NEUTRAL


def playing(match: Match, *players: Player) -> None:
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 60)


class Watched(Core):
    """A core that counts the game events, and those that name an entity which it does not know when they arrive."""

    def __init__(self, **options: Any) -> None:
        super().__init__("Ann", **options)
        self.named = self.unknown = 0

    def receive(self, data: bytes, now: float) -> None:
        before = len(self._events)
        super().receive(data, now)
        for event in self._events[before:]:
            if isinstance(event, Happened) and event.name == "born":
                self.named += 1
                assert self.prediction is not None
                self.unknown += event.data not in self.prediction.confirmed


class Born(Rules):
    """Rules that spawn things in many places, and send an event that names each of them."""

    scene = "flat"
    crowd = 0
    """Number of other walkers. With enough of them, a snapshot has no room for everything."""

    def prepare(self, scene: Scene) -> Scene:
        stands: dict[str, Any] = {"walk_speed": 0, "jump_speed": 0, "solid": False}
        return scene.with_template("thing", **stands).with_template("walker", walk_speed=4, solid=False)

    def on_start(self) -> None:
        self.things: list[int] = []
        for number in range(self.crowd):
            self.game.spawn("walker", (34 + number % 60, 34 + number * 7 % 60, 8))

    def on_join(self, player: Seat) -> None:
        self.game.send("welcome", to=player)
        self.game.send("born", player.entity)

    def on_tick(self) -> None:
        game, rng = self.game, self.game.random
        for walker in game.entities("walker"):
            if rng.random() < 0.3:
                game.steer(walker, rng.uniform(-1, 1), rng.uniform(-1, 1))
        if game.tick % 8 == 0:
            self.things.append(game.spawn("thing", (rng.uniform(34, 94), rng.uniform(34, 94), 8)))
            game.send("born", self.things[-1])
            if len(self.things) > 40:
                game.remove(self.things.pop(0))


# -- first the entity, then its event ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    long_but([Link(), PRESETS["wifi"]], [Link(), Link(0.02), *PRESETS.values()]),
)
def test_an_entity_is_known_before_an_event_names_it(path: Link) -> None:
    match, core = Match(FLAT, seed=1, rules=Born()), Watched()
    match.join(wander, path, core)
    match.run(20)
    assert core.named > 60
    assert core.unknown == 0


@pytest.mark.parametrize("rate", [30e3, *long(60e3)])
def test_an_entity_is_known_before_an_event_names_it_if_snapshots_are_full(rate: float) -> None:
    rules = Born()
    rules.crowd = 120
    match, core = Match(FLAT, seed=2, rules=rules), Watched()
    player = match.join(still, Link(0.03, rate=rate), core)
    playing(match, player)
    behind = 0
    for _ in range(40 * 32):
        match.run(1 / 32)
        assert player.session is not None
        behind += not player.session.stream.view.complete
    assert behind > 400, "the link is slow enough to skip snapshots"
    assert core.named > 100
    assert core.unknown == 0
    late = match.game.world.tick - max(event.tick for event in player.events if isinstance(event, Happened))
    assert late < 5 * 32, "events wait, but not for long"


def test_an_entity_is_known_before_an_event_from_a_reconnect_names_it() -> None:
    match, core = Match(FLAT, seed=3, rules=Born()), Watched(patience_s=30.0)
    player = match.join(wander, PRESETS["regional"], core)
    playing(match, player)
    for _ in range(6):
        match.run(3)
        player.disconnect()
    match.run(5)
    assert sum(isinstance(event, Resumed) for event in player.events) == 6
    assert core.unknown == 0
    told = [event.data for event in player.events if isinstance(event, Happened) and event.name == "born"]
    assert len(told) == len(set(told)) > 60


# -- first Joined, then all other events --------------------------------------------------------------------


@pytest.mark.parametrize("path", long_but([Link(), PRESETS["lan"], PRESETS["thin"]], [Link(), *PRESETS.values()]))
def test_joined_is_the_first_event_and_earlier_game_events_follow_it(path: Link) -> None:
    match = Match(FLAT, seed=4, rules=Born())
    player = match.join(still, path)
    match.run(5)
    events = [event for event in player.events if not isinstance(event, SegmentLoaded)]
    assert isinstance(events[0], Joined)
    told = [event for event in events if isinstance(event, Happened)]
    assert [(event.name, event.data) for event in told[:2]] == [("welcome", None), ("born", player.core.entity)]
    assert [event.tick for event in told] == sorted(event.tick for event in told)


def test_a_refused_client_gets_only_the_refusal() -> None:
    match = Match(FLAT, seed=5, limits=Limits(clients_max=1), rules=Born())
    first = match.join(still)
    playing(match, first)
    second = match.join(still)
    match.run(2)
    assert [type(event) for event in second.events] == [Left]


def test_resumed_comes_before_the_game_events_sent_meanwhile() -> None:
    match = Match(FLAT, seed=6, rules=Born())
    player = match.join(still, PRESETS["typical"], Core("Ann", patience_s=30.0))
    playing(match, player)
    match.run(2)
    player.disconnect()
    before = len(player.events)
    match.run(6)
    events = [event for event in player.events[before:] if isinstance(event, Happened | Resumed | EventsDropped)]
    assert isinstance(events[0], Resumed)
    assert len(events) > 10


# -- no event is lost unnoticed -----------------------------------------------------------------------------


class Loud(Rules):
    """Rules that send all players ascending numbers, `per_tick` of them in every tick."""

    scene = "flat"
    per_tick = 20

    def on_start(self) -> None:
        self.number = 0

    def on_join(self, player: Seat) -> None:
        self.game.set(player.entity, "first", self.number)

    def on_tick(self) -> None:
        for _ in range(self.per_tick):
            self.game.send("n", self.number)
            self.number += 1

    def on_command(self, player: Seat, name: str, payload: Any) -> None:
        pass


def gaps(events: list[Event]) -> Iterator[tuple[int, int]]:
    """Yields, for each two numbers in a row, how many are missing between them and how many were reported as
    missing."""
    last, counted = -1, 0
    for event in events:
        if isinstance(event, EventsDropped):
            counted += event.count
        elif isinstance(event, Happened):
            if last >= 0:
                yield event.data - last - 1, counted
            last, counted = event.data, 0


def check(match: Match, player: Player, *, dropped: bool) -> None:
    told = list(gaps(player.events))
    assert all(missing == counted for missing, counted in told)
    assert any(missing for missing, _ in told) is dropped


def test_a_game_that_polls_after_a_while_gets_all_events() -> None:
    match = Match(FLAT, seed=7, rules=Loud())
    player = match.join(still, Link(0.02))
    playing(match, player)
    player.suspend(3.0)
    match.run(5)
    check(match, player, dropped=False)


def test_if_too_many_events_wait_the_client_reports_the_missing_ones() -> None:
    rules = Loud()
    rules.per_tick = 200
    match = Match(FLAT, seed=8, limits=Limits(outbox_max=100_000), rules=rules)
    player = match.join(still, Link(0.02))
    playing(match, player)
    numbers = [player.core.command("mark", n) for n in range(3)]
    player._flush()
    player.suspend(3.0)
    match.run(5)
    check(match, player, dropped=True)
    assert [event.number for event in player.events if isinstance(event, Answered)] == numbers
    assert sum(isinstance(event, Joined) for event in player.events) == 1


@pytest.mark.parametrize(
    ("preset", "seconds"), [*contained(("thin", 10)), *long(("outage", 10), ("dip", 90), ("thin", 90), ("outage", 90))]
)
def test_if_a_link_is_too_slow_for_the_events_the_missing_ones_are_reported(preset: str, seconds: float) -> None:
    rules = Loud()
    match = Match(FLAT, seed=9, rules=rules)
    player = match.join(still, PRESETS[preset])
    playing(match, player)
    match.run(seconds)
    rules.per_tick = 0
    match.run(30)
    assert player.core.state == "playing"
    assert not any(isinstance(event, Left) for event in player.events)
    check(match, player, dropped=preset != "outage")
    told = [event.data for event in player.events if isinstance(event, Happened)]
    missed = sum(event.count for event in player.events if isinstance(event, EventsDropped))
    assert told[-1] == rules.number - 1
    assert len(told) + missed >= told[-1] - told[0] + 1
    assert match.game.counters.events_dropped == missed


@pytest.mark.parametrize("per_tick", [20, *long(1)])
def test_after_lost_connections_the_missing_events_are_reported(per_tick: int) -> None:
    rules = Loud()
    rules.per_tick = per_tick
    match = Match(FLAT, seed=10, limits=Limits(outbox_max=100), rules=rules)
    player = match.join(still, PRESETS["regional"], Core("Ann", patience_s=30.0))
    playing(match, player)
    for _ in range(8):
        match.run(1.7)
        player.disconnect()
    match.run(5)
    assert sum(isinstance(event, Resumed) for event in player.events) == 8
    check(match, player, dropped=True)


def test_snapshots_are_not_late_for_the_events() -> None:
    ages = []
    for per_tick in (0, 20):
        rules = Loud()
        rules.per_tick = per_tick
        match = Match(FLAT, seed=11, rules=rules)
        player = match.join(still, PRESETS["thin"])
        playing(match, player)
        match.run(10)
        age = []
        for _ in range(20 * 32):
            match.run(1 / 32)
            age.append(player.core.stats.snapshot_age_s)
        ages.append(sorted(age)[len(age) // 2])
    assert ages[1] < ages[0] + 0.3
