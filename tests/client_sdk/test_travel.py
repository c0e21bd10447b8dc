"""The way of a core from world to world, with hand-made messages of a server: `Go` and `Waiting` in every state."""

import itertools
import math
import random
from typing import Any

import msgpack
import pytest

from client_sdk.core import Core
from client_sdk.events import Answered, Disconnected, Event, Joined, Left, Matched, Moved, SegmentLoaded, Waiting
from client_sdk.reconnect import ELSEWHERE_S, FIRST_S, Reconnect
from client_sdk.timing.server_clock import PINGS
from client_sdk.transports.common import ELSEWHERE_SILENCE_S, ELSEWHERE_TIMEOUT_S, SILENCE_S, silence_s, timeout_s
from client_sdk.travel import ATTEMPTS_MAX, PLAYED_S, REDIRECTS_MAX, WORLDS_MAX, Travel, without_seat
from client_sdk.view import NOTHING
from shared import messages
from shared.aim import NO_AIM
from shared.blocks import pack
from shared.inputs import NEUTRAL, make_input
from shared.messages import (
    Bye,
    Edges,
    Go,
    Hello,
    Pong,
    ProtocolError,
    Snapshot,
    Terrain,
    Welcome,
    decode_from_client,
    encode,
)
from shared.messages import Waiting as WaitingMessage
from shared.scene import Scene
from shared.snapshot import VERDICT, encode_part
from shared.world import World
from tests.worlds import scene

HERE = (0, 0, 0)
SCENE = scene([[0, 0, 0, 32, 32, 1, 1]], origin=HERE, size=(1, 1, 1), spawns=((16.0, 16.0, 1.0),))
OTHER = scene([[0, 0, 0, 32, 32, 2, 1]], origin=HERE, size=(1, 1, 1), spawns=((16.0, 16.0, 2.0),))
LOBBY = "/match?kind=arena"
GO = Go("/arena-1?seat=abc.def", "K7F3QD", ["/arena-1?seat=friend"], "matched")
KEY = bytes(range(16))


class Server:
    """The server of one core, which is also its transport: it sends what a test says, and time passes as it says."""

    def __init__(self, path: str = LOBBY, **options: Any) -> None:
        self.core = Core("Ann", compiled=False, **options)
        self.core.travel.path = path
        self.now = self.began = 100.0
        self.said: list[messages.Message] = []
        self.events: list[Event] = []
        self.dialled: list[str] = []
        self.dial()

    def dial(self) -> None:
        """Opens a connection to the path of the core."""
        self.core.reconnect.trying()
        self.dialled.append(self.core.travel.path)
        self.core.open(self.now)
        self.live(0)

    def send(self, *sent: messages.Message | bytes) -> None:
        """Sends messages of the server."""
        for message in sent:
            self.core.receive(message if isinstance(message, bytes) else encode(message), self.now)
        self.live(0)

    def live(self, seconds: float) -> None:
        """Lets time pass, and updates the core."""
        self.now += seconds
        self.core.update(self.now)
        said = [decode_from_client(message) for message in self.core.outgoing()]
        self.said += said
        for ping in said:
            if isinstance(ping, messages.Ping):
                self.core.receive(encode(Pong(ping.sent, 10 + (self.now - self.began) * SCENE.tick_rate)), self.now)
        self.events += [event for event in self.core.events() if not isinstance(event, SegmentLoaded)]

    def close(self, code: int = 1000, reason: str = "") -> None:
        """Ends the connection, or an attempt."""
        self.core.lost(code, reason, self.now)
        self.live(0)

    def follow(self) -> None:
        """Closes the connection as the core asks, and opens the next one when it is time."""
        assert self.core.close_request == (1000, "")
        self.close()
        assert self.core.close_request is None
        self.now = max(self.now, self.core.reconnect.retry_at)
        assert self.core.dials(self.now)
        self.dial()

    def welcome(self, entity: int = 1, scene: Scene = SCENE) -> None:
        """Welcomes the client and answers its pings, until it plays."""
        world = World(scene, compiled=False)
        world.load_terrain()
        world.spawn("box", (16, 16, scene.spawns[0][2]))
        while world.spawn("box", (5, 5, 9)) < entity:
            pass
        packed = pack(world.blocks.segment(HERE).reshape(-1))
        part = msgpack.unpackb(encode_part(HERE, -1, world.in_segment(HERE)))
        self.began = self.now
        self.send(
            Welcome(messages.VERSION, 10, entity, scene.to_table(), KEY),
            Terrain(*HERE, 0, len(packed), packed),
            Snapshot(10, -1, b"", 0, b"", b"", b"", (part,)),
        )
        for _ in range(PINGS):
            self.live(0.25)

    @property
    def hello(self) -> Hello:
        """The latest Hello."""
        return [message for message in self.said if isinstance(message, Hello)][-1]

    def taken(self) -> list[Event]:
        """Returns the events since the last call."""
        events, self.events = self.events, []
        return events


