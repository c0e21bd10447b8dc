"""Admission: decides which connections and HTTP requests are accepted, before there is a player.

The gateway calls `arrive` for each connection, `answer` for its request, and `leave` when the connection is gone. A
refused request for a WebSocket gets an HTTP status and a reason; at that point no WebSocket has been set up. Pages are
served even if the server is full, so that monitoring does not take it for dead: `SPARE` connections beyond the limits
are accepted for them. Connections beyond these are dropped without an answer.

A page in a browser may come from a foreign host name that points at this machine (DNS rebinding). The browser would let
that page read the answers of this server. Therefore a request for a page is refused if its `Host` is not a name of this
server. A request for a WebSocket is checked by its `Origin`, which only browsers send.
"""

import re
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus
from typing import NamedTuple

from server.bucket import Bucket
from server.config.hosts import ANY, NO_ADDRESS, is_loopback, network_of, parsed
from server.config.limits import Limits
from server.observability.pages import Page, Pages, line

SPARE = 32
"""Connections beyond `Limits.connections_max` that are accepted to serve pages."""
SPARE_PER_ADDRESS = 4
"""Connections beyond `Limits.connections_per_address` that are accepted to serve pages."""
BURST_S = 2.0
"""Seconds whose allowed joins may happen at once."""
RETRY_S = "2"
"""Value of the header Retry-After in seconds, for clients that are refused because of a limit."""
NOT_OWN = "is not a name of this server; its operator can add it to allowed_hosts"
"""End of the answer to a request with a foreign host name."""
HOST = re.compile(r"(?:\[([^]]*)\]|([^]:%[]*))(?::\d*)?")
"""Pattern of the header `Host`: an IPv6 address in brackets, or a name or IPv4 address; then perhaps a port."""


class Request(NamedTuple):
    """The parts of an HTTP request that matter for admission.

    `target` is path and query. `host` is the header `Host`, empty if there is none. `origin` is the header `Origin`,
    None if there is none. `upgrade` says whether the request asks for a WebSocket. `authorization` is the header
    `Authorization`, empty if there is none.
    """

    method: str
    target: str
    host: str
    origin: str | None
    upgrade: bool
    authorization: str = ""


class Admission:
    """The admission control of one server: counts connections, and answers requests.

    Args:
        limits: the limits; None: the default ones.
        pages: the pages to serve; None: only `/` and `/healthz`.
        figures: addresses that may see the private pages: none, loopback, private or all.
        origins: origins of web pages that may open a WebSocket, as in `Settings.allowed_origins`.
        hosts: host names under which pages are served, as in `Settings.allowed_hosts`.
        closing: returns the seconds after which clients should reconnect if the server is going down, otherwise None.
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
        """Number of present connections."""
        self._by_network: Counter[str] = Counter()
        rate = self.limits.joins_per_s
        self._joins = Bucket(rate, max(1.0, BURST_S * rate))

    def arrive(self, address: str) -> bool:
        """Counts a new connection. Returns False if it is to be dropped at once; then `leave` must not be called."""
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
        """Counts the end of a connection for which `arrive` returned True."""
        network = network_of(address)
        self.total -= 1
        self._by_network[network] -= 1
        if not self._by_network[network]:
            del self._by_network[network]

    def answer(self, request: Request, address: str, now: float) -> Page | None:
        """Returns the page that answers a request; None: the request may open its WebSocket.

        Args:
            request: the request.
            address: the peer's address.
            now: the current time in seconds.
        """
        if not request.upgrade:
            if request.host and ANY not in self._hosts and not self._own(request.host):
                self.refused["host"] += 1
                return line(HTTPStatus.MISDIRECTED_REQUEST, f"{request.host[:100]!r} {NOT_OWN}")
            trusted = self.trusted(address)
            return self._pages.get(request.method, request.target, trusted=trusted, authorization=request.authorization)
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
            reason = f"web pages of {str(request.origin)[:100]} may not connect; see allowed_origins"
            return "origin", line(HTTPStatus.FORBIDDEN, reason)
        if self.total > limits.connections_max:
            reason = f"the server is full ({limits.connections_max} connections)"
            return "connections", line(HTTPStatus.SERVICE_UNAVAILABLE, reason, retry_after=RETRY_S)
        if self._limited(address):
            if self._by_network[network_of(address)] > limits.connections_per_address:
                reason = f"too many connections from your address ({limits.connections_per_address} are allowed)"
                return "address", line(HTTPStatus.TOO_MANY_REQUESTS, reason, retry_after=RETRY_S)
            if not self._joins.take(now):
                reason = f"too many are joining right now ({limits.joins_per_s:g} per second are allowed)"
                return "joins", line(HTTPStatus.SERVICE_UNAVAILABLE, reason, retry_after=RETRY_S)
        return "", None

    def _welcome(self, request: Request) -> bool:
        """Returns whether the origin is allowed: none (not a browser), an allowed one, or a page of this server."""
        if request.origin is None or ANY in self._origins:
            return True
        origin, host = request.origin.lower(), request.host.lower()
        return origin in self._origins or (self._own(host) and origin.partition("://")[2] == host)

    def _own(self, host: str) -> bool:
        """Returns whether a header `Host` names this server: by an IP address, localhost or one of its names."""
        found = HOST.fullmatch(host)
        if found is None:
            return False
        name = (found[2] or "").removesuffix(".").lower()
        return name == "localhost" or name in self._hosts or parsed(found[1] or found[2] or "") != NO_ADDRESS

    def _limited(self, address: str) -> bool:
        return not (self.limits.loopback_exempt and is_loopback(address))

    def trusted(self, address: str) -> bool:
        """Returns whether an address may see the private pages."""
        match self._figures:
            case "all":
                return True
            case "private":
                return parsed(address).is_private
            case "loopback":
                return is_loopback(address)
            case _:
                return False
