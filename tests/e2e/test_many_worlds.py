"""Many worlds in one real server process: matches, parties, codes, lists, operators, kill -9, and draining."""

import io
import json
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from client_sdk import Client, ConnectError, Disconnected, Event, Joined, Left, Matched, Resumed, list_worlds
from server.hosting import command
from tests.e2e.processes import END_S, ServerProcess, page, running, stats
from tests.patience import until

TOKEN = "a-token-of-operators"
SETTINGS = """
port = 0
scene = "flat"
[worlds.arena]
game = "sovereign_netcode.examples.tag:Tag"
scene = "arena"
players_max = 3
empty_s = 0.5
[worlds.quiet]
scene = "topdown"
empty_s = 0.5
keep = true
[worlds.hall]
scene = "meadow"
start = 2
"""


class Players:
    """Clients in one thread, with their events."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.url = f"ws://{address[0]}:{address[1]}"
        self.events: dict[Client, list[Event]] = {}

    def add(self, client: Client) -> Client:
        self.events[client] = []
        self.until(lambda: any(isinstance(event, Joined) for event in self.events[client]))
        return client

    def play(self, seconds: float) -> None:
        begin = time.monotonic()
        self.until(lambda: time.monotonic() - begin >= seconds)

    def until(self, condition: Callable[[], bool]) -> None:
        """Lets all clients play until a condition holds."""
        deadline = time.monotonic() + END_S
        while not condition():
            assert time.monotonic() < deadline, self.events
            for client, events in self.events.items():
                events += client.poll()
                client.update()
            time.sleep(0.005)

    def got(self, client: Client, kind: type[Event]) -> list[Any]:
        return [event for event in self.events[client] if isinstance(event, kind)]

    def close(self) -> None:
        for client in self.events:
            client.close()
        self.events.clear()


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "server.toml"
    path.write_text(SETTINGS, "utf-8")
    return path


@contextmanager
def started(server: ServerProcess) -> Iterator[Players]:
    """Returns clients of a server that is ready; they are closed at the end of the context."""
    players = Players(server.address())
    try:
        yield players
    finally:
        players.close()


def worlds(players: Players, *arguments: str) -> tuple[int, list[str]]:
    """Runs `sovereign-server worlds` in this process. Returns its exit code and output."""
    out = io.StringIO()
    with redirect_stdout(out):
        code = command.main([*arguments, "--url", players.url], {"SOVEREIGN_OPERATOR_TOKEN": TOKEN})
    return code, out.getvalue().splitlines()


def status(players: Players, path: str) -> tuple[int, str]:
    """Returns status and text of a page."""
    try:
        with urllib.request.urlopen(players.url.replace("ws", "http", 1) + path, timeout=END_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_clients_find_make_and_share_worlds(config: Path) -> None:
    with running("--config", str(config), SOVEREIGN_OPERATOR_TOKEN=TOKEN) as server, started(server) as players:
        address = (players.url.rpartition(":")[0].rpartition("/")[2], int(players.url.rpartition(":")[2]))
        alone = players.add(Client.connect(players.url, name="alone"))
        first = players.add(Client.match(players.url, "arena", name="first", mode="2v2", seats=2))
        friend = players.add(Client.join(players.url, seat=first.seats[0], name="friend"))
        third = players.add(Client.match(players.url, "arena", name="third", mode="2v2"))
        fourth = players.add(Client.match(players.url, "arena", name="fourth", mode="2v2"))
        assert [client.world for client in players.events] == ["", "arena-1", "arena-1", "arena-1", "arena-2"]
        private = players.add(Client.create(players.url, "quiet", private=True, name="host"))
        guest = players.add(Client.join(players.url, code=private.code.lower(), name="guest"))
        assert (guest.world, len(private.code)) == ("quiet-1", 6)
        hall = players.add(Client.join(players.url, world="hall-2"))
        assert hall.core.scene is not None
        assert hall.core.scene.name == "meadow"
        listed = {entry.name: (entry.players, entry.full) for entry in list_worlds(players.url)}
        assert listed == {"hall": (0, False), "hall-2": (1, False), "arena-1": (3, True), "arena-2": (1, False)}
        with pytest.raises(ConnectError, match="no world 'nowhere'"):
            Client.join(players.url, world="nowhere")
        stranger = Client.join(players.url, world="quiet-1", name="stranger")
        players.events[stranger] = []
        players.until(lambda: bool(players.got(stranger, Left)))
        assert "private" in players.got(stranger, Left)[0].reason
        figures = stats(address)
        assert (figures["clients"], figures["worlds"], figures["worlds_ticking"]) == (1, 5, 4)
        assert json.loads(page(address, "/arena-1/stats"))["players"] == 3
        assert 'sovereign_world_players{kind="arena",world="arena-1"} 3.0' in page(address, "/metrics")
        assert status(players, "/arena-1/")[0] == status(players, "/worlds/")[0] == 200

        code, lines = worlds(players, "list")
        assert code == 0
        assert any(private.code in line and "host" in line for line in lines)
        code, lines = worlds(players, "create", "arena", "mode=ffa")
        assert (code, lines) == (0, ["arena-3 "])
        assert worlds(players, "create", "nothing")[0] == 1
        entity = str(friend.entity)
        assert worlds(players, "kick", "arena-1", entity, "--reason", "enough")[0] == 0
        players.until(lambda: bool(players.got(friend, Left)))
        assert players.got(friend, Left)[0].reason == "enough"
        assert worlds(players, "end", "arena-1", "--reason", "an update")[0] == 0
        players.until(lambda: bool(players.got(first, Left) and players.got(third, Left)))
        assert players.got(first, Left)[0].reason == "an update"
        players.play(0.3)
        assert not players.got(fourth, Left)
        assert not players.got(alone, Left)
        players.close()
        until(lambda: stats(address)["worlds"] == 2)  # the halls stay; the others end when they are empty
        assert stats(address)["worlds_ticking"] == 0
        assert server.end(signal.SIGTERM) == 0
        assert not [entry for entry in server.log() if entry["level"] != "info"]


def test_all_worlds_come_back_after_kill_9_and_their_players_too(config: Path, tmp_path: Path) -> None:
    data = ["--config", str(config), "--data", str(tmp_path / "data")]
    with running(*data) as server, started(server) as players:
        port = players.url.rpartition(":")[2]
        one = players.add(Client.match(players.url, "arena", name="one", mode="2v2"))
        two = players.add(Client.create(players.url, "quiet", private=True, name="two"))
        away = players.add(Client.match(players.url, "quiet", name="away"))
        hall = players.add(Client.join(players.url, world="hall", name="visitor"))
        away.close()
        del players.events[away]
        players.until(lambda: "quiet-2" not in [entry.name for entry in list_worlds(players.url)])
        players.play(0.5)
        entities = {client: client.entity for client in (one, two, hall)}
        code = two.code
        server.process.kill()
        server.process.wait()
        with running(*data, "--port", port) as again:
            again.address()
            players.until(lambda: all(players.got(client, Resumed) for client in entities))
            assert {client: client.entity for client in entities} == entities
            assert [client.world for client in entities] == ["arena-1", "quiet-1", "hall"]
            assert not any(players.got(client, Left) for client in entities)
            listed = {entry.name: entry.properties for entry in list_worlds(players.url)}
            assert listed == {"arena-1": {"mode": "2v2"}, "hall": {}, "hall-2": {}}
            friend = players.add(Client.join(players.url, code=code))
            assert friend.world == "quiet-1"
            back = players.add(Client.join(players.url, world="quiet-2"))  # it was asleep
            assert back.world == "quiet-2"
            players.close()
            assert again.end(signal.SIGTERM) == 0
            assert not [entry for entry in again.log() if entry["level"] != "info"]


def test_a_server_that_is_to_stop_lets_its_worlds_end_first(config: Path) -> None:
    with running("--config", str(config), "--drain-s", "60") as server, started(server) as players:
        alone = players.add(Client.connect(players.url))
        match = players.add(Client.match(players.url, "arena", name="player", seats=2))
        server.process.send_signal(signal.SIGTERM)
        players.until(lambda: status(players, "/readyz") == (503, "not ready: draining\n"))
        for target in ("/match?kind=arena", "/create?kind=arena"):
            with pytest.raises(ConnectError, match="about to stop"):
                Client.connect(players.url + target, timeout=END_S)
        friend = players.add(Client.join(players.url, seat=match.seats[0]))  # the match goes on, and may fill up
        players.play(0.3)
        for client in (alone, match, friend):
            assert not players.got(client, Disconnected)
        match.close()
        friend.close()
        del players.events[match], players.events[friend]
        players.until(lambda: bool(players.got(alone, Disconnected)))  # as at any stop
        assert server.end() == 0
        players.close()


def test_a_world_that_does_not_end_is_stopped_when_the_time_is_over(config: Path) -> None:
    with running("--config", str(config), SOVEREIGN_OPERATOR_TOKEN=TOKEN) as server, started(server) as players:
        match = players.add(Client.match(players.url, "arena", name="player"))
        assert players.got(match, Matched)
        assert worlds(players, "drain", "--within-s", "0.5") == (0, ["draining: 3 worlds"])
        players.until(lambda: bool(players.got(match, Disconnected)))
        assert server.end() == 0
        (entry,) = [entry for entry in server.log() if entry["event"] == "stopping"]
        assert entry["reason"] == "drained, with players in 1 worlds"
