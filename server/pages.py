"""What the server's port answers to HTTP requests that ask for no WebSocket."""

import json
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, NamedTuple

TEXT = "text/plain; charset=utf-8"
JSON = "application/json"


class Page(NamedTuple):
    """An HTTP answer, after which the connection closes."""

    status: int
    body: bytes
    content_type: str = TEXT
    headers: tuple[tuple[str, str], ...] = ()


def line(status: int, text: str, **headers: str) -> Page:
    """One line of text; `retry_after` stands for the header Retry-After."""
    named = ((name.replace("_", "-").title(), value) for name, value in headers.items())
    return Page(status, f"{text}\n".encode(), headers=tuple(named))


def json_page(figures: Callable[[], Mapping[str, Any]]) -> Callable[[], Page]:
    """A page that shows figures, which are asked for when it is."""
    return lambda: Page(HTTPStatus.OK, json.dumps(figures()).encode() + b"\n", JSON)


def ready_page(reason: Callable[[], str]) -> Callable[[], Page]:
    """200 while there is no reason not to send players here, else 503 with the reason."""

    def page() -> Page:
        why = reason()
        return line(HTTPStatus.SERVICE_UNAVAILABLE, f"not ready: {why}") if why else line(HTTPStatus.OK, "ready")

    return page


HEALTHY = line(HTTPStatus.OK, "ok")
BROKEN = line(HTTPStatus.INTERNAL_SERVER_ERROR, "internal error")
NO_GET = line(HTTPStatus.METHOD_NOT_ALLOWED, "GET is all there is", allow="GET")
GAME = line(HTTPStatus.UPGRADE_REQUIRED, "this is a game server: connect by WebSocket", upgrade="websocket")


class Pages:
    """The pages by their paths.

    Args:
        public: for everyone; `/` and `/healthz` are there anyway.
        private: only for those whom the door lets see them, and ahead of the public ones.
        failed: told which page has raised.
    """

    def __init__(
        self,
        public: Mapping[str, Callable[[], Page]] | None = None,
        private: Mapping[str, Callable[[], Page]] | None = None,
        failed: Callable[[str], None] = lambda path: None,
    ) -> None:
        self._public = {"/": lambda: GAME, "/healthz": lambda: HEALTHY, **(public or {})}
        self._private = private or {}
        self._failed = failed

    def get(self, method: str, target: str, *, trusted: bool) -> Page:
        """The answer to a request; never raises."""
        path = target.partition("?")[0]
        make = (self._private.get(path) if trusted else None) or self._public.get(path)
        if method != "GET":
            return NO_GET
        if make is None and path in self._private:
            return line(HTTPStatus.FORBIDDEN, f"{path}: not for your address")
        if make is None:
            return line(HTTPStatus.NOT_FOUND, f"{path}: no such page")
        try:
            return make()
        except Exception:
            self._failed(path)
            return BROKEN
