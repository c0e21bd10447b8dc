"""The proxy keeps its promises, with limits that hold on a busy machine, too."""

import asyncio
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest

from client_sdk.netsim.links import Link
from tests.proxy import Proxy

pytestmark = pytest.mark.e2e
SECONDS = 10.0
Ends = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def connected(path: Link) -> AsyncIterator[tuple[Proxy, Ends, Ends]]:
    """Yields a proxy and the two ends of a connection through it: the client's and the server's."""
    ends: asyncio.Queue[Ends] = asyncio.Queue()
    server = await asyncio.start_server(lambda *end: ends.put_nowait(end), "127.0.0.1", 0)
    async with asyncio.timeout(SECONDS), server, Proxy(server.sockets[0].getsockname(), path) as proxy:
        here = await asyncio.open_connection("127.0.0.1", int(proxy.url.rpartition(":")[2]))
        there = await ends.get()
        try:
            yield proxy, here, there
        finally:
            for _, writer in (here, there):
                writer.transport.abort()


async def test_bytes_arrive_in_order_and_no_earlier_than_they_can() -> None:
    sent = bytes(range(256)) * 100
    async with connected(Link(0.05, 0.03, 0.05)) as (_, (_, writer), (reader, _)):
        began = time.monotonic()
        for at in range(0, len(sent), 1000):
            writer.write(sent[at : at + 1000])
        writer.write_eof()
        assert await reader.readexactly(1) == sent[:1]
        assert time.monotonic() - began >= 0.05
        assert await reader.read(-1) == sent[1:]


async def test_both_ways_and_both_ends() -> None:
    sent = bytes(range(256)) * 50
    async with connected(Link(0.01, 0.01)) as (_, (reader, writer), (far_reader, far_writer)):
        writer.write(sent)
        writer.write_eof()
        assert await far_reader.read(-1) == sent
        far_writer.write(sent[::-1])
        far_writer.write_eof()
        assert await reader.read(-1) == sent[::-1]


async def test_a_narrow_line_takes_its_time_and_holds_the_sender_up() -> None:
    async with connected(Link(0.0, rate=160e3)) as (_, (_, writer), (reader, _)):
        began = time.monotonic()
        writer.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        writer.write(bytes(20_000))
        await reader.readexactly(1)
        waiting = writer.transport.get_write_buffer_size()
        assert waiting > 5_000, "the rest still waits at its sender"
        await reader.readexactly(19_999)
        assert time.monotonic() - began >= 0.95 * 8 * 20_000 / 160e3


async def test_a_stall_holds_everything_until_it_is_over() -> None:
    async with connected(Link()) as (proxy, (reader, writer), (_, far_writer)):
        proxy.stall()
        writer.write(b"a")
        far_writer.write(b"b")
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(reader.read(1), 0.1)
        proxy.flow()
        assert await reader.read(1) == b"b"


async def test_an_outage_of_the_path_is_over_in_time() -> None:
    async with connected(Link(outage=(0.6, 0.3))) as (proxy, (_, writer), (reader, _)):
        await asyncio.sleep(0.35 - proxy.now)
        writer.write(b"a")
        assert await reader.read(1) == b"a"
        assert proxy.now >= 0.6


async def test_a_cut_is_noticed_at_both_ends() -> None:
    async with connected(Link(0.01)) as (proxy, (reader, writer), (far_reader, _)):
        writer.write(b"a")
        assert await far_reader.read(1) == b"a"
        await proxy.cut()
        for end in (reader, far_reader):
            with suppress(ConnectionError):
                assert await end.read(1) == b""
