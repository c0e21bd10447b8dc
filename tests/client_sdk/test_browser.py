"""The client for a page, with sockets like the browser's, against the real server core in simulated time."""

import json
from typing import Any

import pytest

from client_sdk.browser import BrowserClient
from client_sdk.flat_view import AT, COLUMNS, HEAD, STATES
from client_sdk.transports.browser import Listener, checked_address
from client_sdk.transports.common import ConnectError
from server.game import Game
from server.rules import Rules
from server.worlds.host import Way
from server.worlds.kinds import kind_of
from shared.checks import SceneError
from shared.scene import load_scene
from sovereign_netcode.playtest import LocalWorlds
from tests.behaving import CLASSES, Playground

URL = "ws://game.example:8765"
FRAME_S = 1 / 60


class Talking(Rules):
    """Rules that share values, name players and answer a command."""

    def on_start(self) -> None:
        self.game.share("round", 3)

    def on_join(self, player: Any) -> None:
        self.game.set(player.entity, "title", "Sir")
        self.game.send("hello", {"bytes": b"\x01\x02"}, player)

    def on_command(self, player: Any, name: str, data: Any) -> None:
        self.game.send("echo", [name, data], player)


class FakeSocket:
    """A WebSocket of a page. Its events come when `Page.run` advances the time."""

    def __init__(self, page: "Page", url: str, listener: Listener) -> None:
        self._page, self.url, self.listener = page, url, listener
        self.waiting: list[Any] = []
        self.sent: list[bytes] = []
        self.over: tuple[int, str] | None = None
        self.closed_with: tuple[int, str] | None = None
        self.stuck = False
        self._way: Way | None = None
        self._session: Any = None

    @property
    def bufferedAmount(self) -> int:  # noqa: N802
        return sum(map(len, self.sent))

    def send(self, data: bytes) -> None:
        assert self.closed_with is None
        self.sent.append(data)

    def close(self, code: int, reason: str) -> None:
        assert code == 1000 or 3000 <= code < 5000
        assert len(reason.encode()) <= 123
        self.closed_with = self.closed_with or (code, reason)

    def advance(self) -> None:
        """Delivers in both directions what waits."""
        page = self._page
        if self._session is None and self.over is None and self.closed_with is None:
            way = page.worlds.route(self.url.removeprefix(URL), page.now) if page.reachable else "nobody"
            if isinstance(way, str):
                self.over = 1006, ""
            elif page.answering:
                self._way = way
                self._session = way.open(_Wire(self), page.now)
                self.listener.opened()
        if self._session is not None and not self.stuck:
            sent, self.sent = self.sent, []
            assert self._way is not None
            for message in sent:
                self._way.receive(self._session, message, page.now)
        if page.delivering:
            waiting, self.waiting = self.waiting, []
            for message in waiting:
                self.listener.received(message)
        if (self.over or self.closed_with) and self in page.sockets:
            page.sockets.remove(self)
            if self._session is not None:
                assert self._way is not None
                self._way.lost(self._session, page.now)
            self.listener.closed(*(self.over or (1006, "")))


class _Wire:
    """The connection to a page, as the game sees it."""

    def __init__(self, socket: FakeSocket) -> None:
        self._socket = socket

    def send(self, message: bytes) -> None:
        self._socket.waiting.append(message)

    def outstanding(self) -> int:
        return sum(map(len, self._socket.waiting))

    def close(self, code: int, reason: str) -> None:
        self._socket.over = code, reason


