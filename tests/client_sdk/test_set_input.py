"""`set_input` of the clients: buttons by name and an aim, before and after the scene is known."""

import asyncio
import random
from typing import Any

import numpy as np
import pytest

from client_sdk import Client, Loopback
from client_sdk.async_client import AsyncClient
from client_sdk.bots import POLICIES, Bot
from client_sdk.core import Core
from client_sdk.events import Corrected, Joined
from client_sdk.netsim.links import PRESETS
from server.game import Game
from shared.aim import NO_AIM, make_aim
from shared.checks import SceneError
from shared.inputs import Input, make_input
from shared.messages import Inputs, decode_from_client
from shared.scene import Scene
from sovereign_netcode.playtest import Link, Match
from tests.client_sdk.servers import real_server
from tests.worlds import scene

NAMES = ("jump", "dash", "fire")


def yard(**changes: Any) -> Scene:
    """Returns a scene with three buttons, and a floor around its spawn."""
    fill = [[-30, -30, -1, 30, 30, 0, 1]]
    return scene(fill, **({"buttons": NAMES, "tick_rate": 32, "spawns": [(0.0, 0.0, 0.0)]} | changes))


def joined(made: Scene) -> Client:
    client = Loopback(Game(made, compiled=False)).join("Ann")
    for frame in range(120):
        client.poll(frame / 60)
        client.update(frame / 60)
    assert client.playing
    return client


@pytest.mark.parametrize(
    ("given", "bits"),
    [
        ({}, 0),
        ({"jump": True}, 1),
        ({"buttons": ("dash",)}, 2),
        ({"buttons": "dash"}, 2),
        ({"buttons": ["fire", "dash"], "jump": True}, 7),
        ({"buttons": {"jump", "fire"}}, 5),
        ({"buttons": {"dash": True, "fire": False}}, 2),
        ({"buttons": {"dash": np.True_, "fire": 1, "jump": 0}}, 6),
        ({"buttons": (name for name in NAMES)}, 7),
    ],
)
def test_buttons_by_name(given: dict[str, Any], bits: int) -> None:
    client = joined(yard())
    client.set_input(0, 0, **given)
    assert client.core.input == Input(0, 0, bits)


def test_an_unknown_button_is_named_with_the_known_ones_and_nothing_is_done() -> None:
    client = joined(yard())
    client.set_input(1, 0, buttons="dash")
    for wrong in ("sprint", ("dash", "sprint"), {"sprint": True, "dash": True}):
        with pytest.raises(ValueError, match=r"^button = 'sprint': no such button \(there are jump, dash, fire\)$"):
            client.set_input(0, 0, buttons=wrong)
    for bad in (5, None, b"dash", [5], {"dash": "down"}, {5: True}):
        with pytest.raises(ValueError, match=r"^buttons"):
            client.set_input(0, 0, buttons=bad)  # type: ignore[arg-type]
    assert client.core.input == Input(127, 0, 2)


def test_an_aim_in_a_scene_with_and_without_one() -> None:
    client = joined(yard(aim=True))
    client.set_input(0, 0, aim=(0.0, 3.5, 0.0))
    assert client.core.input.aim == (0, 32767, 0)
    client.set_input(0, 0)
    assert client.core.input.aim == NO_AIM
    plain = joined(yard())
    plain.set_input(0, 0, aim=(0, 0, 0))
    with pytest.raises(ValueError, match=r"^aim = \(0, 32767, 0\): the scene 'test' has no aim"):
        plain.set_input(1, 0, aim=(0, 1, 0))
    with pytest.raises(ValueError, match=r"^aim\.x = nan"):
        client.set_input(1, 0, aim=(float("nan"), 1, 0))
    assert plain.core.input == Input()


def start(made: Scene, **given: Any) -> tuple[Client, list[str]]:
    """Sets an input before the client knows the scene, once, and plays on. Returns the client and its errors."""
    client = Loopback(Game(made, compiled=False)).join("Ann", link=Link(0.05))
    client.set_input(1, 0, **given)
    errors = []
    for frame in range(180):
        client.poll(frame / 60)
        try:
            client.update(frame / 60)
        except ValueError as error:
            errors.append(str(error))
    assert client.playing
    return client, errors


def test_names_before_the_scene_is_known_count_once_it_is() -> None:
    client, errors = start(yard(aim=True), buttons=("fire", "dash"), jump=True, aim=(0, 0, -1))
    assert errors == []
    assert client.core.input == Input(127, 0, 7, (0, 0, -32767))
    prediction = client.core.prediction
    assert prediction is not None
    assert prediction.confirmed.state(client.entity)[11] == 7


def test_the_newest_names_before_the_scene_is_known_count() -> None:
    client = Loopback(Game(yard(), compiled=False)).join("Ann", link=Link(0.05))
    for buttons in ("nonsense", "dash"):
        client.set_input(1, 0, buttons=buttons)
    for frame in range(180):
        client.poll(frame / 60)
        client.update(frame / 60)
    assert client.playing
    assert client.core.input == Input(127, 0, 2)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"buttons": ("dash", "sprint")}, "button = 'sprint': no such button (there are jump, dash, fire)"),
        ({"buttons": "dash", "aim": (1, 0, 0)}, "aim = (32767, 0, 0): the scene 'test' has no aim (`Scene.aim`)"),
    ],
)
def test_a_wrong_name_before_the_scene_is_known_is_told_once(given: dict[str, Any], said: str) -> None:
    client, errors = start(yard(), **given)
    assert errors == [said]
    assert client.core.input == Input(127, 0, 0)
    client.set_input(0, 1, buttons="dash")
    assert client.core.input == Input(0, 127, 2)


