"""Every step of docs/tutorial.md runs as it is printed, in simulated time.

Each test writes the files of a step to a folder of its own and imports them from there. The window runs without a
display; its keys are events that the test posts.
"""

import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pygame
import pytest

from client_sdk import Client, Loopback, client
from client_sdk.bots import Stand
from client_sdk.events import Announced, Corrected, Diverged, Event, Happened, Withdrawn
from client_sdk.netsim.links import PRESETS
from server.game import Game
from shared.inputs import NEUTRAL, make_input
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, Player, bot
from tests.client_sdk.servers import real_server
from tests.lengths import long
from tests.readme import tutorial
from tests.readme.pages import ROOT

FILES = ("abilities", "bots", "brain", "dodge", "test_dodge", "window")
FRAMES_PER_S = 60
CLICK = pygame.event.Event(pygame.MOUSEBUTTONDOWN, button=1, pos=(0, 0))


class Step:
    """The modules of a step, and its games."""

    def __init__(self, folder: Path, number: int) -> None:
        self.folder = folder
        tutorial.write(number, folder)

    def __getattr__(self, name: str) -> Any:
        if name not in FILES:
            raise AttributeError(name)
        found: ModuleType = importlib.import_module(name)
        assert found.__file__ == str(self.folder / f"{name}.py")
        return found

    def match(self) -> Match:
        rules = self.dodge.Dodge()
        return Match(load_scene(rules.scene), seed=1, rules=rules)


