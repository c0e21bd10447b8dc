"""The gateway over real loopback sockets, with a game that only takes notes, and with misbehaving peers."""

import asyncio
import json
import logging
import random
import socket
import struct
import sys
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

import pytest
import pytest_asyncio
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.utils import apply_mask

from server.config.limits import Limits
from server.net import websocket as module
from server.net.admission import SPARE_PER_ADDRESS, Admission
from server.net.gateway import Gateway
from server.net.websocket import Connection
from server.observability.pages import Page, Pages, json_page
from shared.fields import CLIENT_MESSAGE_MAX
from tests.lengths import examples
from tests.patience import PATIENCE_S, soon

UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
)
HANDSHAKE_S = 3.0


class Notes:
    """A game that records what it gets, and raises if a message says so."""

    def __init__(self) -> None:
        self.opened: list[Connection] = []
        self.received: list[tuple[int, bytes]] = []
        self.lost_sessions: list[int] = []
        self.refuses = False

    def open(self, link: Connection, now: float) -> int:
        self.opened.append(link)
        if self.refuses:
            link.send(b"bye")
            link.close(4001, "full")
        return len(self.opened)

    def receive(self, session: int, data: bytes, now: float) -> None:
        assert type(data) is bytes
        self.received.append((session, data))
        link = self.opened[session - 1]
        if data == b"raise":
            raise ZeroDivisionError
        if data == b"echo":
            link.send(data)
        if data == b"leave":
            link.close(4002, "ü" * 100)

    def lost(self, session: int, now: float) -> None:
        self.lost_sessions.append(session)

    @property
    def messages(self) -> list[bytes]:
        return [data for _, data in self.received]


class Peer:
    """A raw socket that can read frames."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    def write(self, *parts: bytes) -> None:
        self.writer.write(b"".join(parts))

    async def line(self) -> bytes:
        return await asyncio.wait_for(self.reader.readuntil(b"\r\n\r\n"), PATIENCE_S)

    async def frame(self) -> tuple[int, bytes]:
        async with asyncio.timeout(PATIENCE_S):
            first, length = await self.reader.readexactly(2)
            assert length < 128, "a server does not mask"
            if length == 126:
                (length,) = struct.unpack("!H", await self.reader.readexactly(2))
            return first, await self.reader.readexactly(length)

    async def end(self) -> bytes:
        """Returns all bytes up to the end of the stream, by FIN or RST."""
        chunks = []
        async with asyncio.timeout(PATIENCE_S):
            try:
                while chunk := await self.reader.read(1 << 16):
                    chunks.append(chunk)
            except ConnectionError:
                pass
        return b"".join(chunks)

    async def closed_with(self, code: int) -> str:
        """Skips frames up to the close frame, which must have this code and end the stream. Returns its reason."""
        while True:
            first, data = await self.frame()
            if first == 0x88:
                break
        assert struct.unpack("!H", data[:2]) == (code,)
        assert await self.end() == b""
        return data[2:].decode()

    def reset(self) -> None:
        """Disconnects without a closing handshake."""
        self.writer.transport.abort()


class Bench:
    def __init__(self) -> None:
        self.notes = Notes()
        self.figures: Callable[[], Mapping[str, Any]] = lambda: {"tick": 7}
        self.large = b"x"
        public = {"/large": lambda: Page(200, self.large)}
        pages = Pages(
            public, private={"/stats": json_page(lambda: self.figures())}, failed=lambda path: self.failed(path)
        )
        self.gateway = Gateway(self.notes, Admission(Limits(handshake_s=HANDSHAKE_S), pages))
        self.address = ("", 0)
        self.peers: list[Peer] = []

    def failed(self, path: str) -> None:
        self.gateway.faults.report(path)

    async def connect(self, *first: bytes, **options: Any) -> Peer:
        peer = Peer(*await asyncio.open_connection(*self.address, **options))
        self.peers.append(peer)
        peer.write(*first)
        return peer

    async def client(self, **options: Any) -> Peer:
        peer = await self.connect(UPGRADE, **options)
        assert (await peer.line()).startswith(b"HTTP/1.1 101 ")
        return peer

    async def all_gone(self) -> None:
        """Waits until all connections have ended, and checks that each was reported to the game exactly once."""
        async with asyncio.timeout(PATIENCE_S):
            await self.gateway.drained()
        assert sorted(self.notes.lost_sessions) == list(range(1, len(self.notes.opened) + 1))


@pytest_asyncio.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    bench.address = await bench.gateway.listen("127.0.0.1", 0)
    yield bench
    bench.gateway.stop_listening()
    for peer in bench.peers:
        peer.reset()
    await bench.all_gone()


MASK = b"\x5a\xc3\x0f\x99"


def masked(opcode: Opcode, data: bytes, *, fin: bool = True) -> bytes:
    """Returns a client's frame. Its mask is constant, so that the names of tests are the same in every run."""
    plain = Frame(opcode, data, fin).serialize(mask=False)
    head = bytearray(plain[: len(plain) - len(data)])
    head[1] |= 0x80
    return bytes(head) + MASK + apply_mask(data, MASK)


