"""The window of the game: what it draws where, keys and mouse, and a whole session without a display."""

import itertools
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.client import Client
from client_sdk.core import Core
from client_sdk.loopback import Loopback
from server.game import Game
from server.rules import Rules
from server.worlds.kinds import kind_of
from shared import kernels
from shared.blocks import Blocks
from shared.inputs import NEUTRAL, Input
from shared.scene import SCENES, Scene, load_scene
from shared.world import World
from sovereign_netcode.playtest import Link as Line
from sovereign_netcode.playtest import LocalWorlds, Match, Player
from tests.e2e.processes import END_S, START_S
from tests.lengths import long, long_but
from tests.patience import until

ROOT = Path(__file__).resolve().parents[2]
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import pygame  # noqa: E402

from client_sdk.bots import Wander  # noqa: E402
from sovereign_netcode.examples.dodge import Dodge  # noqa: E402
from sovereign_netcode.examples.dodge_brain import DodgePlayer  # noqa: E402
from sovereign_netcode.examples.freeze import Freeze  # noqa: E402
from sovereign_netcode.examples.race import Race  # noqa: E402
from sovereign_netcode.examples.tag import Tag  # noqa: E402
from sovereign_netcode.examples.tag_brain import TagPlayer  # noqa: E402
from sovereign_netcode.play import app, figures, iso, own_server  # noqa: E402
from sovereign_netcode.play.keys import Keys  # noqa: E402
from sovereign_netcode.play.window import SIZE, Window, keyboard  # noqa: E402


@pytest.fixture(autouse=True)
def _display() -> Iterator[None]:
    pygame.display.init()
    pygame.font.init()
    pygame.display.set_mode(SIZE)
    yield
    pygame.display.quit()


def blocks(*kinds: tuple[int, int, int, int]) -> Blocks:
    """Returns the blocks of an otherwise empty segment."""
    world = World(load_scene("flat"))
    world.load_segment((0, 0, 0), np.zeros(32768, np.uint8))
    for x, y, z, kind in kinds:
        world.set_block(x, y, z, kind)
    return world.blocks


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (3.5, -2.25, 7.0), (100.0, 40.0, 31.0)])
def test_a_pixel_is_seen_where_it_is(place: tuple[float, float, float]) -> None:
    assert iso.unproject(*iso.project(*place), place[2]) == pytest.approx(place[:2])


def test_the_mouse_points_at_the_first_block_and_the_free_cell_before_it() -> None:
    found = blocks((10, 10, 5, 1), (12, 8, 7, 1))  # the second one hides most of the first
    assert iso.target_of(found, iso.project(12.5, 8.5, 8), 6.0) == ((12, 8, 7), (12, 8, 8))
    assert iso.target_of(found, iso.project(13, 8.5, 7.5), 6.0) == ((12, 8, 7), (13, 8, 7))
    assert iso.target_of(found, iso.project(12.5, 8, 7.5), 6.0) == ((12, 8, 7), (12, 7, 7))
    assert iso.target_of(found, iso.project(10.5, 10.5, 6), 6.0) == ((12, 8, 7), (12, 8, 8))
    assert iso.target_of(found, iso.project(10.5, 10, 5.1), 6.0) == ((10, 10, 5), (10, 9, 5))
    assert iso.target_of(found, iso.project(20, 20, 6), 6.0) is None


def test_only_what_has_changed_is_drawn_anew() -> None:
    world = World(load_scene("meadow"))
    world.load_terrain()
    ground = iso.Ground()
    ground.refresh(world.blocks, 99)
    before = dict(ground.pictures)
    assert len(before) == 4
    ground.refresh(world.blocks, 99)
    assert ground.pictures == before
    world.set_block(40, 10, 30, 4)  # far from the rim, so without the shadow of other blocks
    ground.refresh(world.blocks, 0)
    assert ground.pictures == before, "no more than was asked for"
    ground.refresh(world.blocks, 1)
    assert [segment for segment in before if ground.pictures[segment] is not before[segment]] == [(1, 0, 0)]
    world.unload_segment((1, 1, 0))
    ground.refresh(world.blocks, 99)
    assert (1, 1, 0) not in ground.pictures


def test_faces_are_those_that_can_be_seen() -> None:
    ground = iso.Ground()
    ground.refresh(blocks((5, 5, 5, 1), (6, 5, 5, 1), (5, 5, 6, 1)), 1)
    faces = {cell: len(found) for cell, found in ground.pictures[(0, 0, 0)].faces.items()}
    assert faces == {(5, 5, 5): 1, (6, 5, 5): 3, (5, 5, 6): 3}


