"""The synchronous client on real loopback sockets."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from client_sdk.client import Client
from client_sdk.core import Core
from client_sdk.events import Answered, Event, Joined, Left
from client_sdk.transports import common
from client_sdk.transports.common import UNSENT_MAX, ConnectError
from client_sdk.transports.connection import Connection
from client_sdk.transports.polling import PollingTransport
from shared import messages
from shared.messages import Bye, encode
from shared.scene import load_scene
from tests.client_sdk.servers import accept, real_server, request, scripted_server, silent_server, until_closed
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with real_server("--scene", "flat") as url:
        yield url


def play(client: Client, until: Callable[[], bool], seconds: float = PATIENCE_S) -> list[Event]:
    """Runs a game's loop until a condition holds. Returns the events."""
    events: list[Event] = []
    deadline = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < deadline, f"still not so; {client.core.state}, {client.stats}"
        events += client.poll()
        client.update()
        time.sleep(0.005)
    return events + client.poll()


def raw_socket(client: Client) -> socket.socket:
    transport = client._transport
    assert isinstance(transport, PollingTransport)
    assert transport._first._socket is not None
    return transport._first._socket


def test_a_player_joins_walks_and_leaves(url: str) -> None:
    with Client.connect(url, name="Ann") as client:
        assert client.joining
        events = play(client, lambda: client.playing)
        (joined,) = [event for event in events if isinstance(event, Joined)]
        assert joined.entity == client.entity
        before = client.view().me
        assert before is not None
        client.set_input(1, 0)
        goal = client.stats.inputs_sent + 32
        play(client, lambda: client.stats.inputs_sent >= goal)
        after = client.view().me
        assert after is not None
        assert after.position[0] - before.position[0] == pytest.approx(3.0, abs=0.8)
        assert client.stats.corrections == 0
    assert client.closed
    assert [event for event in client.poll() if isinstance(event, Left)] == [Left(1000, "closed by this client")]
    client.close()


def test_a_block_is_placed_and_removed_again(url: str) -> None:
    with Client.connect(url) as client:
        with pytest.raises(RuntimeError, match="has not joined"):
            client.edit(1, 1, 5, 1)
        play(client, lambda: client.playing)
        client.set_input_delay(1)
        with pytest.raises(ValueError, match="ticks = -1"):
            client.set_input_delay(-1)
        me = client.view().me
        assert me is not None
        x, y, z = (int(part // 1) for part in me.position)
        blocks = client.core.prediction.confirmed.blocks  # type: ignore[union-attr]
        for kind in (7, 0):
            number = client.edit(x, y + 2, z + 3, kind)
            events = play(client, lambda kind=kind: blocks.get(x, y + 2, z + 3) == kind)  # type: ignore[misc]
            assert [event for event in events if isinstance(event, Answered)] == [Answered(number, True, "done")]


def test_the_own_scene_is_checked_by_the_server(url: str) -> None:
    with Client.connect(url, scene=load_scene("flat")) as client:
        play(client, lambda: client.playing)
    with Client.connect(url, scene=load_scene("arena")) as client:
        (left,) = [event for event in play(client, lambda: client.closed) if isinstance(event, Left)]
    assert left.code == messages.WRONG_SCENE
    assert "another scene" in left.reason
    assert "terrain" in left.reason


def test_small_messages_are_not_held_back(url: str) -> None:
    with Client.connect(url) as client:
        assert raw_socket(client).getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert raw_socket(client).gettimeout() == 0.0


@pytest.mark.alone
def test_an_idle_poll_costs_microseconds() -> None:
    with silent_server() as url, Client.connect(url) as client:
        best = float("inf")
        for _ in range(50):
            begun = time.perf_counter()
            for _ in range(200):
                client.poll()
            best = min(best, (time.perf_counter() - begun) / 200)
        client.close(timeout=0)
    assert best < 10e-6  # 2 us on an idle machine


def test_a_server_that_stops_reading_is_left() -> None:
    over = threading.Event()

    def script(sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        accept(sock)
        over.wait(PATIENCE_S)

    core = Core()
    with scripted_server(script) as url:
        client = Client(core, PollingTransport(Connection(url, core), 5.0))
        raw_socket(client).setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        transport = client._transport
        assert isinstance(transport, PollingTransport)
        most = 0
        while not client.closed:
            core._out.append(bytes(1000))
            client.update()
            most = max(most, len(transport._first._unsent))
        over.set()
        (left,) = client.poll()
        client.close()
    assert isinstance(left, Left)
    assert left.code == messages.TOO_SLOW
    assert "stopped reading" in left.reason
    assert most <= UNSENT_MAX + 1100


def test_what_does_not_fit_goes_out_later_in_order() -> None:
    wanted = [bytes((i,)) * 3000 for i in range(16)]
    heard: list[bytes] = []
    go = threading.Event()

    def script(sock: socket.socket) -> None:
        peer = accept(sock)
        go.wait(PATIENCE_S)
        heard.extend(bytes(frame.data) for frame in until_closed(sock, peer))

    core = Core()
    with scripted_server(script) as url:
        client = Client(core, PollingTransport(Connection(url, core), 5.0))
        raw_socket(client).setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        core._out += wanted
        client.update()
        transport = client._transport
        assert isinstance(transport, PollingTransport)
        assert transport._first._unsent
        go.set()
        client.close(timeout=10)
    assert [data for data in heard if len(data) == 3000] == wanted


def test_a_server_that_vanishes_is_an_event() -> None:
    with scripted_server(accept) as url, Client.connect(url) as client:
        (left,) = play(client, lambda: client.closed)
    assert isinstance(left, Left)
    assert "broke off" in left.reason


def test_a_shutdown_says_when_to_reconnect() -> None:
    def script(sock: socket.socket) -> None:
        peer = accept(sock)
        peer.protocol.send_binary(encode(Bye(messages.GOING_AWAY, "the server is going down", 2.0)))
        peer.protocol.send_close(messages.GOING_AWAY, "")
        sock.sendall(peer.send())
        until_closed(sock, peer)

    with scripted_server(script) as url, Client.connect(url) as client:
        events = play(client, lambda: client.closed)
    assert events == [Left(messages.GOING_AWAY, "the server is going down", 2.0)]


def test_a_refused_connection_reads_like_advice() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(ConnectError, match=f"no server there .* start one with: sovereign-server --port {port}"):
        Client.connect(f"ws://127.0.0.1:{port}")


def test_a_page_that_is_no_game_reads_like_advice() -> None:
    def script(sock: socket.socket) -> None:
        request(sock)
        sock.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    with (
        scripted_server(script) as url,
        pytest.raises(ConnectError, match="something is there, but it is not a Sovereign Netcode server"),
    ):
        Client.connect(url)


def test_silence_ends_in_time() -> None:
    over = threading.Event()
    with scripted_server(lambda _: over.wait(PATIENCE_S)) as url:
        begun = time.monotonic()
        with pytest.raises(ConnectError, match="no answer in time"):
            Client.connect(url, timeout=0.3)
        assert 0.25 < time.monotonic() - begun < 5
        over.set()


def test_close_waits_no_longer_than_its_timeout() -> None:
    with silent_server() as url:
        client = Client.connect(url)
        begun = time.monotonic()
        client.close(timeout=0.2)
        assert time.monotonic() - begun < 2


def test_a_way_that_has_become_silent_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "SILENCE_S", 0.3)
    with silent_server() as address:
        client = Client.connect(address)
        (left,) = play(client, lambda: client.closed)
    assert isinstance(left, Left)
    assert left.reason == "nothing received for 0.3 s"
    assert client._transport._first._socket is None  # type: ignore[attr-defined]