class Page:
    """A page with one client, and a server."""

    def __init__(self, worlds: LocalWorlds, url: str = URL, **options: Any) -> None:
        self.worlds, self.now = worlds, 100.0
        self.sockets: list[FakeSocket] = []
        self.reachable = self.answering = self.delivering = True
        self.events: list[dict[str, Any]] = []
        self.options = options
        self.client = self._client(url)

    def _client(self, url: str) -> BrowserClient:
        client = BrowserClient.connect(url, open_socket=self._open, **self.options)
        client._transport._clock = lambda: self.now
        for socket in self.sockets:
            line: Any = socket.listener
            line._clock, line.until = client._transport._clock, self.now + 5.0
        return client

    def _open(self, url: str, listener: Listener) -> FakeSocket:
        self.sockets.append(FakeSocket(self, url, listener))
        return self.sockets[-1]

    def run(self, seconds: float, *, hidden: bool = False, step_s: float = FRAME_S) -> None:
        """Advances the time, with a picture 60 times per second; a hidden page only pumps."""
        for _ in range(round(seconds / step_s)):
            self.now += step_s
            self.worlds.advance(self.now)
            for socket in list(self.sockets):
                socket.advance()
            if hidden:
                self.client.pump(self.now)
            else:
                self.client.frame(self.now)
            self.events += json.loads(self.client.events())

    def head(self, name: str) -> float:
        return self.client.values[AT[name]]

    @property
    def state(self) -> str:
        return STATES[int(self.head("state"))]

    def rows(self) -> list[dict[str, float]]:
        """Returns the rows of the latest frame."""
        width, at = int(self.head("columns")), len(HEAD)
        values = self.client.values.tolist()
        count = int(self.head("rows"))
        rows = [values[at + width * row : at + width * (row + 1)] for row in range(count)]
        return [dict(zip(COLUMNS, row, strict=False)) for row in rows]

    def types(self) -> list[str]:
        return [event["type"] for event in self.events if event["type"] not in ("SegmentLoaded", "Corrected")]


def page(rules: Rules | None = None, scene: str = "flat", **options: Any) -> Page:
    """Returns a page whose server plays one game."""
    made = load_scene(scene)
    game = Game(made if rules is None else rules.prepare(made), rules=rules, seed=4)
    return Page(LocalWorlds(default=game), **options)


def test_a_player_joins_walks_and_is_drawn_as_numbers() -> None:
    one = page(Talking(), name="Ann")
    one.run(2)
    assert one.state == "playing"
    assert one.types() == ["Joined", "Happened"]
    assert json.loads(one.client.describe())["scene"]["name"] == "flat"
    one.client.press(1.0, 0.0)
    before = one.rows()[0]
    one.run(1)
    row = one.rows()[0]
    assert one.head("me") == 1
    assert row["x"] - before["x"] == pytest.approx(3.0, abs=0.3)
    assert (row["vx"], row["facing_east"], row["facing_north"]) == (3.0, 1.0, 0.0)
    view = one.client.core.view(one.now)
    assert view.me is not None
    assert [row["x"], row["y"], row["z"]] == pytest.approx(view.me.position)
    assert one.head("corrections") == one.head("divergences") == 0
    assert one.client.frame(one.now) == len(HEAD) + len(COLUMNS)


def test_events_attributes_values_and_commands_are_json() -> None:
    one = page(Talking(), name="Ann")
    one.run(2)
    (hello,) = (event for event in one.events if event["type"] == "Happened")
    assert (hello["name"], hello["data"]) == ("hello", {"bytes": {"$bytes": "AQI="}})
    joined = one.events[[event["type"] for event in one.events].index("Joined")]
    assert joined.keys() == {"type", "entity", "tick"}
    assert json.loads(one.client.attributes()) == {str(one.client.entity): {"name": "Ann", "title": "Sir"}}
    assert json.loads(one.client.attributes()) == {}
    game = json.loads(one.client.game())
    assert (game["shared"], game["entity"]) == ({"round": 3}, one.client.entity)
    number = one.client.request("say", json.dumps({"a": [1, {"$bytes": "AQI="}]}))
    one.run(0.5)
    (answered,) = (event for event in one.events if event["type"] == "Answered")
    assert (answered["number"], answered["done"]) == (number, True)
    (echo,) = (event for event in one.events if event.get("name") == "echo")
    assert echo["data"] == ["say", {"a": [1, {"$bytes": "AQI="}]}]
    assert json.loads(one.client.verdict())["verdict"] == "matched"


def test_numbers_that_json_does_not_know_are_null() -> None:
    class Wild(Rules):
        def on_join(self, player: Any) -> None:
            self.game.send("wild", [float("nan"), float("inf"), 1.5], player)

    one = page(Wild())
    one.run(2)
    (event,) = (event for event in one.events if event["type"] == "Happened")
    assert event["data"] == [None, None, 1.5]