def binary(data: bytes) -> bytes:
    return masked(Opcode.BINARY, data)


async def test_messages_both_ways_in_order(bench: Bench) -> None:
    peer = await bench.client()
    sent = [bytes([n]) * n for n in range(200)] + [bytes(CLIENT_MESSAGE_MAX)]
    peer.write(*map(binary, sent), binary(b"echo"))
    assert await peer.frame() == (0x82, b"echo")
    assert bench.notes.messages == [*sent, b"echo"]


async def test_the_socket_has_no_delay_and_there_is_no_compression(bench: Bench) -> None:
    peer = await bench.connect(UPGRADE)
    assert b"Sec-WebSocket-Extensions" not in await peer.line()
    (connection,) = bench.gateway.connections
    assert connection._transport is not None
    sock = connection._transport.get_extra_info("socket")
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


async def test_every_chopping_of_the_stream_gives_the_same_messages(bench: Bench) -> None:
    stream = UPGRADE + b"".join(binary(bytes([n]) * n * 30) for n in range(10))
    expected = [bytes([n]) * n * 30 for n in range(10)]
    rng = random.Random(1)
    for turn in range(20):
        peer = await bench.connect()
        at = 0
        while at < len(stream):
            step = rng.choice((1, 2, 3, 50, 1000)) if turn else len(stream)
            peer.write(stream[at : at + step])
            at += step
            await peer.writer.drain()
            await asyncio.sleep(0)
        await soon(lambda: len(bench.notes.received) == len(expected))
        assert bench.notes.messages == expected
        bench.notes.received.clear()


async def test_a_client_may_speak_before_the_answer_to_its_handshake(bench: Bench) -> None:
    peer = await bench.connect(UPGRADE, masked(Opcode.PING, b"p"), binary(b"echo"))
    assert (await peer.line()).startswith(b"HTTP/1.1 101 ")
    assert await peer.frame() == (0x8A, b"p")
    assert await peer.frame() == (0x82, b"echo")


async def test_fragments_make_one_message_with_pings_between_them(bench: Bench) -> None:
    peer = await bench.client()
    peer.write(
        masked(Opcode.BINARY, b"ec", fin=False),
        masked(Opcode.PING, b"p"),
        masked(Opcode.CONT, b"", fin=False),
        masked(Opcode.CONT, b"ho"),
        masked(Opcode.BINARY, b"", fin=False),
        masked(Opcode.CONT, b""),
    )
    assert await peer.frame() == (0x8A, b"p")
    assert await peer.frame() == (0x82, b"echo")
    await soon(lambda: bench.notes.messages == [b"echo", b""])


