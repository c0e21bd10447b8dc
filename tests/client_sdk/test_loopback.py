"""A game within the program, by a simulated clock."""

import pytest

from client_sdk.client import Client
from client_sdk.events import Answered, Disconnected, Event, Happened, Joined, Left, Resumed
from client_sdk.loopback import LEAP_S, Loopback
from client_sdk.netsim.links import PRESETS
from server.auth.identity import AuthError
from server.config.limits import Limits
from server.game import Game
from shared import messages
from shared.scene import load_scene
from sovereign_netcode.examples.freeze import Freeze
from sovereign_netcode.examples.tag import Tag
from tests.lengths import long

FRAMES_PER_S = 64


class Program:
    """A game's loop for some clients, with simulated time."""

    def __init__(self, game: Game) -> None:
        self.game = game
        self.loopback = Loopback(game)
        self.clients: list[Client] = []
        self.events: dict[Client, list[Event]] = {}
        self.now = 1000.0

    def join(self, *args: str, **more: str) -> Client:
        client = self.loopback.join(*args, **more)
        self.clients.append(client)
        self.events[client] = []
        return client

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * FRAMES_PER_S)):
            self.now += 1 / FRAMES_PER_S
            for client in self.clients:
                self.events[client] += client.poll(self.now)
                client.update(self.now)
                client.view(self.now)

    def events_of(self, client: Client, *kinds: type) -> list[Event]:
        return [event for event in self.events[client] if isinstance(event, kinds)]


def tag() -> Game:
    rules = Tag()
    return Game(rules.prepare(load_scene(rules.scene)), rules=rules)


def test_one_plays_alone_without_a_single_correction() -> None:
    program = Program(Game(load_scene("flat")))
    client = program.join("Ann")
    assert client.joining
    program.run(1)
    assert client.playing
    assert len(program.events_of(client, Joined)) == 1
    before = client.view(program.now).me
    client.set_input(1, 0)
    program.run(2)
    after = client.view(program.now).me
    assert before is not None
    assert after is not None
    assert 5 < after.position[0] - before.position[0] < 11
    assert program.game.world.tick == 3 * program.game.scene.tick_rate, "one input per tick that has passed"
    assert client.stats.corrections == client.stats.inputs_late == 0


def test_one_seed_is_one_story() -> None:
    def story() -> tuple[str, list[str]]:
        program = Program(tag())
        ann, bob = program.join("Ann"), program.join("Bob", link="wifi")
        ann.set_input(1, 0)
        bob.set_input(0, 1)
        program.run(12)
        names = [event.name for event in program.events[ann] if isinstance(event, Happened)]
        return str(program.game.world.state_hash()), names

    assert story() == story()


@pytest.mark.parametrize("link", ["thin", *long("far")])
def test_a_simulated_link_shows_in_the_clients_figures(link: str) -> None:
    program = Program(tag())
    client = program.join("Ann", link=link)
    client.set_input(1, 0)
    program.run(30)
    assert client.playing
    assert client.core.clock.rtt_s >= 2 * PRESETS[link].delay_s
    assert client.stats.divergences == 0
    if link == "thin":
        assert client.stats.bytes_down < 30 * 30e3 / 8
        assert client.stats.snapshots_skipped > 0


def test_two_see_each_other_and_what_they_build() -> None:
    program = Program(Game(load_scene("flat")))
    ann, bob = program.join("Ann"), program.join("Bob")
    program.run(1)
    assert [figure.entity for figure in ann.view(program.now).others] == [bob.entity]
    me = ann.view(program.now).me
    assert me is not None
    x, y, z = (int(part // 1) for part in me.position)
    ann.edit(x + 2, y, z + 2, 5)
    program.run(1)
    assert program.events_of(ann, Answered) == [Answered(1, True, "done")]
    prediction = bob.core.prediction
    assert prediction is not None
    assert prediction.confirmed.blocks.get(x + 2, y, z + 2) == 5


def test_figures_name_their_templates() -> None:
    rules = Freeze()
    program = Program(Game(rules.prepare(load_scene(rules.scene)), rules=rules))
    ann, bob = program.join("Ann"), program.join("Bob")
    program.run(1)
    for client in (ann, bob):
        found = {figure.entity: figure.template for figure in client.view(program.now).figures}
        assert found == {ann.entity: "freezer", bob.entity: "player"}


def test_a_suspended_client_reconnects_to_the_same_world() -> None:
    program = Program(tag())
    client = program.join("Ann")
    program.run(2)
    entity, tick = client.entity, program.game.world.tick
    program.now += 3600
    program.run(2)
    assert client.playing
    assert client.entity == entity
    assert program.game.world.tick == tick + 2 * program.game.scene.tick_rate
    assert [type(event) for event in program.events_of(client, Disconnected, Resumed, Left)] == [Disconnected, Resumed]
    program.now += LEAP_S / 2
    program.run(5)
    assert client.playing
    assert len(program.events_of(client, Disconnected)) == 1, "the wait was made up for"
    assert client.stats.divergences == 0


def test_a_bye_reaches_the_game() -> None:
    program = Program(Game(load_scene("flat")))
    with program.join("Ann") as client:
        program.run(1)
    assert client.closed
    program.clients.append(program.join("Bob"))
    program.run(1)
    assert len(program.game.players) == 1
    assert program.game.sessions == [program.game.players[program.clients[-1].entity].session]


@pytest.mark.parametrize(
    ("game", "says"),
    [
        (Game(load_scene("flat"), limits=Limits(clients_max=0)), "the server is full"),
        (Game(load_scene("flat"), authenticate=lambda token: _nobody()), "nobody comes in"),
    ],
)
def test_a_refused_client_gets_the_reason(game: Game, says: str) -> None:
    program = Program(game)
    client = program.join("Ann")
    program.run(1)
    (left,) = program.events_of(client, Left)
    assert isinstance(left, Left)
    assert says in left.reason
    assert client.closed


def test_a_game_that_begins_anew_is_waited_for() -> None:
    program = Program(Game(load_scene("flat")))
    client = program.join("Ann")
    program.run(1)
    entity = client.entity
    program.game.shut_down("new rules", 2.0)
    program.run(1)
    assert client.reconnecting
    program.run(4)
    assert client.playing
    assert client.entity == entity
    lost, back = program.events_of(client, Disconnected, Resumed, Joined, Left)[1:]
    assert isinstance(lost, Disconnected)
    assert lost.reason == "new rules"
    assert lost.wait_s >= 2
    assert isinstance(back, Resumed)


def test_a_refused_client_gets_the_reason_over_a_link_too() -> None:
    game = Game(load_scene("flat"), limits=Limits(clients_max=1))
    program = Program(game)
    program.join("Ann")
    second = program.join("Bob", link="typical")
    program.run(3)
    (left,) = program.events_of(second, Left)
    assert isinstance(left, Left)
    assert left.code == messages.FULL


def _nobody() -> str:
    raise AuthError("nobody comes in")