@pytest.fixture
def step(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Step]:
    """The step of the tutorial whose number is the parameter."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield Step(tmp_path, request.param)
    for name in FILES:
        sys.modules.pop(name, None)
    pygame.quit()


def of_step(number: int) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("step", [number], indirect=True)


def hand(match: Match, link: str = "typical") -> Player:
    """Adds a player whose input a test sets. The player stands on the ground."""
    player = match.join(lambda core, _: core.input, PRESETS[link])
    match.run(4)
    return player


def watch(step: Step, monkeypatch: pytest.MonkeyPatch, script: dict[int, list[Any]], frames: int) -> Client:
    """Runs the step's window on a game within this process.

    Args:
        step: the step to run.
        monkeypatch: replaces the clocks.
        script: events of pygame to post before some frames, by frame.
        frames: number of frames until the window is closed.

    Returns:
        The client, whose picture is still on pygame's display surface.
    """
    rules, now, count = step.dodge.Dodge(), [0.0], [0]
    player = Loopback(Game(rules.prepare(load_scene(rules.scene)), rules=rules)).join("Ann")
    poll = player.poll

    def frame() -> list[Event]:
        now[0] += 1 / FRAMES_PER_S
        count[0] += 1
        for event in script.get(count[0], ()):
            pygame.event.post(event)
        if count[0] == frames:
            pygame.event.post(pygame.event.Event(pygame.QUIT))
        return poll()

    monkeypatch.setattr(client, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(pygame.time, "Clock", lambda: SimpleNamespace(tick=lambda rate: None))
    monkeypatch.setattr(player, "poll", frame)
    pygame.display.init()
    step.window.run(player)
    assert player.playing
    assert player.stats.divergences == 0
    return player


def keys(kind: int, *names: str) -> list[Any]:
    return [pygame.event.Event(kind, key=pygame.key.key_code(name)) for name in names]


def pixel(step: Step, place: tuple[float, float, float]) -> tuple[int, ...]:
    """Returns the colour in which the window shows a position."""
    surface = pygame.display.get_surface()
    assert surface is not None
    x, y = step.window.at(*place)
    return tuple(surface.get_at((round(x), round(y))))


def colour(name: str) -> tuple[int, ...]:
    return tuple(pygame.Color(name))


@of_step(1)
def test_a_client_walks(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.init()
    played = watch(step, monkeypatch, {120: keys(pygame.KEYDOWN, "d", "space")}, 180)
    me = played.view().me
    assert me is not None
    assert me.position[0] > 6
    assert pixel(step, me.position) == colour("white")
    assert pixel(step, (10.5, 9, 1)) == colour("gray30"), "a wall"
    assert pixel(step, (16, 16, 1)) == colour("darkolivegreen")


@of_step(2)
def test_a_bump_scores_for_both(step: Step) -> None:
    match = step.match()
    ann, bob = hand(match), hand(match)
    game = match.game.api
    game.place(ann.core.entity, (16, 16, 1))
    game.place(bob.core.entity, (18, 16, 1))
    ann.core.set_input(make_input(1, 0))
    match.run(1)
    assert game.get(ann.core.entity, "score") == game.get(bob.core.entity, "score") == 1
    assert match.game.counters.rules_failed == 0


@of_step(2)
def test_the_window_shows_scores(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    monkeypatch.setattr(step.window, "write", lambda screen, text, middle: shown.append(text))
    watch(step, monkeypatch, {}, 120)
    assert shown[-1] == "Ann 0"


def dash(match: Match) -> tuple[Player, float]:
    """Lets a player dash east. Returns it, and its speed in the prediction after three ticks, in blocks/s."""
    player = hand(match)
    player.core.set_input(make_input(1, 0), {"dash": True})
    match.run(3 / 32)
    player.core.set_input(NEUTRAL)
    assert player.core.prediction is not None
    return player, player.core.prediction.predicted.velocity(player.core.entity)[0]


@of_step(3)
def test_a_dash_by_the_rules_waits(step: Step) -> None:
    match = step.match()
    player, speed = dash(match)
    assert 0 < speed <= 4.5
    match.run(1)
    assert "server act" in [event.cause for event in player.events if isinstance(event, Corrected)]
    assert match.game.api.position(player.core.entity)[0] > 5.5
    assert match.game.counters.rules_failed == 0


@of_step(3)
def test_a_key_simulates_a_bad_link(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.init()
    played = watch(step, monkeypatch, {130: keys(pygame.KEYDOWN, "l"), 140: keys(pygame.KEYUP, "l")}, 150)
    assert played.link == PRESETS["typical"]


@of_step(4)
def test_a_dash_by_a_behaviour_does_not(step: Step) -> None:
    match = step.match()
    player, speed = dash(match)
    assert speed > 8
    assert [event.name for event in player.events if isinstance(event, Announced)] == ["dash"]
    match.run(1)
    assert not [event for event in player.events if isinstance(event, Corrected | Withdrawn | Diverged)]
    assert match.game.api.position(player.core.entity)[0] > 5.5


@of_step(4)
def test_the_window_dashes(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.init()
    script = {120: keys(pygame.KEYDOWN, "d"), 130: keys(pygame.KEYDOWN, "left shift")}
    played = watch(step, monkeypatch, script, 140)
    me = played.view().me
    assert me is not None
    assert me.fields["ready_at"] > 0


@of_step(5)
def test_a_ball_flies_at_once_under_its_number(step: Step) -> None:
    match = step.match()
    player = hand(match)
    player.core.set_input(make_input(aim=(0, 1, 0)), {"fire": True})
    match.run(1.5 / 32)
    player.core.set_input(NEUTRAL)
    assert player.core.prediction is not None
    (ball,) = player.core.prediction.spawned()
    assert ball not in match.game.world
    match.run(0.5)
    assert match.game.api.entities("ball") == [ball]
    match.run(2)
    assert match.game.api.entities("ball") == []
    assert not [event for event in player.events if isinstance(event, Corrected | Diverged)]


@of_step(5)
def test_the_window_throws(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pygame.mouse, "get_pos", lambda: (639, 320))
    played = watch(step, monkeypatch, {120: [CLICK]}, 140)
    (ball,) = (figure for figure in played.view().figures if figure.template == "ball")
    assert pixel(step, ball.position) == colour("tomato")
    assert ball.velocity[0] > 8


def throw(match: Match, thrower: Player, target: Player) -> None:
    """Puts a player beside another one, and lets it throw until it has hit or its ball is gone."""
    game, foe, me = match.game.api, thrower.core.entity, target.core.entity
    x, y, z = game.position(me)
    game.place(foe, (x + 3, y, z))
    match.run(0.5)
    thrower.core.set_input(make_input(aim=(-1, 0, 0)), {"fire": True})
    match.run(0.1)
    thrower.core.set_input(NEUTRAL)
    match.run(1)


@of_step(6)
def test_three_hits_put_a_player_out(step: Step) -> None:
    match = step.match()
    target, thrower = hand(match, "regional"), hand(match, "regional")
    game, me = match.game.api, target.core.entity
    game.place(me, (16, 16, 1))
    for count in (1, 2, 3):
        throw(match, thrower, target)
        assert game.get(thrower.core.entity, "score") == game.field(me, "hits") == count
    assert game.position(me)[0] < 15, "knocked back"
    assert (game.template(me), game.field(me, "health")) == ("out", 0)
    match.run(3)
    assert (game.template(me), game.field(me, "health")) == ("player", 3)
    told = [event.data for event in target.events if isinstance(event, Happened)]
    assert told == [{"by": thrower.core.entity, "who": me}]
    assert match.game.counters.rules_failed == target.core.stats.divergences == 0


@of_step(7)
def test_teams_and_rounds(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step.dodge, "ROUND_S", 14)
    match = step.match()
    players = [match.join(bot(Stand(match.game.api.random)), Link(0.02)) for _ in range(3)]
    match.run(4)
    game, (ann, bob, cleo) = match.game.api, players
    assert [game.field(player.core.entity, "team") for player in players] == [0, 1, 0]
    assert [game.position(player.core.entity)[0] < 16 for player in players] == [True, False, True]
    for player in players:
        player.policy = lambda core, _: core.input
    game.place(cleo.core.entity, (2, 2, 1))
    game.place(ann.core.entity, (16, 16, 1))
    for _ in range(3):
        throw(match, bob, ann)
    assert game.shared["points"] == {"blue": 0, "yellow": 1}
    throw(match, cleo, ann)
    assert game.get(cleo.core.entity, "score") == 0, "balls fly through friends"
    match.run_until(lambda: game.shared["points"]["yellow"] == 0, 20)
    match.run(0.2)
    assert {"winner": "yellow"} in [event.data for event in bob.events if isinstance(event, Happened)]
    assert match.game.counters.rules_failed == 0


@of_step(8)
@pytest.mark.parametrize("link", ["regional", *long("typical", "wifi")])
def test_the_tests_of_the_tutorial(step: Step, link: str) -> None:
    step.test_dodge.test_bots_play(link)


@of_step(8)
def test_the_other_tests_of_the_tutorial(step: Step) -> None:
    step.test_dodge.test_a_dash_does_not_wait()
    others = {"test_bots_play", "test_a_dash_does_not_wait", "test_both_sides_compute_the_same"}
    assert {name for name in vars(step.test_dodge) if name.startswith("test_")} == others


@pytest.mark.slow
@of_step(8)
def test_both_sides_compute_the_same(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(step.folder))
    step.test_dodge.test_both_sides_compute_the_same()


@of_step(8)
def test_what_the_window_of_sovereign_play_needs(step: Step) -> None:
    rules = step.dodge.Dodge()
    scene = rules.prepare(load_scene(rules.scene))
    assert set(rules.keys) == set(scene.buttons) - {"jump"}
    assert isinstance(rules.bot_policy(None), step.brain.Brain)


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.asyncio
@of_step(8)
async def test_bots_on_a_server(step: Step, capsys: pytest.CaptureFixture[str]) -> None:
    program = (sys.executable, "-m", "sovereign_netcode.server")
    with real_server("--game", "dodge:Dodge", program=program, folder=step.folder) as url:
        await step.bots.main(3, url, seconds=5)
    assert re.match(r"each: \d+\.\d corrections/min, [1-9]\d* B/s down, \d+\.\d % late", capsys.readouterr().out)


@of_step(9)
def test_the_window_shows_the_network(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.init()
    shown: list[str] = []
    monkeypatch.setattr(step.window, "write", lambda screen, text, middle: shown.append(text))
    script = {120: [CLICK, *keys(pygame.KEYDOWN, "o")], 121: keys(pygame.KEYUP, "o")}
    played = watch(step, monkeypatch, script, 130)
    assert {*played.overlay().splitlines()} & {*shown}
    assert any(re.fullmatch(r"blue 0   yellow 0   1\d\d s", text) for text in shown)


@pytest.mark.slow
def test_the_script_makes_the_pictures(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.readme.tutorial_pictures", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=120)
    for name, size in (("tutorial.png", (640, 640)), ("tutorial_play.png", (640, 400))):
        assert pygame.image.load(tmp_path / name).get_size() == size
        assert f"({name})" in tutorial.PAGE.read_text("utf-8")


def test_there_are_nine_steps_and_no_other_files() -> None:
    found = tutorial.steps()
    assert list(found) == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert sorted(found[9]) == sorted([*(f"{name}.py" for name in FILES), "court.toml"])
    fences = re.findall(r"^```(python|toml)( \S+)?$", tutorial.PAGE.read_text("utf-8"), re.MULTILINE)
    assert all(name for _, name in fences)


def test_parts_of_a_file_replace_others() -> None:
    old = '"""A."""\n\nimport a\n\nX = 1\n\n\nclass B:\n    x = 1\n\n    def f(self):\n        pass\n\n\nY = 2\n'
    new = (
        "import b\n\nX = 3\nZ = 4\n\n\nclass B:\n    y = 2\n\n    def g(self):\n        pass\n\n\nclass C:\n    x = 0\n"
    )
    assert tutorial.merged(old, new) == (
        '"""A."""\n\nimport a\nimport b\n\nX = 3\n\n\nclass B:\n    x = 1\n    y = 2\n\n    def f(self):\n'
        "        pass\n\n    def g(self):\n        pass\n\n\nclass C:\n    x = 0\n\n\nY = 2\nZ = 4\n"
    )