def test_blocks_are_bytes_and_edits_show_at_once() -> None:
    one = page(scene="arena")
    one.run(2)
    changed = json.loads(one.client.blocks())
    assert len(changed) > 1
    assert json.loads(one.client.blocks()) == []
    row = one.rows()[0]
    x, y, z = int(row["x"]) + 2, int(row["y"]), int(row["z"])
    one.client.edit(x, y, z, 3)
    one.run(0.1)
    segment = [part // 32 for part in (x, y, z)]
    assert json.loads(one.client.blocks()) == [segment]
    kinds = one.client.kinds(*segment)
    assert (len(kinds), kinds[(z & 31) << 10 | (y & 31) << 5 | (x & 31)]) == (32768, 3)
    assert one.client.kinds(99, 0, 0) == bytes(32768)


def test_fields_of_behaviours_are_columns() -> None:
    one = page(Playground(), behaviours=CLASSES)
    one.run(2)
    told = json.loads(one.client.describe())
    names = told["fields"][int(one.rows()[0]["template"])]
    assert names[0] == "stamina"
    width, start = int(one.head("columns")), len(HEAD)
    assert width == len(COLUMNS) + max(map(len, told["fields"]))
    own = one.client.values.tolist()[start : start + width]
    world = one.client.core.prediction
    assert world is not None
    fields = world.predicted.fields(one.client.entity)
    assert dict(zip(names, own[len(COLUMNS) :], strict=False)) == fields
    crates = [row for row in one.rows() if row["template"] in (4, 5)]
    assert len(crates) == len(Playground.crates)


def test_a_lost_connection_is_made_again() -> None:
    one = page(Talking())
    one.run(2)
    entity = one.client.entity
    one.sockets[0].over = 1006, ""
    one.run(0.1)
    assert one.state == "reconnecting"
    one.run(3)
    assert one.state == "playing"
    assert one.client.entity == entity
    assert one.types()[:4] == ["Joined", "Happened", "Disconnected", "Resumed"]
    assert one.head("reconnects") == 1


def test_a_silent_server_counts_as_lost() -> None:
    one = page()
    one.run(2)
    one.delivering = False
    one.run(11)
    assert "Disconnected" in one.types()
    one.delivering = True
    one.run(4)
    assert one.types()[-1] == "Resumed"


def test_a_hidden_page_stays_in_the_game_and_goes_on_at_once() -> None:
    one = page()
    one.run(2)
    one.client.press(0.0, 1.0)
    one.run(30, hidden=True, step_s=0.05)
    one.run(1)
    assert one.types() == ["Joined"]
    assert one.head("reconnects") == one.head("divergences") == 0
    assert one.head("me") == 1


def test_a_hidden_page_that_is_slowed_down_to_one_call_per_second_comes_back() -> None:
    one = page()
    one.run(2)
    one.run(60, hidden=True, step_s=1.0)
    one.run(3)
    assert one.state == "playing"
    assert one.head("divergences") == one.head("reconnects") == 0


def test_a_page_that_slept_comes_back() -> None:
    one = page()
    one.run(2)
    one.now += 60.0  # no call, and no time for the socket's events
    one.worlds.advance(one.now)
    one.run(5)
    assert one.state == "playing"
    assert one.types()[0] == "Joined"
    assert one.types()[-1] in ("Resumed", "Resynchronised", "Joined")
    assert one.head("divergences") == 0


def test_a_server_that_is_not_there_is_the_end_with_a_reason() -> None:
    one = page()
    one.reachable = False
    one.run(0.5)
    assert one.state == "closed"
    (left,) = one.events
    assert left["type"] == "Left"
    assert left["reason"].startswith(f"{URL}/: no connection; is the address right")


def test_a_handshake_that_is_not_answered_ends_in_time() -> None:
    one = page()
    one.answering = False
    one.run(4.8)
    assert one.state == "joining"
    one.run(0.5)
    assert one.events[-1]["reason"] == f"{URL}/: no answer in time"
    assert one.sockets == []


def test_an_address_that_the_browser_does_not_allow() -> None:
    def refuses(url: str, listener: Listener) -> FakeSocket:
        raise OSError("SecurityError: insecure")

    client = BrowserClient.connect(URL, open_socket=refuses)
    client.frame(1.0)
    (left,) = json.loads(client.events())
    assert left["reason"] == f"{URL}/: SecurityError: insecure"


@pytest.mark.parametrize("url", ["http://a:1", "ws://", "ws://a:0", "ws://a:99999", "", None, 7, "a:8765"])
def test_what_is_no_address(url: Any) -> None:
    with pytest.raises(ConnectError, match=r"^url = .*: must be an address; a server's address looks like"):
        checked_address(url)


def test_a_server_that_sends_text_or_nonsense_is_left() -> None:
    one = page()
    one.run(0.2)
    one.sockets[0].waiting.append("hello")
    one.run(0.1)
    assert one.state == "closed"
    assert "it sends text" in one.events[-1]["reason"]
    two = page()
    two.run(0.2)
    socket = two.sockets[0]
    socket.waiting.append(b"\xff\xff")
    two.run(0.1)
    assert two.state == "closed"
    assert "malformed" in two.events[-1]["reason"]
    assert socket.closed_with is not None
    assert two.sockets == []


def test_a_server_that_stops_reading_counts_as_lost() -> None:
    one = page()
    one.run(2)
    one.sockets[0].stuck = True
    one.sockets[0].sent.append(bytes(70_000))
    one.run(0.1)
    assert one.types()[-1] == "Disconnected"
    one.run(3)
    assert "Resumed" in one.types()


def test_leaving_closes_the_socket() -> None:
    one = page()
    one.run(2)
    socket = one.sockets[0]
    one.client.close()
    assert socket.closed_with == (1000, "")
    one.run(0.1)
    assert one.types()[-1] == "Left"
    assert one.sockets == []
    one.client.close()


def test_a_page_finds_a_world_and_goes_from_world_to_world() -> None:
    worlds = LocalWorlds(kind_of("arena", Rules, load_scene("flat")))
    one = Page(worlds, f"{URL}/match?kind=arena")
    one.run(4)
    assert one.types() == ["Matched", "Joined"]
    assert one.client.world
    assert one.state == "playing"


def test_the_addresses_of_worlds() -> None:
    asked: list[str] = []

    def open_socket(url: str, listener: Listener) -> FakeSocket:
        asked.append(url.removeprefix(URL))
        return FakeSocket(one, url, listener)

    one = page()
    BrowserClient.match(URL, "arena", seats=2, mode="2v2", open_socket=open_socket)
    BrowserClient.create(URL, "arena", private=True, open_socket=open_socket)
    BrowserClient.join(URL, code="abc", open_socket=open_socket)
    BrowserClient.connect(f"{URL}/arena-1", open_socket=open_socket)
    assert asked == [
        "/match?kind=arena&mode=2v2&seats=2", "/create?kind=arena&private=1", "/join?code=abc", "/arena-1",
    ]  # fmt: skip


def test_a_simulated_link_delays_and_can_be_taken_away() -> None:
    one = page(link="far")
    one.run(5)
    assert one.state == "playing"
    assert one.head("rtt_s") > 0.15
    one.client.set_link("")
    one.run(5)
    assert one.head("rtt_s") < 0.1
    with pytest.raises(ValueError, match="must be one of"):
        one.client.set_link("no such link")


def test_more_entities_than_the_array_has_room_for() -> None:
    class Crowd(Rules):
        def on_start(self) -> None:
            for x in range(12):
                for y in range(12):
                    self.game.spawn("player", (40.0 + 2 * x, 40.0 + 2 * y, 8.0))

    one = page(Crowd())
    one.run(2)
    assert one.head("rows") == 145
    assert one.client.frame(one.now) == len(HEAD) + 145 * len(COLUMNS) <= len(one.client.values)


def test_wrong_values_are_refused() -> None:
    one = page()
    one.run(2)
    with pytest.raises(SceneError, match=r"^buttons = 256"):
        one.client.press(0, 0, 256)
    with pytest.raises(SceneError, match=r"^x = nan"):
        one.client.press(float("nan"), 0)
    with pytest.raises(ValueError, match="name"):
        one.client.request("")
