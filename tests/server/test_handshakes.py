"""TLS over real loopback sockets: a connection counts from before its handshake until its end."""

import asyncio
import socket
import ssl
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
import trustme

from server.config.limits import Limits
from server.net import tls_accept
from server.net.admission import SPARE_PER_ADDRESS, Admission
from server.net.gateway import Gateway
from tests.patience import PATIENCE_S, soon

ALLOWED = 3
ALL = ALLOWED + SPARE_PER_ADDRESS


class Silent:
    """A game in which nothing happens."""

    def open(self, link: object, now: float) -> None: ...

    def receive(self, session: object, data: bytes, now: float) -> None: ...

    def lost(self, session: object, now: float) -> None: ...


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture
def context(authority: trustme.CA) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(context)
    return context


@pytest.fixture
def trust(authority: trustme.CA) -> ssl.SSLContext:
    trust = ssl.create_default_context()
    authority.configure_trust(trust)
    return trust


@pytest_asyncio.fixture
async def gateway() -> AsyncIterator[Gateway]:
    gateway = Gateway(Silent(), Admission(Limits(connections_per_address=ALLOWED, loopback_exempt=False)))
    yield gateway
    gateway.stop_listening()


async def page(address: tuple[str, int], trust: ssl.SSLContext) -> bytes:
    """Returns the first line of the answer to a request."""
    async with asyncio.timeout(PATIENCE_S):
        reader, writer = await asyncio.open_connection(*address, ssl=trust)
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        line = await reader.readline()
        await reader.read()
        writer.close()
    return line


async def test_a_peer_that_only_opens_the_socket_counts_until_it_disconnects(
    gateway: Gateway, context: ssl.SSLContext, trust: ssl.SSLContext
) -> None:
    address = await gateway.listen("127.0.0.1", 0, context)
    silent = [await asyncio.open_connection(*address) for _ in range(ALL + 2)]
    async with asyncio.timeout(PATIENCE_S):
        assert [await reader.read() for reader, _ in silent[ALL:]] == [b""] * 2
    assert gateway.admission.refused == {"address": 2}
    with pytest.raises(ConnectionError):
        await page(address, trust)
    for _, writer in silent:
        writer.close()
    await soon(lambda: gateway.admission.total == 0)
    assert await page(address, trust) == b"HTTP/1.1 200 OK\r\n"
    await soon(lambda: gateway.admission.total == 0)


async def test_a_handshake_has_a_time_limit_and_garbage_ends_it(
    gateway: Gateway, context: ssl.SSLContext, trust: ssl.SSLContext
) -> None:
    gateway.admission.limits = Limits(handshake_s=0.2)
    address = await gateway.listen("127.0.0.1", 0, context)
    peers = [await asyncio.open_connection(*address) for _ in range(4)]
    for (_, writer), first in zip(peers, (b"", b"\x16\x03\x01", b"GET / HTTP/1.1\r\n\r\n", bytes(100)), strict=True):
        writer.write(first)
    async with asyncio.timeout(PATIENCE_S):
        for reader, writer in peers:
            await reader.read()
            writer.close()
    await soon(lambda: gateway.admission.total == 0)
    assert await page(address, trust) == b"HTTP/1.1 200 OK\r\n"


async def test_closing_ends_handshakes(gateway: Gateway, context: ssl.SSLContext) -> None:
    address = await gateway.listen("127.0.0.1", 0, context)
    reader, writer = await asyncio.open_connection(*address)
    await soon(lambda: gateway.admission.total == 1)
    gateway.stop_listening()
    async with asyncio.timeout(PATIENCE_S):
        assert await reader.read() == b""
    writer.close()
    assert gateway.admission.total == 0
    with pytest.raises(ConnectionError):
        await asyncio.open_connection(*address)


async def test_closing_ends_accepted_sockets_whose_handshake_has_not_begun(
    gateway: Gateway, context: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrive, loop = gateway.admission.arrive, asyncio.get_running_loop()

    def arrive_at_the_end(address: str) -> bool:
        loop.call_soon(gateway.stop_listening)
        return arrive(address)

    monkeypatch.setattr(gateway.admission, "arrive", arrive_at_the_end)
    reader, writer = await asyncio.open_connection(*await gateway.listen("127.0.0.1", 0, context))
    async with asyncio.timeout(PATIENCE_S):
        assert await reader.read() == b""
    writer.close()
    assert gateway.admission.total == 0


async def test_many_connections_at_once_are_accepted_one_per_pass_of_the_loop(
    gateway: Gateway, context: ssl.SSLContext
) -> None:
    address = await gateway.listen("127.0.0.1", 0, context)
    peers = [socket.create_connection(address) for _ in range(20)]
    passes = 0
    async with asyncio.timeout(PATIENCE_S):
        while gateway.admission.total + gateway.admission.refused["address"] < len(peers):
            await asyncio.sleep(0)
            passes += 1
    for peer in peers:
        peer.close()
    assert passes >= len(peers)


async def test_an_error_in_accepting_is_reported_and_accepting_goes_on(
    gateway: Gateway, context: ssl.SSLContext, trust: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tls_accept, "AGAIN_S", 0.0)
    loop, told = asyncio.get_running_loop(), list[str]()
    loop.set_exception_handler(lambda _, context: told.append(context["message"]))
    real, failures = loop.sock_accept, [OSError(24, "Too many open files"), ConnectionAbortedError()]

    async def accept(listener: object) -> object:
        if failures:
            raise failures.pop()
        return await real(listener)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "sock_accept", accept)
    address = await gateway.listen("127.0.0.1", 0, context)
    assert await page(address, trust) == b"HTTP/1.1 200 OK\r\n"
    assert told == ["cannot accept a connection"]


async def test_a_busy_port_is_an_os_error(gateway: Gateway, context: ssl.SSLContext) -> None:
    address = await gateway.listen("127.0.0.1", 0, context)
    with pytest.raises(OSError, match=r"in use"):
        await Gateway(Silent()).listen(*address, context)


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6")
async def test_every_interface_is_ipv4_too(gateway: Gateway, context: ssl.SSLContext, trust: ssl.SSLContext) -> None:
    _, port = await gateway.listen("::", 0, context)
    assert await page(("127.0.0.1", port), trust) == b"HTTP/1.1 200 OK\r\n"