def test_a_match_waiting_then_the_world() -> None:
    server = Server()
    core = server.core
    assert (core.state, core.travel.world) == ("joining", "")
    server.send(messages.Waiting(msgpack.packb({"waiting": 3, "position": 2, "waited_s": 1.5, "rating": 1200})))
    server.send(messages.Waiting(msgpack.packb({})))
    server.send(GO)
    assert server.taken() == [
        Waiting(2, 3, 1.5, {"rating": 1200}),
        Waiting(0, 0, 0.0, {}),
        Matched("arena-1", "K7F3QD", ("/arena-1?seat=friend",)),
    ]
    assert (core.state, core.connected, core.close_request) == ("joining", False, (1000, ""))
    assert not core.dials(server.now), "the old connection comes first"
    assert core.next_update(server.now) == math.inf
    server.follow()
    assert server.dialled == [LOBBY, "/arena-1?seat=abc.def"]
    assert server.hello == Hello(messages.VERSION, {}, "Ann", "", b"")
    server.welcome()
    assert [type(event) for event in server.taken()] == [Joined]
    assert (core.travel.world, core.travel.code, core.travel.seats) == ("arena-1", "K7F3QD", ("/arena-1?seat=friend",))


def test_it_reconnects_to_the_world_without_the_seat() -> None:
    server = Server(patience_s=5.0)
    server.send(GO)
    server.follow()
    server.welcome()
    server.close(1006, "gone")
    assert server.core.state == "reconnecting"
    server.now = server.core.reconnect.retry_at
    server.dial()
    assert server.dialled[-1] == "/arena-1"
    assert server.hello.resume == KEY


def playing(**options: Any) -> Server:
    """Returns a server on which the core plays in the default world."""
    server = Server("/", **options)
    server.welcome()
    assert server.core.state == "playing"
    server.taken()
    return server


def test_the_rules_send_a_player_away() -> None:
    server = playing(patience_s=5.0)
    core = server.core
    core.set_input(make_input(1, 0, jump=True))
    server.send(messages.Shared({"score": 1}), messages.Private({"role": "spy"}))
    number, edit = core.command("buy"), core.edit(3, 3, 3, 1)
    before = core.prediction
    server.send(Go("/final", "", [], "you won"))
    assert server.taken() == [
        Answered(number, False, "the client went to another world"),
        Answered(edit, False, "the client went to another world"),
        Moved("final", "you won"),
    ]
    assert (core.state, core.prediction, core.entity, core.timeline) == ("joining", None, 0, None)
    assert (core.shared, core.private, core.scene, core.input) == ({}, {}, None, NEUTRAL)
    assert core.view(server.now) is NOTHING
    with pytest.raises(RuntimeError, match="has not joined"):
        core.command("buy")
    server.send(Go("/elsewhere", "", [], "ignored"), Bye(1001, "ignored", 1.0), b"ignored")
    server.follow()
    assert (server.dialled[-1], server.hello.resume, server.hello.scene) == ("/final", b"", {})
    server.welcome(entity=2, scene=OTHER)
    (joined,) = server.taken()
    assert isinstance(joined, Joined)
    assert (joined.entity, joined.scene.digests, core.entity) == (2, OTHER.digests, 2)
    assert core.prediction is not before
    assert core.command("buy") == edit + 1
    assert core.stats.reconnects == 0


def test_a_late_result_of_the_old_world_is_not_taken_for_one_of_the_new() -> None:
    server = playing()
    number = server.core.command("buy")
    server.send(Go("/final", "", [], ""))
    server.follow()
    server.taken()
    server.welcome()
    verdicts = VERDICT.pack(number, messages.DONE)
    server.send(Snapshot(11, -1, b"", 0, verdicts, b"", b"", ()))
    assert [event for event in server.taken() if isinstance(event, Answered)] == []


