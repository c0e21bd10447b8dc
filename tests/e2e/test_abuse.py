"""Misbehaving peers and a running server: each is closed with a code and a reason, and other clients notice nothing.

`tests/server/test_gateway.py` tests the answers to broken protocols in detail, and `tests/server/test_handshake.py` the
refused messages. Here they meet the whole process, together with one honest client.
"""

import asyncio
import random
import re
import signal
import struct
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from websockets.frames import Frame, Opcode

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot, Wander
from shared.fields import CLIENT_MESSAGE_MAX
from shared.messages import (
    MALFORMED,
    PROTOCOL,
    TEXT,
    TOO_BIG,
    VERSION,
    WRONG_SCENE,
    WRONG_VERSION,
    Bye,
    Command,
    Hello,
    Inputs,
    Ping,
    Pong,
    Welcome,
    decode_from_server,
    encode,
)
from shared.scene import load_scene
from tests.e2e.processes import END_S, UPGRADE, running, stats

pytestmark = pytest.mark.e2e

AT_ONCE = 12
"""Number of peers at a time."""
WELL_FORMED = (
    Hello(VERSION, load_scene("flat").digests, "Ann"),
    Inputs(100, 90, bytes((127, 0, 1)) * 8),
    Command(1, 100, 90.5, "edit", b"\x94\x01\x02\x03\x04"),
    Ping(1.5),
)


class Abuse(NamedTuple):
    """The bytes that a peer sends after the handshake, and the codes and the reason that it may be closed with."""

    stream: bytes
    codes: tuple[int, ...]
    reason: str = "."
    joins: bool = False
    """Whether the peer first joins properly."""


def framed(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin).serialize(mask=True)


def abuses() -> Iterator[Abuse]:
    rng = random.Random(20)
    for _ in range(20):  # random bytes instead of frames, more than one message may have
        yield Abuse(rng.randbytes(9000), (PROTOCOL, TOO_BIG, TEXT, MALFORMED, 1000, 1007))
    for size in (0, 1, 2, 3, 7, 20, 100, 1000, CLIENT_MESSAGE_MAX):  # random bytes in well-formed frames
        for joins in (False, True):
            yield Abuse(framed(rng.randbytes(size)), (MALFORMED,), joins=joins)
    for message in WELL_FORMED:
        whole = encode(message)
        for size in {*range(min(12, len(whole))), len(whole) // 2, len(whole) - 1}:
            yield Abuse(framed(whole[:size]), (MALFORMED,), joins=size % 2 == 0)
        yield Abuse(framed(whole + b"\0"), (MALFORMED,))
    yield Abuse(framed(bytes(CLIENT_MESSAGE_MAX + 1)), (TOO_BIG,), "8193")
    yield Abuse(b"\x82\xff" + (1 << 62).to_bytes(8, "big") + bytes(4), (TOO_BIG,))
    yield Abuse(framed(bytes(5000), fin=False) + framed(bytes(5000), Opcode.CONT), (TOO_BIG,))
    yield Abuse(framed(b"hello", Opcode.TEXT), (TEXT,), "binary")
    yield Abuse(framed(b"hello", Opcode.TEXT), (TEXT,), "binary", joins=True)
    for version in (0, VERSION + 1, 1 << 40):
        yield Abuse(framed(encode(Hello(version, {}, "x"))), (WRONG_VERSION, MALFORMED), "ersion")
    other = load_scene("arena").digests
    yield Abuse(framed(encode(Hello(VERSION, other, "x"))), (WRONG_SCENE,), "terrain")
    yield Abuse(framed(encode(Hello(VERSION, {"gravity": b"?"}, "x"))), (WRONG_SCENE,), "gravity")
    for message in WELL_FORMED:
        unmasked = Frame(Opcode.BINARY, encode(message)).serialize(mask=False)
        yield Abuse(unmasked, (PROTOCOL,), "mask", joins=True)
    yield Abuse(framed(encode(Welcome(VERSION, 1, 1, {}))), (MALFORMED,))
    yield Abuse(framed(encode(Pong(1.0, 2.0))), (MALFORMED,))
    yield Abuse(framed(encode(WELL_FORMED[1])), (MALFORMED,), "unexpected Inputs before the join")
    yield Abuse(framed(encode(WELL_FORMED[0])), (MALFORMED,), "unexpected Hello after the join", joins=True)
    yield Abuse(framed(encode(Ping(1.0))) * 2000, (MALFORMED,), "too many messages", joins=True)


class Peer:
    """A raw socket after the handshake."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self.writer = reader, writer

    async def frame(self) -> tuple[int, bytes]:
        first, size = await self._reader.readexactly(2)
        if size >= 126:
            size = int.from_bytes(await self._reader.readexactly(2 if size == 126 else 8), "big")
        return first & 15, await self._reader.readexactly(size)


async def misbehave(address: tuple[str, int], abuse: Abuse) -> None:
    """Runs one abuse, and checks the answer."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        peer = Peer(reader, writer)
        writer.write(UPGRADE)
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101 ")
        if abuse.joins:
            writer.write(framed(encode(Hello(VERSION, {}, "rogue"))))
            await peer.frame()
        writer.write(abuse.stream)
        last = b""
        while True:
            opcode, data = await peer.frame()
            if opcode == Opcode.CLOSE:
                break
            last = data
        code, reason = struct.unpack("!H", data[:2])[0], data[2:].decode()
        shown = (abuse.stream[:40], code, reason)
        assert code in abuse.codes, shown
        assert re.search(abuse.reason, reason), shown
        if code > 4000:  # the game's own refusals are also sent as a message, which has room for a longer reason
            bye = decode_from_server(last)
            assert isinstance(bye, Bye)
            assert (bye.code, bye.wait) == (code, -1.0)
            assert bye.reason.startswith(reason[:100])
    finally:
        writer.transport.abort()


async def storm(address: tuple[str, int], all_of: list[Abuse]) -> tuple[int, int]:
    """Runs all abuses beside one honest client. Returns the number of ticks, and of snapshots that the client has
    got."""
    bot = Bot(Wander(random.Random(1)))
    async with await AsyncClient.connect("ws://{}:{}".format(*address), before_update=bot) as honest:
        while honest.core.state != "playing":  # noqa: ASYNC110  # there is no event for it but those nobody reads
            await asyncio.sleep(0.01)
        prediction = honest.core.prediction
        assert prediction is not None
        tick, snapshots = prediction.confirmed.tick, honest.stats.snapshots
        for at in range(0, len(all_of), AT_ONCE):
            async with asyncio.timeout(END_S):
                await asyncio.gather(*(misbehave(address, abuse) for abuse in all_of[at : at + AT_ONCE]))
        while prediction.confirmed.tick < tick + 32:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert honest.core.state == "playing"
        assert honest.stats.divergences == 0
        assert "nondeterminism" not in honest.stats.corrections_by_cause
        return prediction.confirmed.tick - tick, honest.stats.snapshots - snapshots


def test_each_peer_gets_the_reason_and_other_clients_notice_nothing() -> None:
    all_of = list(abuses())
    random.Random(3).shuffle(all_of)
    with running("--port", "0", "--scene", "flat") as server:
        address = server.address()
        ticks, snapshots = asyncio.run(asyncio.wait_for(storm(address, all_of), 60))
        assert snapshots >= 0.9 * ticks
        figures = stats(address)
        assert figures["internal_errors"] == figures["ticks_failed"] == 0
        assert figures["skipped_s"] < 1, "ticks went on"
        assert figures["malformed"] > 50
        assert figures["refused"] >= 4
        assert server.end(signal.SIGTERM) == 0
        assert server.log(but="info") == []
