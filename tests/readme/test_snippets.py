"""All programs in the README and docs/ run as they are printed.

pygame-ce is installed for the tests and runs without a display. The other engines are heavy (12 to 200 MB) and are used
where they are installed; elsewhere a stand-in with the same kind of loop takes their place.
"""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import pytest

from client_sdk import Loopback
from client_sdk.bots import Follow, Wander
from client_sdk.core import Core
from client_sdk.events import Announced, Answered, BehaviourFailed, Corrected, Happened, Withdrawn
from client_sdk.netsim.links import PRESETS
from server.game import Game
from server.rules import with_options
from shared.inputs import make_input
from shared.messages import Go
from shared.scene import Scene, Template, load_scene
from sovereign_netcode.playtest import Match, bot, wander
from tests.client_sdk.servers import ROOT, real_server, scripted_server
from tests.client_sdk.test_worlds_over_sockets import Told
from tests.lengths import long
from tests.readme.pages import programs
from tests.readme.run_snippet import LOOPS, URL
from tests.server.worlds.hosts import Server, kind

ENGINES = ["pygame-ce", "pyglet", "arcade", "Panda3D", "ursina"]
ON_A_SERVER = ["asyncio", "A bot"]
WORLDS = "Worlds and matches"
WAITS = "Threads, timers and asyncio"
QUEUE = "A queue with a rule of its own"
GAMES = [QUEUE, "Buttons and aim", "Behaviours", "Declared commands", "Before a join", "Options"]
ALONE = ["A game", "Without a socket", "Testing it", "Agents that learn", WAITS, *GAMES]
A_FILE = "Your own game"


