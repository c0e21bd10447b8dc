"""The two clients follow `Go` over real sockets: to the same host and port, at once, and to nothing else."""

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from client_sdk import AsyncClient, Client, ConnectError, Event, Left, Matched, WorldEntry, list_worlds
from shared import messages
from shared.messages import Bye, Go, decode_from_client, encode
from tests.client_sdk.servers import Peer, accept, scripted_server, until_closed
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.e2e

Script = Callable[[socket.socket], object]
REFUSED = b"there is no world 'arena-1'"


class Told:
    """A server that keeps the paths of the requests, and the frames of each connection."""

    def __init__(self) -> None:
        self.paths: list[str] = []
        self.frames: list[list[tuple[int, bytes]]] = []

    def _accept(self, sock: socket.socket) -> Peer:
        peer = accept(sock)
        self.paths.append(peer.path)
        return peer

    def _end(self, sock: socket.socket, peer: Peer) -> None:
        self.frames.append([(int(frame.opcode), bytes(frame.data)) for frame in until_closed(sock, peer)])

    def sends_on(self, go: Go, *, closes: bool = True) -> Script:
        """Returns the script of a lobby. If it `closes`, the close frame comes with the message."""

        def script(sock: socket.socket) -> None:
            peer = self._accept(sock)
            peer.protocol.send_binary(encode(go))
            if closes:
                peer.protocol.send_close(1000, "")
            sock.sendall(peer.send())
            self._end(sock, peer)

        return script

    def says_goodbye(self, sock: socket.socket) -> None:
        """Plays a world that removes its player."""
        peer = self._accept(sock)
        peer.protocol.send_binary(encode(Bye(messages.KICKED, "that was it", -1.0)))
        peer.protocol.send_close(messages.KICKED, "that was it")
        sock.sendall(peer.send())
        self._end(sock, peer)

    def refuses(self, sock: socket.socket) -> None:
        """Plays a world that has ended."""
        self.paths.append(sock.recv(65536).split()[1].decode())
        head = f"HTTP/1.1 404 Not Found\r\nContent-Type: text/plain\r\nContent-Length: {len(REFUSED)}\r\n\r\n"
        sock.sendall(head.encode() + REFUSED)


async def asynchronous(how: str, url: str, **options: Any) -> list[Event]:
    """Returns the events of an `AsyncClient` until it has left."""
    async with asyncio.timeout(PATIENCE_S):
        async with await getattr(AsyncClient, how)(url, **options) as client:
            return [event async for event in client]


def polled(how: str, url: str, **options: Any) -> list[Event]:
    """Returns the events of a `Client` until it has left."""
    events: list[Event] = []
    with getattr(Client, how)(url, **options) as client:
        until = time.monotonic() + PATIENCE_S
        while not any(isinstance(event, Left) for event in events):
            assert time.monotonic() < until
            events += client.poll()
            client.update()
            time.sleep(0.001)
    return events


def run(asyncs: bool, how: str, url: str, **options: Any) -> list[Event]:
    return asyncio.run(asynchronous(how, url, **options)) if asyncs else polled(how, url, **options)


both = pytest.mark.parametrize("asyncs", [False, True], ids=["Client", "AsyncClient"])
GO = Go("/arena-1?seat=a.b", "K7", ["/arena-1?seat=c"], "matched")


@both
@pytest.mark.parametrize("closes", [True, False])
@pytest.mark.parametrize("link", [None, "regional"])
def test_a_match_over_a_socket(asyncs: bool, closes: bool, link: str | None) -> None:
    told = Told()
    with scripted_server(told.sends_on(GO, closes=closes), told.says_goodbye) as url:
        options: dict[str, Any] = {"kind": "arena", "mode": "2v2", "ranked": True, "level": 3, "seats": 2, "link": link}
        events = run(asyncs, "match", url, **options)
    assert told.paths == ["/match?kind=arena&mode=2v2&ranked=true&level=3&seats=2", "/arena-1?seat=a.b"]
    assert events == [Matched("arena-1", "K7", ("/arena-1?seat=c",)), Left(messages.KICKED, "that was it", -1.0)]
    lobby, _ = told.frames
    assert lobby[-1] == (8, (1000).to_bytes(2, "big")), "a proper close"
    kinds = [type(decode_from_client(data)) for opcode, data in lobby[:-1] if opcode == 2]
    assert kinds[:1] in ([messages.Hello], []), "nothing but the Hello and pings; a simulated link may still hold it"
    assert set(kinds[1:]) <= {messages.Ping}