def test_a_block_in_front_covers_a_figure() -> None:
    target = pygame.Surface(SIZE)
    for wall, hides in (((7, 3, 0), True), ((7, 3, 1), True), ((3, 7, 0), False), ((5, 5, 3), False)):
        ground = iso.Ground()
        ground.refresh(blocks((*wall, 4)), 1)
        low, high = (5.2, 4.2, 0.0), (5.8, 4.8, 1.8)
        assert ground.cover(target, (-400.0, -400.0), low, high) == hides, wall


class Idle:
    """A transport that does nothing, because the match carries the messages."""

    def poll(self, now: float) -> None:
        pass

    send = poll

    def close(self, timeout: float) -> None:
        pass


class Session:
    """A window with a player of a match, by default of tag."""

    def __init__(self, latency_s: float = 0.01, scene: str = "meadow", rules: Rules | None = None) -> None:
        rules = rules or Tag()
        self.match = Match(load_scene(scene), 5, rules=rules)
        self.core = Core("Ann", behaviours=rules.behaviours)
        self.player: Player = self.match.join(self._input, Line(latency_s), self.core)
        self.window = Window(Client(self.core, Idle()), keyboard, "Tag", rules.keys)
        self.run(2)

    def _input(self, core: object, rng: random.Random) -> Input:
        return self.core.input if self.core.state == "playing" else NEUTRAL

    def run(self, seconds: float) -> None:
        """Runs for `seconds` at 20 frames a second."""
        for _ in range(round(20 * seconds)):
            self.match.run(0.05)
            self.window.frame(self.player.local)

    def press(self, key: int) -> None:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
        self.run(0.05)

    def colours(self) -> int:
        """Returns the number of different colours in the window."""
        surface = pygame.display.get_surface()
        assert surface is not None
        return len(np.unique(pygame.surfarray.array2d(surface)))


def test_all_players_are_drawn_and_the_keys_work() -> None:
    session = Session()
    window, core = session.window, session.core
    assert core.state == "playing"
    assert {actor.figure.entity for actor in window.actors} == set(session.match.game.api.entities())
    assert sum(actor.own for actor in window.actors) == sum(actor.it for actor in window.actors) == 1
    assert len({actor.tone for actor in window.actors}) == len(window.actors) == Tag.players_min
    assert session.colours() > 200
    session.press(pygame.K_g)
    assert window.ghost
    session.press(pygame.K_3)
    assert window.kind == 9
    session.press(pygame.K_LEFTBRACKET)
    assert window.client.link is None
    session.press(pygame.K_RIGHTBRACKET)
    session.press(pygame.K_RIGHTBRACKET)
    assert window.client.link == Line(0.05)
    session.run(3)
    assert core.stats.divergences == 0
    assert "closed" not in window.over
    session.press(pygame.K_ESCAPE)
    assert "closed" in window.over


def test_the_window_goes_from_world_to_world() -> None:
    class Gate(Rules):
        def on_command(self, player: Any, name: str, data: Any) -> bool:
            return self.game.send_away(player, self.game.worlds.create("pit"), reason="down you go")

    pit = kind_of("pit", Rules, load_scene("flat"), players_max=1, worlds_max=1)
    worlds = LocalWorlds(pit, default=Game(load_scene("meadow"), rules=Gate()))
    loopback = Loopback(worlds)
    client = loopback.join("Ann")
    window = Window(client, keyboard, "worlds")
    waiting = loopback.match("pit")
    second = Window(waiting, keyboard, "worlds")
    now = 0.0

    def run(seconds: float) -> None:
        nonlocal now
        for _ in range(round(20 * seconds)):
            now += 0.05
            window.frame(now)

    run(1)
    meadow = len(window._ground.pictures)
    client.command("down")
    run(2)
    assert client.world == "pit-1"
    assert len(window._ground.pictures) > meadow, "the whole ground of the other scene is drawn"
    for _ in range(80):
        now += 0.05
        second.frame(now)
    assert second._fetching == "waiting for a world: 1 of 1 ..."
    assert window.over == second.over == ""