@pytest.mark.parametrize(
    ("stream", "code"),
    [
        (masked(Opcode.TEXT, b"hello"), 1003),
        (masked(Opcode.TEXT, b"hel", fin=False) + masked(Opcode.CONT, b"lo"), 1003),
        (binary(bytes(CLIENT_MESSAGE_MAX + 1)), 1009),
        (masked(Opcode.BINARY, bytes(5000), fin=False) + masked(Opcode.CONT, bytes(5000)), 1009),
        (b"\x82\xff\xff\xff\xff\xff\xff\xff\xff\xff", 1009),
        (b"\x82\x05hello", 1002),
        (b"\x82\x00", 1002),
        (b"\x83\x80\0\0\0\0", 1002),
        (b"\xc2\x80\0\0\0\0", 1002),
        (b"\x09\x80\0\0\0\0", 1002),
        (b"\x89\xfe\x00\x7e\0\0\0\0" + bytes(126), 1002),
        (masked(Opcode.CONT, b"x"), 1002),
        (masked(Opcode.BINARY, b"x", fin=False) + binary(b"y"), 1002),
        (masked(Opcode.CLOSE, b"\x03"), 1002),
        (masked(Opcode.CLOSE, b"\x03\xe8\xff"), 1007),
        (masked(Opcode.CLOSE, b"\x00\x01"), 1002),
    ],
)
async def test_a_broken_protocol_is_answered_with_its_code(
    bench: Bench, caplog: pytest.LogCaptureFixture, stream: bytes, code: int
) -> None:
    peer = await bench.client()
    peer.write(binary(b"before"), stream, binary(b"after"))
    closing = asyncio.ensure_future(peer.closed_with(code))
    if code == 1003:  # after an ordinary closing handshake, the peer closes the connection
        await soon(lambda: len(bench.notes.lost_sessions) == 1)
        peer.write(masked(Opcode.CLOSE, struct.pack("!H", code)))
    await closing
    peer.writer.close()
    await bench.all_gone()
    assert bench.notes.messages == [b"before"]
    assert bench.gateway.faults.total == 0
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


async def test_the_peer_closes_after_a_last_message(bench: Bench) -> None:
    peer = await bench.client()
    peer.write(binary(b"last"), masked(Opcode.CLOSE, struct.pack("!H", 1000) + b"enough"))
    assert await peer.closed_with(1000) == "enough"
    assert bench.notes.messages == [b"last"]
    assert bench.notes.lost_sessions == [1], "before the peer has disconnected"
    peer.writer.close()
    await bench.all_gone()


async def test_the_game_closes_after_what_it_has_sent(bench: Bench) -> None:
    peer = await bench.client()
    peer.write(binary(b"echo"), binary(b"leave"), binary(b"ignored"))
    assert await peer.frame() == (0x82, b"echo")
    first, data = await peer.frame()
    assert (first, data) == (0x88, struct.pack("!H", 4002) + "ü".encode() * 61), "cut to what a close frame holds"
    assert bench.notes.messages == [b"echo", b"leave"]
    link = bench.notes.opened[0]
    link.send(b"too late")
    link.close(4003, "again")
    peer.write(masked(Opcode.CLOSE, data[:2]))
    assert await peer.end() == b""
    peer.writer.close()
    await bench.all_gone()
    link.send(b"far too late")
    link.close(4003, "again")
    assert link.outstanding() == 0


async def test_the_game_refuses_at_once(bench: Bench) -> None:
    bench.notes.refuses = True
    peer = await bench.client()
    assert await peer.frame() == (0x82, b"bye")
    peer.write(binary(b"ignored"), masked(Opcode.CLOSE, b""))
    assert await peer.closed_with(4001) == "full"
    peer.writer.close()
    await bench.all_gone()
    assert bench.notes.messages == []


