"""The gateway with several games behind one port, by the target of the WebSocket's request; and other methods."""

from collections.abc import AsyncIterator

import pytest_asyncio

from server.net.admission import Admission
from server.net.gateway import Events, Gateway
from server.observability.pages import Page, PageRequest, Pages, line
from tests.patience import soon
from tests.server.test_gateway import UPGRADE, Bench, Notes, Peer, binary


class Routed(Bench):
    """A gateway with two games, and one path whose route raises."""

    def __init__(self) -> None:
        super().__init__()
        self.games = {"/one": Notes(), "/two?x=1": Notes()}
        self.asked: list[str] = []
        self.requests: list[PageRequest] = []
        self.gateway = Gateway(self.notes, Admission(pages=Pages(more=self.more)), route=self.route)

    def route(self, target: str, address: str) -> Events | Page:
        self.asked.append(target)
        assert address == "127.0.0.1"
        if target == "/":
            return self.notes
        if target == "/broken":
            raise ZeroDivisionError
        return self.games.get(target) or line(404, f"no world {target}")

    def more(self, request: PageRequest) -> Page | None:
        self.requests.append(request)
        return line(200, "done") if request.authorization == "Bearer secret" else None

    async def open(self, target: str) -> Peer:
        peer = await self.connect(UPGRADE.replace(b"GET / ", f"GET {target} ".encode()))
        assert (await peer.line()).startswith(b"HTTP/1.1 101 ")
        return peer


@pytest_asyncio.fixture
async def routed() -> AsyncIterator[Routed]:
    bench = Routed()
    bench.address = await bench.gateway.listen("127.0.0.1", 0)
    yield bench
    bench.gateway.stop_listening()
    for peer in bench.peers:
        peer.reset()
    await bench.gateway.drained()
    assert not bench.gateway.faults.total


async def test_each_connection_keeps_the_game_that_its_target_leads_to(routed: Routed) -> None:
    peers = {target: await routed.open(target) for target in ("/", "/one", "/two?x=1")}
    for target, peer in peers.items():
        peer.write(binary(target.encode()), binary(b"echo"))
        assert (await peer.frame())[1] == b"echo"
    del routed.games["/one"]  # the world ends: its connections go on until they are closed
    peers["/one"].write(binary(b"echo"))
    assert (await peers["/one"].frame())[1] == b"echo"
    assert routed.notes.messages == [b"/", b"echo"]
    two = routed.games["/two?x=1"]
    assert two.messages == [b"/two?x=1", b"echo"]
    for peer in peers.values():
        peer.reset()
    await soon(lambda: not routed.gateway.connections)
    assert (routed.notes.lost_sessions, two.lost_sessions) == ([1], [1])
    assert routed.asked == list(peers)


async def test_a_target_that_leads_nowhere_gets_a_page_and_is_counted(routed: Routed) -> None:
    peer = await routed.connect(UPGRADE.replace(b"GET / ", b"GET /other "))
    answer = await peer.end()
    assert answer.startswith(b"HTTP/1.1 404 ")
    assert answer.endswith(b"no world /other\n")
    assert routed.gateway.admission.refused == {"path": 1}
    assert not routed.notes.opened


async def test_a_route_that_fails_costs_one_connection(routed: Routed) -> None:
    peer = await routed.connect(UPGRADE.replace(b"GET / ", b"GET /broken "))
    assert (await peer.end()).startswith(b"HTTP/1.1 500 ")
    assert routed.gateway.faults.total == 1
    routed.gateway.faults.total = 0
    await routed.open("/one")


async def test_a_wrong_handshake_is_refused_by_websockets(routed: Routed) -> None:
    wrong = UPGRADE.replace(b"Sec-WebSocket-Version: 13", b"Sec-WebSocket-Version: 12").replace(b"/", b"/one", 1)
    peer = await routed.connect(wrong)
    assert (await peer.end()).startswith(b"HTTP/1.1 4")
    peer = await routed.connect(UPGRADE.replace(b"GET / ", b"POST /one "))
    assert (await peer.end()).startswith(b"HTTP/1.1 405 ")
    assert not routed.games["/one"].opened


async def test_requests_with_other_methods_have_no_body_and_come_in_pieces(routed: Routed) -> None:
    async def ask(*parts: bytes) -> bytes:
        peer = await routed.connect()
        for part in parts:
            peer.write(part)
            await peer.writer.drain()
        return await peer.end()

    head = b"POST /worlds?kind=a HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer secret\r\n"
    assert (await ask(head, b"\r\n")).startswith(b"HTTP/1.1 200 ")
    assert routed.requests == [PageRequest("POST", "/worlds", "kind=a", True, "Bearer secret")]
    assert (await ask(*[bytes([byte]) for byte in head + b"\r\n"])).startswith(b"HTTP/1.1 200 ")
    assert (await ask(head, b"Content-Length: 0\r\n\r\n")).startswith(b"HTTP/1.1 200 ")
    assert (await ask(head, b"Content-Length: 3\r\n\r\nabc")).startswith(b"HTTP/1.1 400 ")
    assert (await ask(head, b"Transfer-Encoding: chunked\r\n\r\n")).startswith(b"HTTP/1.1 400 ")
    assert (await ask(head.replace(b"secret", b"wrong"), b"\r\n")).startswith(b"HTTP/1.1 405 ")
    assert (await ask(head.replace(b"127.0.0.1", b"evil.example"), b"\r\n")).startswith(b"HTTP/1.1 421 ")
    assert len(routed.requests) == 4
