"""Who may come in: the decisions on connections that a gateway asks for before there is a player.

A gateway tells `arrive` of each connection, asks `answer` what to do with its request, and tells `leave` when it is
gone. A request for a WebSocket that is refused gets an HTTP status and a reason; nothing has been set up for it by
then. Pages are answered even when the server is full, so that whoever watches it does not take it for dead: `SPARE`
connections beyond the limits get that far, and those beyond them are dropped without a word.

A page in a browser may come from a name that somebody else has pointed at this machine (DNS rebinding); the browser
then lets that page read what this server answers. So a request for a page is refused if it calls the server by a name
that is not its own. A request for a WebSocket is judged by its origin: clients that are no browsers send none.
"""

import math
import re
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus
from typing import NamedTuple

from server.config.hosts import ANY, NO_ADDRESS, is_loopback, network_of, parsed
from server.config.limits import Limits
from server.observability.pages import Page, Pages, line

SPARE = 32
"""Connections beyond the limit in total that are answered,"""
SPARE_PER_ADDRESS = 4
"""and of one address."""
BURST_S = 2.0
RETRY_S = "2"
NOT_OWN = "is not a name of this server; its operator can add it to allowed_hosts"
HOST = re.compile(r"(?:\[([^]]*)\]|([^]:%[]*))(?::\d*)?")
"""The header `Host`: an IPv6 address in brackets, or a name or IPv4 address; and a port."""


class Request(NamedTuple):
    """What matters of an HTTP request.

    `host` is the header, empty if there is none; `upgrade`: the request asks for a WebSocket.
    """

    method: str
    target: str
    host: str
    origin: str | None
    upgrade: bool


class Door:
    """Counts connections, and answers requests.

    Args:
        figures: whose addresses may see the private pages: none, loopback, private or all.
        origins: see `Settings.allowed_origins`.
        hosts: names by which a page may be asked for; see `Settings.allowed_hosts`.
        closing: the seconds after which to come back once the server is going down; None while it is not.
    """

    def __init__(
        self,
        limits: Limits | None = None,
        pages: Pages | None = None,
        *,
        figures: str = "private",
        origins: tuple[str, ...] = (),
        hosts: tuple[str, ...] = (),
        closing: Callable[[], float | None] = lambda: None,
    ) -> None:
        self.limits = limits or Limits()
        self.refused: Counter[str] = Counter()
        """Connections and requests that were refused, by reason."""
        self._pages = pages or Pages()
        self._figures = figures
        self._origins = frozenset(origin.rstrip("/").lower() for origin in origins)
        self._hosts = frozenset(host.removesuffix(".").lower() for host in hosts)
        self._closing = closing
        self.total = 0
        """Connections that have come and not gone."""
        self._by_network: Counter[str] = Counter()
        self._joins = math.inf  # that is: the whole burst
        self._joins_at = 0.0

    def arrive(self, address: str) -> bool:
        """A connection has come from an address; if False, drop it at once (and do not call `leave`)."""
        limits, network = self.limits, network_of(address)
        if self.total >= limits.connections_max + SPARE:
            self.refused["connections"] += 1
            return False
        if self._limited(address) and self._by_network[network] >= limits.connections_per_address + SPARE_PER_ADDRESS:
            self.refused["address"] += 1
            return False
        self.total += 1
        self._by_network[network] += 1
        return True

    def leave(self, address: str) -> None:
        """A connection that had arrived is gone."""
        network = network_of(address)
        self.total -= 1
        self._by_network[network] -= 1
        if not self._by_network[network]:
            del self._by_network[network]

    def answer(self, request: Request, address: str, now: float) -> Page | None:
        """What to answer to a request; None: let it have its WebSocket."""
        if not request.upgrade:
            if request.host and ANY not in self._hosts and not self._own(request.host):
                self.refused["host"] += 1
                return line(HTTPStatus.MISDIRECTED_REQUEST, f"{request.host[:100]!r} {NOT_OWN}")
            return self._pages.get(request.method, request.target, trusted=self.trusted(address))
        reason, page = self._refusal(request, address, now)
        if page is not None:
            self.refused[reason] += 1
        return page

    def _refusal(self, request: Request, address: str, now: float) -> tuple[str, Page | None]:
        limits, wait = self.limits, self._closing()
        if wait is not None:
            retry = str(max(1, round(wait)))
            return "closing", line(HTTPStatus.SERVICE_UNAVAILABLE, "the server is going down", retry_after=retry)
        if not self._welcome(request):
            return "origin", line(HTTPStatus.FORBIDDEN, f"not from pages of {str(request.origin)[:100]}")
        if self.total > limits.connections_max:
            reason = f"the server is full ({limits.connections_max} connections)"
            return "connections", line(HTTPStatus.SERVICE_UNAVAILABLE, reason, retry_after=RETRY_S)
        if self._limited(address):
            if self._by_network[network_of(address)] > limits.connections_per_address:
                reason = f"too many connections from your address ({limits.connections_per_address} are allowed)"
                return "address", line(HTTPStatus.TOO_MANY_REQUESTS, reason, retry_after=RETRY_S)
            if not self._take_join(now):
                reason = f"too many are joining right now ({limits.joins_per_s:g} per second are allowed)"
                return "joins", line(HTTPStatus.SERVICE_UNAVAILABLE, reason, retry_after=RETRY_S)
        return "", None

    def _take_join(self, now: float) -> bool:
        rate = self.limits.joins_per_s
        self._joins = min(self._joins + (now - self._joins_at) * rate, max(1.0, BURST_S * rate))
        self._joins_at = now
        if self._joins < 1:
            return False
        self._joins -= 1
        return True

    def _welcome(self, request: Request) -> bool:
        """Whether the origin, which only browsers send, is an allowed one or a page of this server itself."""
        if request.origin is None or ANY in self._origins:
            return True
        origin, host = request.origin.lower(), request.host.lower()
        return origin in self._origins or (self._own(host) and origin.partition("://")[2] == host)

    def _own(self, host: str) -> bool:
        """Whether the header `Host`, with or without a port, is an IP address, localhost or a name of this server."""
        found = HOST.fullmatch(host)
        if found is None:
            return False
        name = (found[2] or "").removesuffix(".").lower()
        return name == "localhost" or name in self._hosts or parsed(found[1] or found[2] or "") != NO_ADDRESS

    def _limited(self, address: str) -> bool:
        return not (self.limits.loopback_exempt and is_loopback(address))

    def trusted(self, address: str) -> bool:
        """Whether an address may see the private pages."""
        match self._figures:
            case "all":
                return True
            case "private":
                return parsed(address).is_private
            case "loopback":
                return is_loopback(address)
            case _:
                return False