def run(*arguments: str) -> str:
    command = [sys.executable, "-m", "tests.readme.run_snippet", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_there_are_no_others() -> None:
    assert sorted(programs()) == sorted([*ENGINES, *LOOPS, *ON_A_SERVER, *ALONE, WORLDS, A_FILE])


@pytest.mark.parametrize("engine", [ENGINES[0], *long(*ENGINES[1:])])
def test_an_engines_loop(engine: str) -> None:
    said = run(engine).splitlines()[-1]
    assert said.startswith("walked, and all are shown by ")
    assert engine != "pygame-ce" or said.endswith("the engine")


@pytest.mark.parametrize(("name", "says"), [(LOOPS[0], "Joined(entity=1"), *long((LOOPS[1], "in hills as "))])
def test_a_bare_loop(name: str, says: str) -> None:
    lines = run(name).splitlines()
    assert any(line.startswith(says) for line in lines)
    assert lines[-1] == "walked"


@pytest.mark.e2e
def test_asyncio_and_bots() -> None:
    with real_server("--scene", "flat") as url:
        assert "walked" in run("asyncio", url)
        said = run("A bot", url)
        assert "Joined(" in said
        assert "walked" in said


def test_worlds_and_matches(capsys: pytest.CaptureFixture[str]) -> None:
    told = Told()
    go = Go("/arena-1?seat=a", "", ["/arena-1?seat=b"], "matched")
    with scripted_server(told.sends_on(go), told.says_goodbye) as url:
        exec(compile(programs()[WORLDS].replace(URL, url), WORLDS, "exec"), {})
    assert told.paths[0] == "/match?kind=arena&mode=2v2&seats=2"
    found = "found arena-1 - a friend joins with Client.join(url, seat=...): ('/arena-1?seat=b',)"
    assert capsys.readouterr().out.splitlines() == [found, "over: that was it"]


def test_a_queue_with_a_rule_of_its_own() -> None:
    ranked = alone(QUEUE)["Ranked"]
    server = Server(kind("duel", ranked, players_max=2), authenticate=lambda token: token)
    ann, bob, cleo = (server.peer("/match?kind=duel", name=name, token=name) for name in ("ann", "bob", "cleo"))
    server.run(5)
    assert ann.go.path.partition("?")[0] == bob.go.path.partition("?")[0] == "/duel-1"
    server.run(5)
    assert cleo.over is None
    assert server.worlds.faults.total == 0


def alone(name: str) -> dict[str, Any]:
    """Runs a program that needs nothing else. Returns its global variables."""
    assert name in ALONE
    space: dict[str, Any] = {}
    exec(compile(programs()[name], name, "exec"), space)
    return space


def test_buttons_and_aim() -> None:
    rules = alone("Buttons and aim")["Balls"]()
    match = Match(load_scene(rules.scene), seed=1, rules=rules)
    player = match.join(lambda core, _: core.input)
    match.run(4)
    player.core.set_input(make_input(aim=(1, 0, 0.5)), {"fire": True})
    match.run(0.5)
    (ball,) = match.game.api.entities("ball")
    east, north, _ = match.game.api.velocity(ball)
    assert east == pytest.approx(20 / 1.25**0.5, abs=0.01)
    assert north == 0
    assert match.game.counters.rules_failed == player.core.stats.divergences == 0


def test_behaviours() -> None:
    """The dash and the ball are in the prediction at once; the server confirms both, and the ball by its number."""
    rules = alone("Behaviours")["Dash"]()
    match = Match(load_scene(rules.scene), seed=1, rules=rules)
    player = match.join(lambda core, _: core.input, PRESETS["typical"])
    match.run(4)
    player.core.set_input(make_input(1, 0), {"dash": True, "fire": True})
    match.run(1.5 / match.game.scene.tick_rate)
    assert [event.name for event in player.events if isinstance(event, Announced)] == ["dash"]
    me = player.core.entity
    assert player.core.prediction is not None
    (ball,) = player.core.prediction.spawned()
    assert ball not in match.game.world
    match.run(0.3)
    assert match.game.api.entities("ball") == [ball]
    assert match.game.api.field(me, "stamina") == 80
    match.run(3)
    assert match.game.api.entities("ball") == []
    assert not [event for event in player.events if isinstance(event, Corrected | Withdrawn | BehaviourFailed)]


def test_declared_commands() -> None:
    rules = alone("Declared commands")["Shop"]()
    match = Match(load_scene(rules.scene), seed=1, rules=rules)
    player = match.join(wander)
    match.run(2)
    for name, data in (("say", {"text": "hello"}), ("buy", {"item": "bow"}), ("buy", {"item": "shoe"})):
        player.core.command(name, data)
    match.run(1)
    answers = [(event.done, event.verdict) for event in player.events if isinstance(event, Answered)]
    assert answers == [
        (True, "done"),
        (False, "no bow left"),
        (False, "buy.item = 'shoe': must be one of sword, bow"),
    ]
    assert [event.data for event in player.events if isinstance(event, Happened)] == [
        {"text": "hello", "by": player.core.entity}
    ]


def test_options() -> None:
    match = Match(load_scene("flat"), seed=1, rules=with_options(alone("Options")["Rounds"], {"round_s": "90"}))
    match.run(0.5)
    assert match.game.api.shared["ends"] == 1 + 90 * match.game.scene.tick_rate


def test_what_is_loaded_before_a_join() -> None:
    rules = alone("Before a join")["Vault"]()
    client = Loopback(Game(load_scene(rules.scene), rules=rules)).join("Ann")
    for frame in range(120):
        client.poll(frame / 60)
        client.update(frame / 60)
    assert rules.game.get(client.entity, "gold") == 12


def test_single_player() -> None:
    client = alone("Without a socket")["client"]
    assert client.playing
    assert client.stats.inputs_late == client.stats.divergences == 0


def test_a_match() -> None:
    assert alone("Testing it")["match"].now == 30


def test_agents() -> None:
    assert alone("Agents that learn")["truncations"] == {f"player_{i}": True for i in range(4)}


def test_the_smallest_game() -> None:
    """Bots play it. Two players that touch each other get a point each."""
    rules = alone("A game")["Bounce"]()
    match = Match(load_scene(rules.scene), seed=1, rules=rules)
    match.join(bot(Follow(Random(1))))
    match.join(bot(Wander(Random(2))))
    match.run(20)
    game = match.game.api
    scores = [game.get(entity, "score") for entity in game.entities("player")]
    assert len(scores) == 2
    assert scores[0] == scores[1] > 0
    ann = match.join(lambda core, _: core.input, PRESETS["typical"])
    match.run(3)
    x = game.position(ann.core.entity)[0]
    ann.core.set_input(make_input(1, 0), {"dash": True})
    match.run(1)
    assert game.position(ann.core.entity)[0] > x + 6, "4.5 blocks is a walk"
    assert match.game.counters.rules_failed == 0


def test_a_thread_that_comes_back_into_a_tick() -> None:
    rules = alone(WAITS)["Bank"]()
    match = Match(load_scene("flat"), 1, rules=rules)
    ann = match.join(wander, core=Core("Ann"))
    match.run_until(lambda: ann.core.state == "playing", 30)
    rules.pool.shutdown()
    match.run(1)
    assert match.game.api.get(ann.core.entity, "gold") == 3
    assert match.game.counters.rules_failed == 0


def test_a_game() -> None:
    """The README shows the whole example; tests/examples/test_freeze.py plays it."""
    text = (ROOT / "sovereign_netcode" / "examples" / "freeze.py").read_text("utf-8")
    assert len(text.splitlines()) < 30
    assert programs()[A_FILE] == text


def test_a_scene(tmp_path: Path) -> None:
    found = programs("toml")
    assert found.keys() == {"Scenes", "Kinds of blocks", "Kinds"}
    (file := tmp_path / "island.toml").write_text(found["Scenes"] + found["Kinds of blocks"], "utf-8")
    scene = load_scene(str(file))
    assert repr(scene) == "<Scene 'island', 96 x 64 x 32 blocks, 32 ticks/s>"
    assert (scene.kind("water"), scene.passable) == (7, (7,))
    assert scene == dataclasses.replace(scene, tick_rate=Scene.tick_rate, gravity=Scene.gravity), "the defaults"
    client = Loopback(Game(scene)).join("Ann")
    for frame in range(120):
        client.poll(frame / 60)
        client.update(frame / 60)
    assert client.playing


def test_the_table_of_templates() -> None:
    page = (ROOT / "docs" / "games.md").read_text("utf-8")
    assert set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == {
        field.name for field in dataclasses.fields(Template) if field.name != "name"
    }
