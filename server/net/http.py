"""The HTTP request that a connection begins with: it opens a WebSocket or asks for a page, as admission decides."""

import time
from collections.abc import Callable
from http import HTTPStatus
from typing import cast

from websockets.datastructures import Headers
from websockets.exceptions import InvalidMessage
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.server import ServerProtocol

from server.net.admission import Admission, Request
from server.observability.pages import Page


def answer_request(
    protocol: ServerProtocol,
    data: bytes,
    admission: Admission,
    address: str,
    route: Callable[[str], Page | None] = lambda target: None,
) -> bytes:
    """Passes data to websockets until the request is complete, and answers it.

    The request is passed on line by line, because websockets would parse the bytes after it before it is answered.

    Args:
        protocol: the protocol of the connection. The answer waits in its `data_to_send`.
        data: bytes of the peer.
        admission: decides about the request.
        address: the peer's address; empty if it is unknown.
        route: called with the target of a request for a WebSocket that admission accepts. Returns the page that refuses
            it; None: the WebSocket opens.

    Returns:
        The bytes after the request.
    """
    start = 0
    while start < len(data):
        end = data.find(b"\n", start) + 1 or len(data)
        protocol.receive_data(data[start:end])
        start = end
        events = protocol.events_received()
        if events:
            _answer(protocol, cast("HttpRequest", events[0]), admission, address, route)
            break
        if isinstance(protocol.handshake_exc, InvalidMessage):  # websockets itself closes without an answer
            response = protocol.reject(HTTPStatus.BAD_REQUEST, "this is not an HTTP request\n")
            protocol.writes.insert(0, response.serialize())
        if protocol.eof_sent:
            break
    return data[start:]


def _answer(
    protocol: ServerProtocol,
    request: HttpRequest,
    admission: Admission,
    address: str,
    route: Callable[[str], Page | None],
) -> None:
    headers = request.headers
    upgrade = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
    origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
    asked = Request(
        request.method,
        request.path,
        " ".join(hosts),
        " ".join(origins) if origins else None,
        upgrade,
        " ".join(headers.get_all("Authorization")),
    )
    page = admission.answer(asked, address, time.monotonic())
    if page is None and upgrade and request.method == "GET":
        page = route(request.path)
    protocol.send_response(protocol.accept(request) if page is None else _response(page))
    if page is not None and page.body:
        protocol.writes.insert(1, page.body)  # after the head, before the end: all connections share these bytes


def _response(page: Page) -> Response:
    """Returns the head of the answer."""
    status = HTTPStatus(page.status)
    fixed = (("Connection", "close"), ("Content-Length", str(len(page.body))), ("Content-Type", page.content_type))
    return Response(status.value, status.phrase, Headers(fixed + page.headers))