async def test_an_error_of_the_game_closes_that_connection_and_is_counted(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bad, good = await bench.client(), await bench.client()
    bad.write(binary(b"raise"), binary(b"raise"))
    assert await bad.frame() == (0x88, struct.pack("!H", 1011) + b"internal error")
    good.write(binary(b"echo"))
    assert await good.frame() == (0x82, b"echo")
    assert bench.gateway.faults.total == 1
    assert [record.exc_info is not None for record in caplog.records if record.levelno == logging.ERROR] == [True]


@pytest.mark.parametrize(
    "rubbish",
    [
        b"\r\n\r\n",
        b"\x00" * 100 + b"\n",
        b"GET / HTTP/1.1\nHost: x\n\n",
        b"GET / HTTP/2.0\r\n\r\n",
        b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello",
        b"GET /" + b"a" * 10_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 1000 + b"\r\n",
        UPGRADE.replace(b"AAAA==", b"AAAA"),
        UPGRADE.replace(b"13", b"8"),
        UPGRADE.replace(b"Connection: Upgrade", b"Connection: close"),
        UPGRADE.replace(b"GET", b"PUT"),
    ],
)
async def test_an_invalid_handshake_is_answered_in_one_line(
    bench: Bench, caplog: pytest.LogCaptureFixture, rubbish: bytes
) -> None:
    peer = await bench.connect(rubbish)
    head, _, body = (await peer.end()).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 4")
    assert 0 < len(body.splitlines()) <= 3
    peer.writer.close()
    await bench.all_gone()
    assert bench.notes.opened == []
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


async def test_random_bytes_in_every_stage_and_the_server_goes_on(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    rng = random.Random(7)
    for turn in range(100):
        peer = await bench.connect(UPGRADE if turn % 2 else b"")
        peer.write(rng.randbytes(rng.choice((1, 10, 300, 20_000))))
        if turn % 3:
            peer.writer.write_eof()
            await peer.end()
            peer.writer.close()
        else:
            peer.reset()
    await bench.all_gone()
    good = await bench.client()
    good.write(binary(b"echo"))
    assert await good.frame() == (0x82, b"echo")
    assert bench.gateway.faults.total == 0
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.parametrize("sent", [b"", b"GET / HT", UPGRADE, UPGRADE + b"\x82", UPGRADE + binary(bytes(300))[:99]])
@pytest.mark.parametrize("way", ["half-close", "reset"])
async def test_the_peer_goes_in_the_middle(bench: Bench, sent: bytes, way: str) -> None:
    peer = await bench.connect(sent)
    if sent.startswith(UPGRADE):
        await peer.line()
    else:
        await soon(lambda: len(bench.gateway.connections) == 1)
    if way == "reset":
        peer.reset()
    else:
        peer.writer.write_eof()
        await peer.end()
        peer.writer.close()
    await bench.all_gone()
    assert bench.notes.received == []


async def test_a_handshake_must_be_finished_in_time(bench: Bench) -> None:
    bench.gateway.admission.limits = Limits(handshake_s=0.05)
    slow, good = await bench.connect(UPGRADE[:-2]), await bench.client()
    assert await slow.end() == b""
    good.write(binary(b"echo"))
    assert await good.frame() == (0x82, b"echo")


async def test_a_peer_that_does_not_finish_closing_is_aborted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CLOSE_S", 0.05)
    peer = await bench.client()
    bench.notes.opened[0].close(1000, "")
    peer.write(*[masked(Opcode.PING, b"")] * 3)  # pings do not extend the time
    await bench.all_gone()


async def test_a_peer_that_neither_reads_nor_hangs_up_is_aborted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CLOSE_S", 0.05)
    peer = await bench.client(limit=1024)
    link = bench.notes.opened[0]
    for _ in range(200):
        link.send(bytes(65_000))
    peer.writer.write_eof()  # half-open: 13 MB are still to be written by us
    await bench.all_gone()


async def test_outstanding_counts_bytes_that_the_peer_has_not_received(bench: Bench) -> None:
    peer = await bench.client(limit=1024)
    link = bench.notes.opened[0]
    await soon(lambda: not link.outstanding())
    for _ in range(200):
        link.send(bytes(65_000))
    sent = 200 * 65_004
    assert link._transport is not None
    if sys.platform == "linux":
        # The bytes that the peer's kernel has not received. Its receive buffer holds at most some 6 MB.
        assert (link.outstanding() or 0) > link._transport.get_write_buffer_size() > 0
    assert sent - (8 << 20) < (link.outstanding() or 0) <= sent
    total = 0
    while total < sent:
        total += len(await asyncio.wait_for(peer.reader.read(1 << 20), PATIENCE_S))
    await soon(lambda: not link.outstanding())


async def test_outstanding_is_harmless_after_a_reset(bench: Bench) -> None:
    peer = await bench.client()
    link = bench.notes.opened[0]
    peer.reset()
    for _ in range(10):
        link.send(bytes(1000))
        assert (link.outstanding() or 0) >= 0
    await bench.all_gone()
    assert link.outstanding() == 0


EXTRAS = {
    "pings": masked(Opcode.PING, b""),
    "pongs": masked(Opcode.PONG, b""),
    "fragments": masked(Opcode.BINARY, b"", fin=False) + masked(Opcode.CONT, b""),
}


@pytest.mark.parametrize("flood", EXTRAS)
async def test_a_flood_without_a_message_ends_in_an_abort(bench: Bench, flood: str) -> None:
    peer, other = await bench.client(), await bench.client()
    peer.write(EXTRAS[flood] * 5000)
    assert len(await peer.end()) <= 2 * module.EXTRAS_PER_S
    await soon(lambda: bench.notes.lost_sessions == [1])
    assert len(bench.notes.messages) < module.EXTRAS_PER_S
    other.write(EXTRAS[flood] * 100, binary(b"echo"))
    while (await other.frame())[1] != b"echo":
        pass


async def test_bytes_after_the_end_are_not_parsed_and_too_many_end_in_an_abort(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = await bench.client()
    (connection,) = bench.gateway.connections
    parsed: list[int] = []
    receive_data = connection._protocol.receive_data

    def counted(data: bytes) -> None:
        parsed.append(len(data))
        receive_data(data)

    monkeypatch.setattr(connection._protocol, "receive_data", counted)
    peer.write(binary(b"leave"), binary(b"more") * 1000, masked(Opcode.PING, b"?"))
    assert (await peer.frame())[0] == 0x88
    assert await peer.frame() == (0x8A, b"?")
    assert parsed == [len(masked(Opcode.PING, b"?"))]
    while connection in bench.gateway.connections and not peer.writer.transport.is_closing():
        peer.write(binary(b"more") * 1000)
        await asyncio.sleep(0)
    assert bench.notes.messages == [b"leave"]
    assert len(parsed) == 1


class Wire(asyncio.Transport):
    """A transport that keeps what is written, without a socket."""

    def __init__(self) -> None:
        self.socket = socket.socket()
        super().__init__({"socket": self.socket})
        self.written = bytearray()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written += data

    def abort(self) -> None:
        raise AssertionError("no flood")

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        self.written += b"EOF"

    def get_write_buffer_size(self) -> int:
        return 0


BODIES = st.one_of(
    st.binary(max_size=6), st.sampled_from([b"leave", b"echo", b"raise"]), st.integers(120, 130).map(bytes)
)
DATA = st.builds(
    lambda opcode, body, fin: masked(opcode, body, fin=fin),
    st.sampled_from([Opcode.BINARY] * 6 + [Opcode.CONT, Opcode.TEXT]),
    BODIES,
    st.sampled_from([True, True, True, False]),
)
CONTROL = st.builds(masked, st.sampled_from([Opcode.PING, Opcode.PONG, Opcode.CLOSE]), st.binary(max_size=6))
ODD = st.one_of(
    st.binary(max_size=12),
    st.integers(CLIENT_MESSAGE_MAX - 1, CLIENT_MESSAGE_MAX + 1),  # the length of a message, to keep reports short
    st.sampled_from([b"\x82\xff\0\0\0\0\0\0\0\x03keysabc", b"\x82\xfe\0\x03keysabc", b"\x82\x03abc"]),
)


def outcome(chunks: list[bytes], *, plain: bool, inlet: bool = False) -> tuple[list[bytes], list[int], bytes]:
    """Runs a connection with these chunks. Returns what the game received, what it lost, and what was written.

    With `inlet` the game takes frames of short messages before they are parsed.
    """
    notes, wire, loop = Notes(), Wire(), asyncio.new_event_loop()
    connection = Connection(Gateway(notes), loop)
    connection.connection_made(wire)
    connection.data_received(UPGRADE)
    connection._plain = plain
    if inlet:
        connection.inlet = lambda data, now: take_frame(notes, data)
    wire.written.clear()
    for chunk in chunks:
        connection.data_received(chunk)
    wire.socket.close()
    loop.close()
    return notes.messages, notes.lost_sessions, bytes(wire.written)


def take_frame(notes: Notes, data: bytes) -> bool:
    """Notes the message of a chunk that is one short frame without an order to the game. Returns whether it is."""
    if not 6 <= len(data) <= 131 or data[0] != 0x82 or data[1] != 0x80 + len(data) - 6:
        return False
    body = bytes(byte ^ data[2 + i % 4] for i, byte in enumerate(data[6:]))
    if body in (b"leave", b"echo", b"raise"):
        return False
    notes.received.append((1, body))
    return True


@settings(max_examples=examples(300))
@given(st.lists(st.one_of(DATA, DATA, CONTROL, ODD), max_size=12), st.lists(st.integers(0, 2000), max_size=8))
def test_the_fast_parser_and_websockets_agree(frames: list[bytes | int], cuts: list[int]) -> None:
    whole = [binary(bytes(frame)) if isinstance(frame, int) else frame for frame in frames]
    while len(stream := b"".join(whole)) > 20_000:  # whole frames: of half a one, who sees less of it judges later
        whole.pop()
    ends = sorted({min(cut, len(stream)) for cut in cuts} | {len(stream)})
    chunks = [stream[a:b] for a, b in zip([0, *ends], ends, strict=False)]
    # Byte by byte, websockets hands out each frame before it sees the next, as is the case here.
    told = outcome(chunks, plain=True)
    assert told == outcome([stream[i : i + 1] for i in range(len(stream))], plain=False)
    assert told == outcome(chunks, plain=True, inlet=True)
    assert told == outcome(whole, plain=True, inlet=True)


async def get(bench: Bench, target: str, method: str = "GET", host: str = "Host: 127.0.0.1") -> tuple[int, str, str]:
    """Returns status, content type and body of a page."""
    peer = await bench.connect(f"{method} {target} HTTP/1.1\r\n{host}\r\n\r\n".encode())
    head, _, body = (await peer.end()).decode().partition("\r\n\r\n")
    headers = dict(line.split(": ", 1) for line in head.splitlines()[1:])
    assert int(headers["Content-Length"]) == len(body)
    return int(head.split()[1]), headers["Content-Type"], body


async def test_pages(bench: Bench) -> None:
    assert await get(bench, "/healthz") == (200, "text/plain; charset=utf-8", "ok\n")
    status, kind, body = await get(bench, "/stats?x=1")
    assert (status, kind, json.loads(body)) == (200, "application/json", {"tick": 7})
    for target, method, expected in (("/", "GET", 426), ("/x", "GET", 404), ("/healthz", "DELETE", 405)):
        status, _, body = await get(bench, target, method)
        assert (status, len(body.splitlines())) == (expected, 1)
    assert bench.notes.opened == []


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("Host: evil.example:8765", 421),
        ("HOST: evil.example", 421),
        ("Host: 127.0.0.1\r\nHost: evil.example", 421),
        ("Host: evil.example\r\nHost: 127.0.0.1", 421),
        ("X-Forwarded-Host: 127.0.0.1\r\nHost: evil.example", 421),
        ("X-Forwarded-Host: evil.example\r\nHost: localhost", 200),
        ("X-No-Browser: 1", 200),
    ],
)
async def test_pages_are_for_the_servers_own_names(bench: Bench, host: str, status: int) -> None:
    assert (await get(bench, "/stats", host=host))[0] == status


@pytest.mark.parametrize(("bytes_per_s", "whole"), [(1 << 20, True), (1 << 40, False)])
async def test_a_slow_reader_of_a_large_page_gets_the_time_for_its_bytes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, bytes_per_s: int, whole: bool
) -> None:
    monkeypatch.setattr(module, "CLOSE_S", 0.05)
    monkeypatch.setattr(module, "SLOWEST_BYTES_PER_S", bytes_per_s)
    bench.large = bytes(range(256)) * (64 << 10)  # more than the buffers of both sockets
    peer = await bench.connect(b"GET /large HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", limit=1 << 10)
    await peer.line()
    await asyncio.sleep(0.2)  # longer than CLOSE_S
    assert (await peer.end() == bench.large) == whole