def test_a_program_that_knows_its_scene_is_told_at_once() -> None:
    core = Core("Ann", yard())
    core.set_input(Input(), "dash")
    assert core.input == Input(0, 0, 2)
    for wrong in ((Input(), "sprint"), (Input(0, 0, 0, (1, 0, 0)), ())):
        with pytest.raises(SceneError):
            core.set_input(*wrong)
    assert core.input == Input(0, 0, 2)


@pytest.mark.e2e
def test_an_async_client_goes_on_after_a_wrong_name() -> None:
    async def main(url: str) -> list[str]:
        said: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: said.append(str(context["exception"])))
        async with await AsyncClient.connect(url) as client:
            client.set_input(0, 1, buttons="sprint")
            async for event in client:
                if isinstance(event, Joined):
                    break
            assert client.core.input == Input(0, 127)
            client.set_input(0, 1, buttons={"jump": True})
            assert client.core.input == Input(0, 127, 1)
        return said

    with real_server("--scene", "flat") as url:
        assert asyncio.run(main(url)) == ["button = 'sprint': no such button (there are jump)"]


# -- what is sent --------------------------------------------------------------------------------------------


class Sent(Core):
    """Keeps the messages that it sends."""

    def __init__(self) -> None:
        super().__init__("Ann", patience_s=30.0)
        self.sent: list[bytes] = []

    def outgoing(self) -> list[bytes]:
        sent = super().outgoing()
        self.sent += sent
        return sent


def random_inputs(aim: bool) -> Any:
    def plays(core: Core, rng: random.Random) -> Input:
        if rng.random() < 0.2:
            aimed = [rng.uniform(-1, 1) for _ in range(3)] if aim else None
            return make_input(rng.uniform(-1, 1), rng.uniform(-1, 1), buttons=rng.randrange(8), aim=aimed)
        return core.input

    return plays


@pytest.mark.parametrize("name", ["lan", "typical", "wifi", "outage"])
def test_a_lone_player_with_buttons_and_aim_is_not_corrected(name: str) -> None:
    match = Match(yard(aim=True), seed=11)
    core = Sent()
    player = match.join(random_inputs(aim=True), PRESETS[name], core)
    player.frame_s = 0.1
    match.run(8)
    player.disconnect()
    match.run(12)
    assert core.state == "playing"
    assert core.stats.divergences == 0
    assert all(event.cause == "late input" for event in player.events if isinstance(event, Corrected))
    rows = [m.rows for m in (decode_from_client(data, 9) for data in core.sent) if isinstance(m, Inputs)]
    assert max(map(len, rows)) > 9, "several ticks at once"
    assert match.game.counters.malformed == 0


def test_others_who_only_aim_cause_no_replays() -> None:
    """Turns the aims of all players in every tick. Each client has the aims of all, as they were at its snapshot."""
    match = Match(yard(aim=True, spawns=[(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 3.0, 0.0)]), seed=15)

    def turns(core: Core, rng: random.Random) -> Input:
        return make_input(aim=[rng.uniform(-1, 1) for _ in range(3)])

    players = [match.join(turns, Link(0.05, jitter_s=0.01)) for _ in range(3)]
    match.run(3)
    before = [player.core.stats.repredictions for player in players]
    aims: set[Any] = set()
    for _ in range(64):
        match.run(1 / 32)
        worlds = [player.core.prediction.confirmed for player in players if player.core.prediction]
        aims |= {world.state(players[0].core.entity)[12:15] for world in worlds}
    assert [player.core.stats.repredictions for player in players] == before
    assert len(aims) > 60
    assert sum(player.core.stats.divergences + player.core.stats.corrections for player in players) == 0


def test_nothing_changes_on_the_wire_for_a_scene_with_buttons_but_without_aim() -> None:
    """Plays once with names and once without; the inputs are the same, byte by byte."""
    sent = []
    for names in (("jump",), NAMES):
        match = Match(yard(buttons=names), seed=12)
        core = Sent()
        match.join(random_inputs(aim=False), Link(0.05), core)
        match.run(6)
        sent.append(core.sent)
    assert sent[0] == sent[1]
    assert all(len(m.rows) % 3 == 0 for m in map(decode_from_client, sent[0]) if isinstance(m, Inputs))


@pytest.mark.parametrize("name", POLICIES)
def test_bots_play_in_a_scene_with_buttons_and_aim(name: str) -> None:
    match = Match(yard(aim=True, buttons=("fire",)), seed=13)
    core = Core("Bot")
    drive = Bot(POLICIES[name](random.Random(1)))

    def plays(core: Core, _: random.Random) -> Input:
        drive(core)
        return core.input

    match.join(plays, Link(0.02), core)
    match.run(4)
    assert core.state == "playing"
    assert core.stats.corrections == 0


def test_a_bot_uses_the_buttons_of_the_scene_of_its_world() -> None:
    def policy(world: Any, me: int) -> Input:
        return make_input(1, 0, buttons=world.scene.buttons_bits(("fire",)), aim=(1, 0, 0))

    match = Match(yard(aim=True), seed=14)
    core = Core("Bot")
    drive = Bot(policy)

    def plays(core: Core, _: random.Random) -> Input:
        drive(core)
        return core.input

    match.join(plays, Link(0.02), core)
    match.run(3)
    assert core.input == Input(127, 0, 4, make_aim((1, 0, 0)))
    assert match.game.world.state(core.entity)[11] == 4