@both
def test_a_world_that_has_gone_is_asked_for_again(asyncs: bool) -> None:
    told = Told()
    second = Go("/arena-2?seat=z", "", [], "matched")
    scripts = (told.sends_on(GO), told.refuses, told.sends_on(second), told.says_goodbye)
    with scripted_server(*scripts) as url:
        events = run(asyncs, "create", url, kind="arena", private=True)
    assert told.paths == ["/create?kind=arena&private=1", GO.path, "/create?kind=arena&private=1", second.path]
    assert [type(event) for event in events] == [Matched, Matched, Left]


@both
def test_the_reason_of_a_world_that_never_takes_the_client(asyncs: bool) -> None:
    told = Told()
    with scripted_server(*(told.sends_on(GO), told.refuses) * 4) as url:
        events = run(asyncs, "join", url, code="K7F3QD")
    assert told.paths == ["/join?code=K7F3QD", GO.path] * 4
    assert isinstance(events[-1], Left)
    assert events[-1].reason == f"{url}{GO.path}: {REFUSED.decode()}"


@both
def test_a_path_is_no_address(asyncs: bool) -> None:
    told = Told()
    elsewhere = Go("//127.0.0.2:9/x#y", "", [], "")
    with scripted_server(told.sends_on(elsewhere), told.says_goodbye) as url:
        events = run(asyncs, "connect", url)
    assert told.paths == ["/", "//127.0.0.2:9/x#y"], "the same host and port"
    assert isinstance(events[-1], Left)


@both
def test_a_world_that_is_not_there_is_an_error_of_the_call(asyncs: bool) -> None:
    told = Told()
    with (
        scripted_server(told.refuses) as url,
        pytest.raises(ConnectError, match="/arena-1: there is no world 'arena-1'"),
    ):
        run(asyncs, "join", url, world="arena-1")


# -- the list ------------------------------------------------------------------------------------------------

ENTRY = {
    "name": "arena-1", "kind": "arena", "players": 1, "players_max": 16, "locked": False, "full": False,
    "properties": {"mode": "2v2", "level": 3}, "age_s": 1.5,
}  # fmt: skip


@contextlib.contextmanager
def listing(body: bytes, status: str = "200 OK") -> Iterator[str]:
    """Yields the URL of a server that answers one request over HTTP."""

    def script(sock: socket.socket) -> None:
        assert sock.recv(65536).startswith(b"GET /worlds HTTP/1.1\r\n")
        sock.sendall(f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)

    with scripted_server(script) as url:
        yield url


def test_the_list_of_worlds() -> None:
    race = {**ENTRY, "name": "race-1", "kind": "race", "more": "of a later version"}
    body = json.dumps({"worlds": [ENTRY, race]}).encode()
    entry = WorldEntry("arena-1", "arena", 1, 16, False, False, {"mode": "2v2", "level": 3}, 1.5)
    with listing(body) as url:
        assert [each.name for each in list_worlds(url)] == ["arena-1", "race-1"]
    with listing(body) as url:
        assert list_worlds(f"{url}/match?kind=race", "arena") == [entry]
    with listing(body) as url:
        assert asyncio.run(AsyncClient.list_worlds(url, "arena")) == [entry]


@pytest.mark.parametrize(
    "body",
    [
        *(b"", b"{}", b"[]", b'{"worlds": [1]}', b'{"worlds": {}}', b"not json", b"[" * 100_000, b'["\xff"]'),
        json.dumps({"worlds": [{**ENTRY, "players": "1"}]}).encode(),
        json.dumps({"worlds": [{**ENTRY, "full": 1}]}).encode(),
    ],
)
def test_a_list_of_something_else(body: bytes) -> None:
    with listing(body) as url, pytest.raises(ConnectError, match=r"no list of worlds \(its answer is something else\)"):
        list_worlds(url)


def test_a_server_without_a_list() -> None:
    with (
        listing(b"no such page\n", "404 Not Found") as url,
        pytest.raises(ConnectError, match=r"no list of worlds \(HTTP status 404: no such page\)"),
    ):
        list_worlds(url)
    with pytest.raises(ConnectError, match="no list of worlds"):
        list_worlds(url, timeout=5)  # nobody listens there any more
    with pytest.raises(ConnectError, match="looks like ws://"):
        list_worlds("localhost:8765")
    with pytest.raises(ValueError, match="kind = 3"):
        list_worlds(url, 3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="timeout"):
        list_worlds(url, timeout=-1)
