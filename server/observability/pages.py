"""The pages on the server's port: answers to HTTP requests that do not open a WebSocket."""

import json
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, NamedTuple

TEXT = "text/plain; charset=utf-8"
"""Content type of a plain text."""
JSON = "application/json"
"""Content type of JSON."""


class Page(NamedTuple):
    """An HTTP response. The connection closes after it."""

    status: int
    body: bytes
    content_type: str = TEXT
    headers: tuple[tuple[str, str], ...] = ()


class PageRequest(NamedTuple):
    """A request for a page: its parts, and whether its client may see private pages.

    `query` is the part of the target behind `?`. `authorization` is the header `Authorization`, empty if there is none.
    """

    method: str
    path: str
    query: str
    trusted: bool
    authorization: str


def line(status: int, text: str, **headers: str) -> Page:
    """Returns a page with one line of text.

    Args:
        status: the HTTP status.
        text: the line.
        headers: further headers, such as `retry_after` for Retry-After.
    """
    named = ((name.replace("_", "-").title(), value) for name, value in headers.items())
    return Page(status, f"{text}\n".encode(), headers=tuple(named))


def json_page(figures: Callable[[], Mapping[str, Any]]) -> Callable[[], Page]:
    """Returns a function that makes a page with figures as JSON. `figures` is called for each request."""
    return lambda: Page(HTTPStatus.OK, json.dumps(figures()).encode() + b"\n", JSON)


def ready_page(reason: Callable[[], str]) -> Callable[[], Page]:
    """Returns a function that makes the page `/readyz`: status 200 if the server is ready, otherwise 503.

    Args:
        reason: returns why the server is not ready; empty if it is ready.
    """

    def page() -> Page:
        why = reason()
        return line(HTTPStatus.SERVICE_UNAVAILABLE, f"not ready: {why}") if why else line(HTTPStatus.OK, "ready")

    return page


HEALTHY = line(HTTPStatus.OK, "ok")
BROKEN = line(HTTPStatus.INTERNAL_SERVER_ERROR, "internal error")
NO_GET = line(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is allowed", allow="GET")
GAME = line(HTTPStatus.UPGRADE_REQUIRED, "this is a game server: connect by WebSocket", upgrade="websocket")


class Pages:
    """All pages of a server, by path.

    Args:
        public: functions that make the pages for every client, by path. `/` and `/healthz` exist besides.
        private: functions that make the pages for trusted clients, by path. They take precedence over public ones.
        failed: called with the path of a page whose function has raised.
        more: makes the pages whose paths come and go, and answers other methods than GET. It is asked first; None: this
            request is not for it.
    """

    def __init__(
        self,
        public: Mapping[str, Callable[[], Page]] | None = None,
        private: Mapping[str, Callable[[], Page]] | None = None,
        failed: Callable[[str], None] = lambda path: None,
        more: Callable[[PageRequest], Page | None] | None = None,
    ) -> None:
        self._public = {"/": lambda: GAME, "/healthz": lambda: HEALTHY, **(public or {})}
        self._private = private or {}
        self._failed = failed
        self._more = more

    def get(self, method: str, target: str, *, trusted: bool, authorization: str = "") -> Page:
        """Returns the answer to a request. Never raises.

        Args:
            method: the HTTP method.
            target: the request target: path and query.
            trusted: whether the client may see private pages.
            authorization: the header `Authorization`; empty if there is none.
        """
        path, _, query = target.partition("?")
        try:
            if self._more is not None:
                page = self._more(PageRequest(method, path, query, trusted, authorization))
                if page is not None:
                    return page
            return self._get(method, path, trusted)
        except Exception:
            self._failed(path)
            return BROKEN

    def _get(self, method: str, path: str, trusted: bool) -> Page:
        make = (self._private.get(path) if trusted else None) or self._public.get(path)
        if method != "GET":
            return NO_GET
        if make is None and path in self._private:
            return line(HTTPStatus.FORBIDDEN, f"{path}: not allowed for your address")
        if make is None:
            return line(HTTPStatus.NOT_FOUND, f"{path}: no such page")
        return make()
