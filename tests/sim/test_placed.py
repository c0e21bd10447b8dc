"""Entities that the rules place, remove, change or spawn are drawn only at their true places, and a shot at them
hits."""

import dataclasses
import random
from itertools import product
from typing import Any

import pytest

from client_sdk import Loopback
from client_sdk.core import Core
from client_sdk.netsim.links import PRESETS
from server.game import Game
from server.players.player import Player as Shooter
from server.rules import Rules
from shared.checks import Vec
from shared.inputs import NEUTRAL, Input
from shared.scene import Scene, load_scene
from sovereign_netcode.playtest import Link, Match, Player
from tests.lengths import long, long_but

FLAT = load_scene("flat")


def still(core: Core, rng: random.Random) -> Input:
    return NEUTRAL


def playing(match: Match, *players: Player) -> None:
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 30)


class Acts(Rules):
    """Rules that place, change, remove and spawn things in the air."""

    scene = "flat"
    far = 1.75
    """Distance by which one of them is placed to and fro, in blocks."""

    def prepare(self, scene: Scene) -> Scene:
        stands: dict[str, Any] = {"walk_speed": 0, "jump_speed": 0, "solid": False}
        return scene.with_template("thing", **stands).with_template("big", **stands, box_size=(2.0, 2.0, 3.0))

    def on_start(self) -> None:
        spawn = self.game.spawn
        self.one, self.steps, self.born, self.both = (spawn("thing", (70, y, 8)) for y in (60, 66, 72, 78))
        self.shots = 0
        self.misses: list[tuple[str, int, float]] = []

    def on_tick(self) -> None:
        game, tick = self.game, self.game.tick
        if tick % 16 == 0:
            game.place(self.one, (70 if game.position(self.one)[0] > 70 else 70 + self.far, 60, 8))
        if tick % 16 in (3, 4, 5):
            game.place(self.steps, (70 + 3 * (tick % 16), 66, 8))
        if tick % 20 == 9:
            game.remove(self.born)
            self.born = game.spawn("thing", (70 + 4 * (tick % 3), 72, 8))
        if tick % 14 == 2:
            game.change(self.both, "thing" if game.template(self.both) == "big" else "big")
            game.place(self.both, (70 + 5 * (tick % 3), 78, 8))

    def on_command(self, player: Shooter, name: str, data: Any) -> None:
        """Compares everything that was drawn with the result of lag compensation."""
        past, (seen, *targets) = self.game.rewound(player), data
        if past.seen != seen:
            return  # it was drawn longer ago than lag compensation reaches
        for entity, size, *place in targets:
            self.shots += 1
            x, y, z = place
            if entity not in past or past.position(entity) != (x, y, z):
                self.misses.append(("place", entity, past.seen))
            elif entity not in past.box((x, y, z), (x + size - 0.25, y + 0.1, z + 1)):
                self.misses.append(("box", entity, past.seen))


def shoot(match: Match, player: Player) -> None:
    """Makes a player shoot at everything in its view."""
    view = player.core.view(player.local)
    sizes = {"thing": 0.5, "big": 1.25}
    targets = [(figure.entity, sizes[figure.template], *figure.position) for figure in view.others]
    player.core.command("shoot", [view.seen, *targets])
    player._update()


class Skipped(Player):
    """A client to which the server can send only some of the snapshots."""

    def outstanding(self) -> int:
        return 1 << 30 if self.rng.random() < 0.35 else super().outstanding()


def join(match: Match, path: Link, kind: type[Player] = Player) -> Player:
    player = kind(match, Core("Ann"), path, still, 5)
    match.players.append(player)
    match.at(match.now, player.connect)
    playing(match, player)
    return player


# -- others ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("far", "rate"), long_but([(1.75, 32)], product([0.25, 1.75, 10.0, 25.0], [32, 60, 240])))
def test_an_entity_that_is_placed_is_never_drawn_elsewhere(far: float, rate: int) -> None:
    rules = Acts()
    rules.far = far
    match = Match(dataclasses.replace(FLAT, tick_rate=rate), seed=1, rules=rules)
    player = join(match, Link(0.02, 0.01))
    match.run(2)
    drawn: dict[str, set[float]] = {"one": set(), "steps": set()}
    for _ in range(3 * 240):
        match.run(1 / 240)
        for figure in player.core.view(player.local).others:
            for name, entity in (("one", rules.one), ("steps", rules.steps)):
                if figure.entity == entity:
                    drawn[name].add(figure.position[0])
    assert drawn == {"one": {70.0, 70.0 + far}, "steps": {79.0, 82.0, 85.0}}


@pytest.mark.parametrize(
    ("path", "rate"),
    long_but(
        [(PRESETS["wifi"], 32)],
        product(
            [Link(), Link(0.02), Link(0.01, loss=0.01), PRESETS["lan"], PRESETS["regional"], PRESETS["wifi"]], [32, 128]
        ),
    ),
)
def test_a_shot_at_what_is_drawn_hits(path: Link, rate: int) -> None:
    rules = Acts()
    match = Match(dataclasses.replace(FLAT, tick_rate=rate), seed=3, rules=rules)
    player = join(match, path)
    match.run(3)
    for _ in range(500):
        match.run(0.0293)
        shoot(match, player)
    match.run(1)
    assert rules.shots > 1400
    assert rules.misses == []