def test_go_while_reconnecting_and_twice_in_one_breath() -> None:
    server = playing(patience_s=5.0)
    number = server.core.command("buy")
    server.close(1006, "gone")
    server.now = server.core.reconnect.retry_at
    server.dial()
    server.taken()
    server.send(Go("/a", "", [], "the match is over"), Go("/b", "", [], "never seen"))
    assert server.taken() == [
        Answered(number, False, "the client went to another world"),
        Moved("a", "the match is over"),
    ]
    server.follow()
    server.send(Go("/b?seat=x", "", [], "full"))  # ahead of a welcome: a lobby's answer
    assert server.taken() == [Matched("b", "", ())]
    server.follow()
    server.welcome()
    assert [type(event) for event in server.taken()] == [Joined]
    assert server.dialled == ["/", "/", "/a", "/b?seat=x"]


def test_go_between_the_welcome_and_the_play_is_the_rules_word() -> None:
    server = Server("/arena-1")
    server.send(Welcome(messages.VERSION, 10, 1, SCENE.to_table(), KEY), Go("/b", "", [], "no room"))
    assert server.taken() == [Moved("b", "no room")]
    server.follow()
    server.welcome()
    assert server.core.state == "playing"


@pytest.mark.parametrize("end", ["bye", "close"])
def test_nothing_follows_after_the_end(end: str) -> None:
    server = playing()
    if end == "bye":
        server.send(Bye(messages.KICKED, "cheating", -1.0))
    else:
        server.core.close()
    server.live(0)
    (left,) = server.taken()
    assert isinstance(left, Left)
    server.send(GO)
    server.close()
    server.live(10.0)
    assert (server.taken(), server.core.state, server.core.dials(1e9)) == ([], "closed", False)


def test_a_program_may_close_between_two_worlds() -> None:
    server = Server()
    server.send(GO)
    server.core.close()
    server.live(0)
    assert [type(event) for event in server.taken()] == [Matched, Left]
    server.close()
    assert (server.taken(), server.core.dials(1e9)) == ([], False)


@pytest.mark.parametrize("how", ["bye", "refused"])
def test_a_refused_world_is_asked_for_again_at_the_lobby(how: str) -> None:
    server = Server()
    waits = []
    for _ in range(1 + ATTEMPTS_MAX):
        server.send(GO)
        assert [type(event) for event in server.taken()] == [Matched]
        server.follow()
        if how == "bye":
            server.send(Bye(messages.FULL, "this world is full", -1.0))
        failed_at = server.now
        if server.core.state == "closed" or how == "refused":
            server.close(1006, "this world is full")
        else:
            assert server.core.close_request == (1000, "")
            server.close()
        if server.core.state == "closed":
            break
        assert (server.core.travel.world, server.core.travel.code, server.core.travel.seats) == ("", "", ())
        waits.append(server.core.reconnect.retry_at - failed_at)
        server.now = server.core.reconnect.retry_at
        server.dial()
    assert waits == pytest.approx([0.25, 0.5, 1.0])
    assert server.dialled == [LOBBY, GO.path] * (1 + ATTEMPTS_MAX)
    (left,) = server.taken()
    assert isinstance(left, Left)
    assert left.reason == "this world is full"


def test_what_no_other_world_would_mend_ends_at_once() -> None:
    server = Server(scene=SCENE)
    server.send(GO)
    server.follow()
    assert server.hello.scene == SCENE.digests
    server.taken()
    server.send(Bye(messages.WRONG_SCENE, "the scenes differ in gravity", -1.0))
    (left,) = server.taken()
    assert isinstance(left, Left)
    assert (left.code, "gravity" in left.reason) == (messages.WRONG_SCENE, True)


def test_a_wait_that_a_world_asks_for_is_kept_up_to_a_limit() -> None:
    server = Server()
    server.send(GO)
    server.follow()
    server.send(Bye(messages.GOING_AWAY, "restarting", 5.0))
    server.close()
    assert server.core.reconnect.retry_at - server.now == pytest.approx(5.0)
    server.now += 5.0
    server.dial()
    server.send(GO)
    server.follow()
    server.taken()
    server.send(Bye(messages.GOING_AWAY, "restarting", 3600.0))
    assert server.taken() == [Left(messages.GOING_AWAY, "restarting", 3600.0)]


def test_a_lost_way_from_world_to_world_is_tried_again_and_a_refusal_is_not() -> None:
    server = playing()
    server.send(Go("/final?seat=x", "", [], ""))
    server.follow()
    for _ in range(ATTEMPTS_MAX):
        server.close(1006, "no connection")
        server.now = server.core.reconnect.retry_at
        server.dial()
    assert server.dialled == ["/", *["/final?seat=x"] * ATTEMPTS_MAX, "/final"], "the last time without the seat"
    server.taken()
    server.close(1006, "no connection")
    assert server.taken() == [Left(1006, "no connection")]
    server = playing()
    server.send(Go("/final?seat=x", "", [], ""))
    server.follow()
    server.taken()
    server.send(Bye(messages.FULL, "this world is full", -1.0))
    assert server.taken() == [Left(messages.FULL, "this world is full", -1.0)]


