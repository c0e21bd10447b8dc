"""The addresses that a server listens on, over real loopback sockets."""

import asyncio
import errno
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from server.net import addresses
from server.net.addresses import listeners
from tests.patience import PATIENCE_S

BACKLOG = 8


def has_ipv6() -> bool:
    """Returns whether this machine can use its IPv6 loopback address."""
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="no IPv6")
LACKING = [errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL]


@contextmanager
def closing(sockets: list[socket.socket]) -> Iterator[list[socket.socket]]:
    try:
        yield sockets
    finally:
        for each in sockets:
            each.close()


def takes(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), timeout=PATIENCE_S):
            return True
    except OSError:
        return False


def named(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> None:
    """Makes every host name resolve to these addresses."""

    async def found(host: str | None, port: int, **_: object) -> list[tuple[Any, ...]]:
        def one(address: str) -> tuple[Any, ...]:
            if ":" in address:
                return socket.AF_INET6, socket.SOCK_STREAM, 6, "", (address, port, 0, 0)
            return socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)

        return [one(address) for address in addresses]

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", found)


class Failing:
    """A `socket.create_server` that fails for IPv6 addresses first, with the given errors."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, errors: list[int]) -> None:
        self.errors = errors
        self._real = socket.create_server
        monkeypatch.setattr(socket, "create_server", self)

    def __call__(self, address: tuple[Any, ...], **more: Any) -> socket.socket:
        if self.errors and ":" in address[0]:
            raise OSError(self.errors.pop(), "told to fail")
        return self._real(address, **more)


@needs_ipv6
async def test_every_interface_in_ipv6_takes_ipv4_too() -> None:
    with closing(await listeners("::", 0, BACKLOG)) as sockets:
        port = sockets[0].getsockname()[1]
        assert takes("::1", port)
        assert takes("127.0.0.1", port)


@needs_ipv6
async def test_every_interface_takes_both_where_no_socket_can(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "has_dualstack_ipv6", lambda: False)
    with closing(await listeners("::", 0, BACKLOG)) as sockets:
        assert len(sockets) == 2
        port = sockets[0].getsockname()[1]
        assert takes("::1", port)
        assert takes("127.0.0.1", port)


@pytest.mark.parametrize("number", LACKING)
async def test_every_interface_is_ipv4_alone_where_there_is_no_ipv6(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(socket, "has_dualstack_ipv6", lambda: False)
    Failing(monkeypatch, [number])
    with closing(await listeners("::", 0, BACKLOG)) as sockets:
        assert takes("127.0.0.1", sockets[0].getsockname()[1])


@needs_ipv6
async def test_one_ipv6_address_is_not_ipv4() -> None:
    with closing(await listeners("::1", 0, BACKLOG)) as sockets:
        port = sockets[0].getsockname()[1]
        assert takes("::1", port)
        assert not takes("127.0.0.1", port)


@needs_ipv6
async def test_a_name_with_several_addresses_has_one_port_on_all(monkeypatch: pytest.MonkeyPatch) -> None:
    named(monkeypatch, "127.0.0.1", "::1", "127.0.0.1")
    with closing(await listeners("play.example", 0, BACKLOG)) as sockets:
        assert len(sockets) == 2
        assert len({each.getsockname()[1] for each in sockets}) == 1
        assert all(takes(host, sockets[0].getsockname()[1]) for host in ("127.0.0.1", "::1"))


@needs_ipv6
async def test_another_port_is_picked_where_the_first_is_taken_on_another_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    named(monkeypatch, "127.0.0.1", "::1")
    failing = Failing(monkeypatch, [errno.EADDRINUSE] * 3)
    with closing(await listeners("play.example", 0, BACKLOG)) as sockets:
        assert failing.errors == []
        assert len({each.getsockname()[1] for each in sockets}) == 1
        assert len(sockets) == 2


@needs_ipv6
async def test_the_search_for_a_port_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    named(monkeypatch, "127.0.0.1", "::1")
    Failing(monkeypatch, [errno.EADDRINUSE] * addresses.TRIES)
    with pytest.raises(OSError, match="told to fail"):
        await listeners("play.example", 0, BACKLOG)


@pytest.mark.parametrize("number", LACKING)
async def test_an_address_that_this_system_lacks_is_left_out(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    named(monkeypatch, "::1", "127.0.0.1")
    Failing(monkeypatch, [number, number])
    with closing(await listeners("play.example", 0, BACKLOG)) as sockets:
        assert takes("127.0.0.1", sockets[0].getsockname()[1])
    named(monkeypatch, "::1")
    with pytest.raises(OSError, match="told to fail") as error:
        await listeners("play.example", 0, BACKLOG)
    assert error.value.errno == number


@needs_ipv6
async def test_an_address_that_is_in_use_leaves_none_open(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        named(monkeypatch, "::1", "127.0.0.1")
        with pytest.raises(OSError, match="in use"):
            await listeners("play.example", port, BACKLOG)
        assert not takes("::1", port)
