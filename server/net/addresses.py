"""Listening sockets: one for each address of a host, all on one port.

asyncio's own servers make every IPv6 socket refuse IPv4, and give each address of a host a port of its own where the
system picks it. So the sockets are opened here.
"""

import asyncio
import errno
import socket

EVERY_INTERFACE = "::"
"""The IPv6 address that stands for all of this machine's addresses."""
TRIES = 16
"""Attempts to find a port that is free on all addresses, where the system picks the port."""
LACKING = (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL)
"""Errors of an address whose family this system does not have, or has switched off."""
_Found = list[tuple[int, tuple[str | int, ...]]]


async def listeners(host: str, port: int, backlog: int) -> list[socket.socket]:
    """Opens a listening socket on each address of a host (empty: every interface).

    `::` takes IPv4 as well. An address whose family this system lacks is left out. With port 0 the system picks one
    port for all.

    Raises:
        OSError: no address can be used, or one of them is in use.
    """
    found = await _addresses(host)
    for attempt in range(TRIES):
        try:
            return _opened(found, port, backlog)
        except OSError as error:
            if port or error.errno != errno.EADDRINUSE or attempt == TRIES - 1:
                raise
    raise AssertionError("the last attempt returns or raises")


async def _addresses(host: str) -> _Found:
    """Family and address of each, without the port."""
    loop = asyncio.get_running_loop()
    if host == EVERY_INTERFACE and not socket.has_dualstack_ipv6():
        return [(socket.AF_INET6, ("::",)), (socket.AF_INET, ("0.0.0.0",))]
    found = await loop.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    return [(family, (address[0], *address[2:])) for family, _, _, _, address in dict.fromkeys(found)]


def bracketed(host: str) -> str:
    """A host as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


def reachable(host: str) -> str:
    """Returns the host by which this machine itself reaches a server that listens on a host."""
    return "127.0.0.1" if host in (EVERY_INTERFACE, "0.0.0.0") else host


def _opened(found: _Found, port: int, backlog: int) -> list[socket.socket]:
    opened: list[socket.socket] = []
    lacking: OSError | None = None
    try:
        for family, (host, *more) in found:
            both = host == EVERY_INTERFACE and len(found) == 1
            try:
                made = socket.create_server((host, port, *more), family=family, backlog=backlog, dualstack_ipv6=both)
            except OSError as error:
                if error.errno not in LACKING:
                    raise
                lacking = error
                continue
            made.setblocking(False)
            opened.append(made)
            port = port or made.getsockname()[1]
    except BaseException:
        for each in opened:
            each.close()
        raise
    if not opened:
        raise lacking or OSError(errno.EADDRNOTAVAIL, "no address")
    return opened