def test_a_connection_that_breaks_after_the_welcome_is_made_anew() -> None:
    welcome = Welcome(messages.VERSION, 10, 1, SCENE.to_table(), KEY)
    server = Server(patience_s=5.0)
    server.send(GO)
    server.follow()
    server.send(welcome)
    server.taken()
    server.close(1006, "gone")
    (event,) = server.taken()
    assert isinstance(event, Disconnected)
    server.now = server.core.reconnect.retry_at
    server.dial()
    assert (server.dialled[-1], server.hello.resume) == ("/arena-1", KEY)
    server.welcome()
    assert [type(event) for event in server.taken()] == [Joined]
    server = Server("/", patience_s=5.0)  # without a `Go`, a first join that breaks is the end, as ever
    server.send(welcome)
    server.close(1006, "gone")
    assert server.taken() == [Left(1006, "gone")]


def test_a_lobby_that_refuses_or_breaks_off_is_the_end() -> None:
    server = Server()
    server.send(Bye(messages.NOT_ADMITTED, "there is no such kind", -1.0))
    assert server.taken() == [Left(messages.NOT_ADMITTED, "there is no such kind", -1.0)]
    server = Server()
    server.close(1006, "the connection broke off")
    assert server.taken() == [Left(1006, "the connection broke off")]


def test_a_server_that_sends_a_client_in_circles_is_left() -> None:
    server = Server("/a")
    for world in range(WORLDS_MAX):
        server.send(Go(f"/{world % 2}", "", [], "round"))
        server.follow()
    server.taken()
    server.send(Go("/a", "", [], "round"))
    (left,) = server.taken()
    assert isinstance(left, Left)
    assert left.code == messages.MALFORMED
    assert "Go.path = '/a': world 9 in a row with less than 1 s of play" in left.reason


def test_play_in_between_counts_the_worlds_anew() -> None:
    server = playing()
    for _ in range(2 * WORLDS_MAX):
        server.live(PLAYED_S)
        server.send(Go("/next", "", [], ""))
        server.follow()
        server.welcome()
    assert server.core.state == "playing"
    for _ in range(WORLDS_MAX - 1):  # the latest world above counts, and joining takes longer than `PLAYED_S`
        server.send(Go("/next", "", [], ""))
        server.follow()
        server.welcome()
    server.send(Go("/next", "", [], ""))
    assert server.core.state == "closed"


def hostile(server: Server, chance: random.Random) -> None:
    """Does one thing that a server, a network or a program may do."""
    core = server.core
    paths = ("/", "/a", "/b?seat=x", "//else/x", "/match?kind=arena", "/" + "s" * 1023)
    if core.dials(server.now) and chance.random() < 0.7:
        server.dial()
    elif core.connected and core.prediction is None and chance.random() < 0.4:
        server.welcome()
    elif chance.random() < 0.03:
        server.send(chance.choice((b"\xc0", encode(Bye(4010, "no", -1.0)), encode(messages.Waiting(b"")))))
    else:
        act = chance.randrange(5)
        if act == 0:
            server.send(Go(chance.choice(paths), "CODE", ["/a?seat=y"], "go"))
        elif act == 1:
            server.send(Bye(chance.choice((1001, 4004, 4005)), "bye", chance.choice((-1.0, 0.0, 2.0))))
        elif act == 2 and core.prediction is None:
            server.send(messages.Waiting(msgpack.packb({"waiting": 1})))
        elif act == 3:
            server.close(chance.choice((1000, 1006)), "lost")
        else:
            server.live(chance.uniform(0, 2))


@pytest.mark.parametrize("seed", range(40))
def test_whatever_a_server_does_the_client_stays_in_order(seed: int) -> None:
    chance = random.Random(seed)
    server = Server(chance.choice(("/", LOBBY, "/a")), patience_s=5.0)
    core = server.core
    for _ in range(300):
        hostile(server, chance)
        assert core.state in ("joining", "playing", "reconnecting", "closed")
        assert not (core.travel.leaving and core.connected)
        assert core.state != "joining" or core.timeline is None
        assert core.travel.path.startswith("/")
        if core.state == "closed":
            break
    kinds = [type(event) for event in server.events if isinstance(event, Matched | Moved | Joined | Left)]
    assert kinds.count(Left) == (core.state == "closed")
    assert Left not in kinds[:-1], "nothing comes after the end"
    runs = [len(list(run)) for sent, run in itertools.groupby(kinds, lambda kind: kind in (Matched, Moved)) if sent]
    assert max(runs, default=0) <= WORLDS_MAX


