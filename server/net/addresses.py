"""Listening sockets: one for each address of a host, all on the same port.

The sockets are not opened by asyncio's own servers for two reasons: those make every IPv6 socket refuse IPv4, and with
port 0 they get a different port for each address.
"""

import asyncio
import errno
import socket

EVERY_INTERFACE = "::"
"""IPv6 address that stands for all of this machine's addresses."""
TRIES = 16
"""Attempts to find a port that is free on all addresses, if the system picks the port."""
LACKING = (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL)
"""Errors of an address whose family this system does not have, or has switched off."""
_Found = list[tuple[int, tuple[str | int, ...]]]


async def listeners(host: str, port: int, backlog: int) -> list[socket.socket]:
    """Opens a listening socket on each address of a host. An address whose family this system lacks is left out.

    Args:
        host: a host name or an address; empty: every interface. `::` accepts IPv4, too.
        port: the port; 0: the system picks one, the same for all addresses.
        backlog: connections that may wait to be accepted.

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
    """Returns the family and the address, without the port, of each address of a host."""
    loop = asyncio.get_running_loop()
    if host == EVERY_INTERFACE and not socket.has_dualstack_ipv6():
        return [(socket.AF_INET6, ("::",)), (socket.AF_INET, ("0.0.0.0",))]
    found = await loop.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    return [(family, (address[0], *address[2:])) for family, _, _, _, address in dict.fromkeys(found)]


def bracketed(host: str) -> str:
    """Returns a host in the notation of a URL: an IPv6 address gets brackets."""
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