@pytest.mark.parametrize("path", [Link(0.02, 0.01), *long(Link())])
def test_a_shot_at_what_is_drawn_between_snapshots_that_are_far_apart_hits(path: Link) -> None:
    rules = Acts()
    match = Match(FLAT, seed=4, rules=rules)
    player = join(match, path, Skipped)
    match.run(3)
    skipped = player.core.stats.snapshots_skipped
    for _ in range(500):
        match.run(0.0293)
        shoot(match, player)
    match.run(1)
    assert player.core.stats.snapshots_skipped - skipped > 40
    assert rules.shots > 1400
    assert rules.misses == []


def test_a_shot_at_what_is_drawn_after_a_pause_of_the_program_hits() -> None:
    rules = Acts()
    match = Match(FLAT, seed=5, rules=rules)
    player = join(match, Link(0.01))
    match.run(3)
    for number in range(500):
        match.run(0.0293)
        if number % 20 == 0:
            player.suspend(0.05)
            match.run(0.05)
        shoot(match, player)
    match.run(1)
    assert rules.shots > 1400
    assert rules.misses == []


class Seen(Rules):
    """Rules that place a thing in a segment that the player sees only afterwards, and back again."""

    scene = "flat"

    def prepare(self, scene: Scene) -> Scene:
        return scene.with_template("thing", walk_speed=0, jump_speed=0, solid=False)

    def on_start(self) -> None:
        self.thing = self.game.spawn("thing", (70, 66, 8))

    def on_tick(self) -> None:
        tick = self.game.tick
        if tick % 64 == 0:
            place = (40.0, 66.0, 8.0) if tick % 128 else (70.0, 66.0, 8.0)
            self.game.place(self.thing, place)
            for entity in self.game.players:
                self.game.place(entity, (place[0] - 30, 60, 8))


def test_an_entity_that_is_placed_into_a_new_segment_is_never_drawn_elsewhere() -> None:
    rules = Seen()
    match = Match(FLAT, seed=6, rules=rules)
    player = join(match, Link(0.02))
    drawn = set()
    for _ in range(16 * 240):
        match.run(1 / 240)
        drawn |= {figure.position[0] for figure in player.core.view(player.local).others}
    assert drawn == {40.0, 70.0}


# -- the own entity --------------------------------------------------------------------------------------------


class Moved(Rules):
    """Rules that place all players to and fro, sometimes in two ticks in a row."""

    scene = "flat"
    places: tuple[Vec, Vec] = ((64, 66, 8), (74, 66, 8))

    def on_tick(self) -> None:
        tick = self.game.tick
        for entity in self.game.players:
            if tick % 96 in (0, 1, 48):
                self.game.place(entity, self.places[tick % 96 == 0])


def drawn_in_loopback(fps: float, link: str | Link | None, delay: int) -> set[float]:
    client = Loopback(Game(FLAT, rules=Moved())).join("Ann", link=link)
    client.set_input_delay(delay)
    drawn = set()
    for frame in range(round(fps * 20)):
        now = frame / fps
        client.poll(now)
        client.update(now)
        me = client.view(now).me
        if me and now > 6:
            drawn.add(me.position[0])
    return drawn


@pytest.mark.parametrize(("fps", "delay"), long_but([(24.0, 3)], product([24.0, 60.0, 144.0], [0, 1, 3])))
def test_the_own_entity_is_never_drawn_between_its_old_and_its_new_place(fps: float, delay: int) -> None:
    assert drawn_in_loopback(fps, None, delay) <= {64.0, 74.0}


@pytest.mark.parametrize(
    ("link", "delay"),
    long_but(
        [("typical", 0)],
        product(["lan", "regional", "typical", "wifi", Link(0.002), Link(0.016)], [0, 3]),
    ),
)
def test_the_own_entity_is_never_drawn_between_on_any_link(link: str | Link, delay: int) -> None:
    assert drawn_in_loopback(60.0, link, delay) == {64.0, 74.0}


class Pushed(Moved):
    """Rules that place all players over a short distance, which would be smoothed if it were a correction."""

    places = ((64, 66, 8), (65.5, 66, 8))


def test_a_placement_over_a_short_distance_is_not_smoothed() -> None:
    match = Match(FLAT, seed=7, rules=Pushed())
    player = join(match, Link(0.03))
    match.run(3)
    drawn = set()
    for _ in range(10 * 240):
        match.run(1 / 240)
        me = player.core.view(player.local).me
        assert me is not None
        drawn.add(me.position[0])
    assert drawn == {64.0, 65.5}
    assert set(player.core.stats.corrections_by_cause) == {"server act"}


class Falls(Rules):
    """Rules that make players fall out of the world again and again. They come back at a spawn point."""

    scene = "flat"

    def on_tick(self) -> None:
        for entity in self.game.players:
            if self.game.tick % 96 == 0:
                self.game.place(entity, (64, 66, -40))


@pytest.mark.parametrize("others", [False, True])
def test_an_entity_that_fell_out_is_not_drawn_on_its_way_back(others: bool) -> None:
    match = Match(FLAT, seed=8, rules=Falls())
    player, watcher = match.join(still, Link(0.02)), match.join(still, Link(0.02))
    playing(match, player, watcher)
    match.run(3)
    heights = []
    for _ in range(10 * 240):
        match.run(1 / 240)
        view = (watcher if others else player).core.view((watcher if others else player).local)
        heights += [figure.position[2] for figure in view.figures if figure.entity == player.core.entity]
    assert not [height for height in heights if -39 < height < 0.5]
    assert max(heights) > 0.5
    assert min(heights) < -39 or others, "the void is not in every view"