@pytest.mark.parametrize(
    "table",
    [
        [],
        {1: 2},
        {"waiting": -1},
        {"waiting": True},
        {"waiting": 1.5},
        {"position": "first"},
        {"position": 1 << 32},
        {"waited_s": -0.1},
        {"waited_s": math.inf},
        {"waited_s": math.nan},
        {"waited_s": True},
        {"waited_s": None},
    ],
)
def test_malformed_progress_is_refused(table: object) -> None:
    server = Server()
    server.send(messages.Waiting(msgpack.packb(table)))
    (left,) = server.taken()
    assert isinstance(left, Left)
    assert left.code == messages.MALFORMED


def test_progress_belongs_to_a_lobby_only() -> None:
    welcomed = Server()
    welcomed.send(Welcome(messages.VERSION, 10, 1, SCENE.to_table(), KEY))
    for server in (playing(), welcomed):
        server.send(messages.Waiting(msgpack.packb({})))
        (left,) = server.taken()
        assert isinstance(left, Left)
        assert "unexpected Waiting message" in left.reason


def test_controls_set_in_the_lobby_count_in_the_world() -> None:
    server = Server()
    server.core.set_input(make_input(1, 0), ("jump",))
    server.send(GO)
    assert server.core.input == make_input(1, 0)
    assert server.core.input.aim == NO_AIM


def test_a_scene_that_the_program_gave_stays() -> None:
    server = Server("/", scene=SCENE)
    server.welcome()
    server.send(Go("/next", "", [], ""))
    assert server.core.scene is SCENE
    server.follow()
    assert server.hello.scene == SCENE.digests


@pytest.mark.parametrize(
    ("path", "kept", "world"),
    [
        ("/", "/", ""),
        ("", "", ""),
        ("/arena-1", "/arena-1", "arena-1"),
        ("/arena-1?seat=a.b", "/arena-1", "arena-1"),
        ("/arena-1?a=1&seat=a.b&b=2", "/arena-1?a=1&b=2", "arena-1"),
        ("/arena-1?seats=2", "/arena-1?seats=2", "arena-1"),
        ("/match?kind=arena&seats=2", "/match?kind=arena&seats=2", ""),
        ("/create", "/create", ""),
        ("/join?code=K7F3QD", "/join?code=K7F3QD", ""),
        ("//else.example/x", "//else.example/x", "else.example/x"),
    ],
)
def test_paths(path: str, kept: str, world: str) -> None:
    travel = Travel()
    travel.path = path
    assert (without_seat(path), travel.world) == (kept, world)


def test_go_may_lead_to_another_server() -> None:
    travel = Travel()
    travel.path = LOBBY
    assert travel.go(Go("ws://10.0.0.2:8766/arena-1?seat=x", "", [], ""), 0.0, lobby=True) == Matched("arena-1", "", ())
    assert (travel.server, travel.path) == ("ws://10.0.0.2:8766", "/arena-1?seat=x")
    assert travel.again(Bye(messages.FULL, "full", -1.0))
    assert (travel.server, travel.path) == ("", LOBBY), "the lobby is at the server that the program has named"
    travel.go(Go("wss://b/arena-2", "", [], ""), 1.0, lobby=True)
    travel.welcomed()
    travel.go(Go("/final", "", [], ""), 2.0, lobby=False)
    assert (travel.server, travel.path) == ("wss://b", "/final"), "a path is one of the present server"


def test_a_client_tries_the_other_servers_of_its_world_in_turn_and_then_the_first_address() -> None:
    travel = Travel()
    assert not travel.elsewhere(1)
    travel.edges = ["ws://a", "ws://b", "ws://c"]
    tried = []
    for _ in range(8):
        assert travel.elsewhere(4)
        tried.append(travel.server)
    assert tried == ["ws://b", "ws://c", "ws://a", ""] * 2
    travel.plays(0.0)
    travel.elsewhere(4)
    assert travel.server == "ws://b"