async def test_stats_that_fail_are_our_mistake(bench: Bench) -> None:
    bench.figures = lambda: {"x": object()}
    assert (await get(bench, "/stats"))[0] == 500
    assert bench.gateway.faults.total == 1


async def test_beyond_the_limits_a_websocket_is_refused_a_page_is_shown_and_a_flood_is_dropped(bench: Bench) -> None:
    limits = Limits(connections_per_address=2, loopback_exempt=False)
    bench.gateway.admission.limits = limits
    one, two = await bench.client(), await bench.client()
    third = await bench.connect(UPGRADE)
    answer = await third.end()
    assert answer.startswith(b"HTTP/1.1 429 ")
    assert b"too many connections from your address (2 are allowed)" in answer
    assert (await get(bench, "/healthz"))[0] == 200
    for peer in bench.peers[2:]:
        peer.reset()
    await soon(lambda: len(bench.gateway.connections) == 2)
    silent = [await bench.connect() for _ in range(SPARE_PER_ADDRESS + 3)]
    async with asyncio.timeout(PATIENCE_S):
        ended = [await peer.end() for peer in silent[SPARE_PER_ADDRESS:]]
    assert ended == [b""] * 3
    assert bench.gateway.admission.refused == {"address": 4}
    one.write(binary(b"echo"))
    assert await one.frame() == (0x82, b"echo")
    two.reset()
    for peer in silent:
        peer.reset()
    await soon(lambda: len(bench.gateway.connections) == 1)
    await bench.client()


async def test_a_browser_of_another_page_is_refused(bench: Bench) -> None:
    peer = await bench.connect(UPGRADE.replace(b"Host: x\r\n", b"Host: x\r\nOrigin: https://evil.example\r\n"))
    assert (await peer.end()).startswith(b"HTTP/1.1 403 ")
    peer = await bench.connect(UPGRADE.replace(b"Host: x\r\n", b"Host: localhost\r\nOrigin: http://localhost\r\n"))
    assert (await peer.line()).startswith(b"HTTP/1.1 101 ")
    assert bench.gateway.admission.refused == {"origin": 1}


async def test_stop_listening_ends_connections_that_are_no_websocket(bench: Bench) -> None:
    good, idle = await bench.client(), await bench.connect(b"GET")
    await soon(lambda: len(bench.gateway.connections) == 2)
    bench.gateway.stop_listening()
    assert await idle.end() == b""
    good.write(binary(b"echo"))
    assert await good.frame() == (0x82, b"echo")
    with pytest.raises(OSError, match=r"."):
        await bench.connect()


async def test_a_busy_port_is_an_os_error(bench: Bench) -> None:
    with pytest.raises(OSError, match=r"in use"):
        await Gateway(bench.notes).listen(*bench.address)