def test_the_mouse_places_and_digs(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    window, world = session.window, session.match.game.world
    x, y, _ = (int(part // 1) for part in world.position(session.core.entity))
    ground = next(k for k in range(31, 0, -1) if world.blocks.get(x + 2, y - 2, k)), x + 2, y - 2
    spot = ground[1] + 0.5, ground[2] + 0.5, ground[0] + 1.0
    camera = window._camera
    assert camera is not None
    at = tuple(int(a - b) for a, b in zip(iso.project(*spot), camera, strict=True))
    monkeypatch.setattr(pygame.mouse, "get_pos", lambda: at)
    for button, kind in ((3, window.kind), (1, 0)):
        pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, button=button))
        session.run(0.5)
        if kind:
            assert world.blocks.get(ground[1], ground[2], ground[0] + 1) == kind
    assert world.blocks.get(ground[1], ground[2], ground[0] + 1) == 0


def test_a_slider_sets_the_latency(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    track = session.window._hud.slider.track
    kind, way = (
        pygame.MOUSEBUTTONDOWN,
        [(track.x + track.width // 4, 0.25), (track.centerx, 0.5), (2000, 1.0), (-5, 0.0)],
    )
    for x, lag_s in way:
        monkeypatch.setattr(pygame.mouse, "get_pos", lambda x=x: (x, track.centery))
        pygame.event.post(pygame.event.Event(kind, button=1))
        session.run(0.1)
        assert session.window.lag_s == pytest.approx(lag_s, abs=0.01)
        kind = pygame.MOUSEMOTION
    for each in (pygame.MOUSEBUTTONUP, pygame.MOUSEMOTION):  # the button is released: the mouse is free again
        monkeypatch.setattr(pygame.mouse, "get_pos", lambda: track.center)
        pygame.event.post(pygame.event.Event(each, button=1))
    session.run(0.1)
    assert session.window.lag_s == 0.0
    assert session.window.client.link is None


def test_the_latency_of_the_keys_is_as_much_as_they_say() -> None:
    match = Match(load_scene("flat"), 5)
    core = Core("Ann")
    Window(Client(core, Idle()), keyboard, "").lag(0.2)
    match.join(lambda core, rng: NEUTRAL, Line(0.01), core).frame_s = 0.001
    match.run(5)
    assert core.state == "playing"
    assert 0.22 <= core.clock.rtt_s < 0.225
    assert core.stats.corrections == 0


SHORT = [(Freeze, "topdown")]
EVERY = itertools.product([Rules, Tag, Freeze], sorted(path.stem for path in SCENES.glob("*.toml")))


@pytest.mark.parametrize(("make", "scene"), long_but(SHORT, EVERY))
def test_every_game_is_drawn_in_every_scene(make: type[Rules], scene: str) -> None:
    session = Session(scene=scene, rules=make())
    assert session.core.state == "playing"
    assert {actor.figure.entity for actor in session.window.actors} == set(session.match.game.api.entities())
    assert session.colours() > 200
    assert session.match.game.counters.rules_failed == 0


class Quiet(Dodge):
    """Dodge without players of the server, who would put the own one out."""

    players_min = 1


def test_balls_cars_and_health_are_drawn_and_the_mouse_throws(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(scene="flat", rules=Quiet())
    window, game, me = session.window, session.match.game.api, session.core.entity
    assert window.keys.names == {"jump": "space", "dash": "left shift", "fire": "left mouse"}
    assert "Left shift: dash    Left mouse: fire" in window.keys.text()
    session.run(1)
    camera = window._camera
    assert camera is not None
    x, y, z = game.position(me)
    at = tuple(int(a - b) for a, b in zip(iso.project(x + 4, y, z), camera, strict=True))
    monkeypatch.setattr(pygame.mouse, "get_pos", lambda: at)
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, button=1))
    session.run(0.3)
    mine = [actor for actor in window.actors if actor.ball and actor.figure.fields["by"] == me]
    assert len(mine) == 1
    assert mine[0].figure.velocity[0] > 5, "it flies east, to the mouse"
    assert mine[0].tone == next(actor.tone for actor in window.actors if actor.own), "the colour of the team"
    assert not any(actor.car for actor in window.actors)
    assert session.core.stats.corrections_by_cause.get("nondeterminism", 0) == 0
    session = Session(scene="topdown", rules=Race())
    assert all(actor.car for actor in session.window.actors)
    assert session.colours() > 200


def test_keys_are_those_of_the_rules_and_else_of_the_window() -> None:
    keys = Keys(("jump", "a", "b", "c"), {"b": "left mouse"})
    assert keys.names == {"jump": "space", "a": "left shift", "b": "left mouse", "c": "e"}
    assert keys.held(lambda code: code in (pygame.K_e, -1)) == ("b", "c")
    assert -1 in keys
    assert -3 not in keys
    with pytest.raises(RuntimeError, match=r"keys\.a = 'leftt': there is no such key"):
        Keys(("a",), {"a": "leftt"})


def test_a_game_that_cannot_be_loaded_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert app.main(["--game", "no_such_module:Game"]) == 2
    assert "error: game = 'no_such_module:Game': cannot be loaded" in capsys.readouterr().err


def test_bots_play_the_game_of_the_window() -> None:
    assert isinstance(own_server.policy(Dodge(), 1)._policy, DodgePlayer)
    assert isinstance(own_server.policy(Tag(), 1)._policy, TagPlayer)
    assert isinstance(own_server.policy(Freeze(), 1)._policy, Wander)


@pytest.mark.parametrize("driver", ["dummy", "offscreen", "no_such_driver"])
def test_without_a_display_nothing_is_started_and_the_exit_code_says_so(
    driver: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    monkeypatch.setattr(own_server, "process", lambda *command: pytest.fail(f"{command} was started"))
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    assert app.main([]) == app.main(["--url", "ws://127.0.0.1:1"]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 2
    assert all(line.startswith("error: no display to open a window on (") for line in told.err.splitlines())


@pytest.mark.e2e
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, *long(signal.SIGTERM)])
def test_the_end_of_the_window_is_the_end_of_its_server_and_bots(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sovereign_netcode.play", "--script-demo", str(tmp_path / "out.png")]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        until(lambda: len(children.read_text().split()) == 2, START_S)  # a server and a process of bots
        started = children.read_text().split()
        process.send_signal(number)
        assert process.wait(END_S) == 0
    assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.skipif(not kernels.available(), reason="with plain Python the bots take all the time there is")
def test_a_scripted_session_walks_jumps_builds_and_sees_a_hand_over(tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    command = [sys.executable, "-m", "sovereign_netcode.play", "--script-demo", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    seen = {
        what: float(much) for what, much in (part.rsplit(" ", 1) for part in done.stdout.split("\n")[-2].split(", "))
    }
    assert seen["walked"] > 1
    assert seen["jumped"] > 1
    assert seen["placed"] >= 3
    assert seen["tagged"] >= 1
    assert pygame.image.load(out).get_size() == SIZE


class Boxes(Rules):
    """Rules with a crate in a colour of its own beside each player."""

    scene = "flat"

    def prepare(self, scene: Scene) -> Scene:
        return scene.with_template("crate", walk_speed=0, box_size=(1.5, 1.5, 1.0), box_offset=(-0.75, -0.75, 0))

    def on_join(self, player: Any) -> None:
        x, y, z = self.game.position(player.entity)
        self.game.spawn("crate", (x + 3, y, z), colour="#10e0f0")


def test_a_crate_is_a_box_of_its_size_in_the_colour_of_its_attribute() -> None:
    session = Session(scene="flat", rules=Boxes())
    (crate,) = (actor for actor in session.window.actors if actor.figure.template == "crate")
    assert (crate.box, crate.size, crate.tone) == (True, [1.5, 1.5, 1.0], (0x10, 0xE0, 0xF0))
    surface = pygame.display.get_surface()
    assert surface is not None
    pixels = pygame.surfarray.array3d(surface).reshape(-1, 3)
    width, depth = 2 * 1.5 * iso.HALF, 2 * 1.5 * iso.QUARTER
    top = (pixels == np.array([0x10, 0xE0, 0xF0])).all(axis=1).sum()
    assert top == pytest.approx(width * depth / 2, rel=0.15), "the top face has this many pixels"


@pytest.mark.parametrize("name", ["red", "#12345", "#gggggg", 7, None])
def test_a_colour_that_is_none_is_ignored(name: object) -> None:
    assert figures.colour_named(name) is None


@pytest.mark.e2e
@pytest.mark.slow
def test_a_picture_of_any_game_is_saved_without_a_display(tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    command = [sys.executable, "-m", "sovereign_netcode.play", "--game", "sovereign_netcode.examples.race:Race"]
    done = subprocess.run([*command, "--picture", str(out)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(np.unique(pygame.surfarray.array2d(pygame.image.load(out)))) > 200