def test_other_servers_of_the_world_are_tried_at_once_and_each_of_them_once() -> None:
    travel, reconnect = Travel(), Reconnect(30.0, 3)
    travel.edges = ["ws://one:1", "ws://two:2"]
    travel.plays(0.0)
    assert (silence_s(travel), timeout_s(travel, 5.0)) == (ELSEWHERE_SILENCE_S, 5.0)
    tried, now = [], 100.0
    for _ in range(6):
        travel.elsewhere(3)
        assert reconnect.lost(now, elsewhere=travel.fresh)
        tried.append((travel.server, reconnect.retry_at - now <= ELSEWHERE_S, timeout_s(travel, 5.0)))
        now = reconnect.retry_at
    fast = [("ws://two:2", True, ELSEWHERE_TIMEOUT_S), ("ws://one:1", True, ELSEWHERE_TIMEOUT_S)]
    slow = [("", False, 5.0), ("ws://two:2", False, 5.0), ("ws://one:1", False, 5.0), ("", False, 5.0)]
    assert tried == fast + slow
    travel.plays(now)
    reconnect.back()
    travel.elsewhere(3)
    assert travel.fresh


def test_without_other_servers_a_client_is_as_patient_as_ever() -> None:
    travel, reconnect = Travel(), Reconnect(30.0)
    assert not travel.elsewhere(1)
    assert reconnect.lost(0.0, elsewhere=travel.fresh)
    assert reconnect.retry_at >= FIRST_S
    assert (silence_s(travel), timeout_s(travel, 5.0)) == (SILENCE_S, 5.0)


FLEET = ["ws://10.0.0.1:8765", "ws://10.0.0.2:8765"]


def test_a_lobby_sends_to_another_lobby_and_to_the_same_world_without_an_event() -> None:
    server = Server()
    server.send(Edges(FLEET), Go("ws://10.0.0.2:8765/match?kind=arena&here=1", "", [], "matched elsewhere"))
    assert server.taken() == []
    server.follow()
    server.send(Edges(FLEET), GO._replace(path="ws://10.0.0.1:8765/arena-1?seat=abc"))
    assert server.taken() == [Matched("arena-1", "K7F3QD", ("/arena-1?seat=friend",))]
    server.follow()
    server.send(Edges(FLEET), Go("ws://10.0.0.2:8765/arena-1?seat=abc", "", [], "found"))
    assert server.taken() == [], "it is on its way there already"
    server.follow()
    server.welcome()
    assert [type(event) for event in server.taken()] == [Joined]
    travel = server.core.travel
    assert (travel.code, travel.seats, travel.edges) == ("K7F3QD", ("/arena-1?seat=friend",), FLEET)
    assert silence_s(travel) == SILENCE_S, "they do not have the world, so a change to them is no small thing"


def test_a_client_that_reconnects_goes_on_at_the_present_server_of_its_world_with_its_token() -> None:
    server = Server("/arena-1", patience_s=20.0)
    server.welcome()
    server.taken()
    server.said.clear()
    server.close(1006, "gone")
    server.now = server.core.reconnect.retry_at
    server.dial()
    server.send(encode(WaitingMessage(msgpack.packb({}))), Go("ws://10.0.0.2:8765/arena-1", "", [], "found"))
    assert [type(event) for event in server.taken()] == [Disconnected]
    server.follow()
    assert server.core.travel.server == "ws://10.0.0.2:8765"
    assert [hello.resume for hello in server.said if isinstance(hello, Hello)] == [KEY, KEY]
    server.send(Go("ws://10.0.0.3:8765/else", "", [], "you won"))
    assert server.taken() == [Moved("else", "you won")], "another world is another world"


def test_redirects_wait_and_end() -> None:
    travel = Travel()
    travel.path = "/arena-1"
    waits, go = [], Go("ws://10.0.0.2:8765/arena-1?seat=x", "", [], "found")
    for _ in range(REDIRECTS_MAX):
        travel.redirect(go)
        waits.append(travel.left())
    with pytest.raises(ProtocolError, match="redirected 65 times"):
        travel.redirect(go)
    assert (waits[:3], waits[-1], travel.path) == ([0.0, 0.0, 0.75], 2.0, "/arena-1")


def test_a_client_that_was_sent_to_another_server_tries_that_and_the_first_in_turn() -> None:
    travel = Travel()
    travel.path = "/arena-1"
    travel.redirect(Go("ws://10.0.0.2:8765/arena-1", "", [], "found"))
    tried = []
    for _ in range(4):
        assert travel.elsewhere(0)
        tried.append(travel.server)
    assert tried == ["ws://10.0.0.2:8765", ""] * 2
