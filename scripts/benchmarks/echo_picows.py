"""The server of `_busy_server.py echo` on picows instead of the product's gateway: the bound of another library.

_echo_picows.py SCENE BYTES

picows parses, answers and writes in C, with a direct `send` while no data waits. This server has no flow control, no
admission and no limits, so it shows the most that a gateway built on picows could gain.
"""

import asyncio
import json
import sys
import time
from http import HTTPStatus
from typing import Any

from multidict import CIMultiDict
from picows import (
    WSFrame,
    WSListener,
    WSMsgType,
    WSTransport,
    WSUpgradeRequest,
    WSUpgradeResponse,
    WSUpgradeResponseWithListener,
    ws_create_server,
)

from scripts.benchmarks.busy_server import Echo
from server.runtime import event_loop
from server.runtime.alarm import best_alarm
from server.runtime.ticker import Ticker

BINARY = WSMsgType.BINARY


class Listener(WSListener):
    """A connection, which is also the link on which `Echo` sends."""

    def __init__(self, echo: Echo) -> None:
        super().__init__()
        self._echo = echo

    def on_ws_connected(self, transport: WSTransport) -> None:
        self._transport = transport
        self._session = self._echo.open(self, time.monotonic())

    def on_ws_frame(self, transport: WSTransport, frame: WSFrame) -> None:
        if frame.msg_type == BINARY:
            self._echo.receive(self._session, frame.get_payload_as_bytes(), time.monotonic())

    def on_ws_disconnected(self, transport: WSTransport) -> None:
        self._echo.lost(self._session, time.monotonic())

    def send(self, message: bytes) -> None:
        self._transport.send(BINARY, message)

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        self._transport.disconnect()


async def serve(echo: Echo) -> None:
    """Serves until the process is killed."""
    loop, started = asyncio.get_running_loop(), time.monotonic()
    ticker = Ticker(echo.scene.tick_rate, echo.tick, loop.stop, lambda ring: best_alarm(loop, ring))

    def page() -> WSUpgradeResponseWithListener:
        clocks = {"uptime_s": time.monotonic() - started, "cpu_s": time.process_time(), "rss_mb": event_loop.rss_mb()}
        figures: dict[str, Any] = echo.stats() | ticker.stats() | clocks
        response = WSUpgradeResponse()
        response.version, response.status, response.headers = b"HTTP/1.1", HTTPStatus.OK, CIMultiDict()
        response.body = json.dumps(figures).encode()
        return WSUpgradeResponseWithListener(response, None)

    def accept(request: WSUpgradeRequest) -> Listener | WSUpgradeResponseWithListener:
        return Listener(echo) if "upgrade" in request.headers else page()

    server = await ws_create_server(accept, "127.0.0.1", 0)
    event_loop.freeze()
    print(f"listening on ws://127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    await server.serve_forever()


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=event_loop.loop_factory()) as runner:
        runner.run(serve(Echo(sys.argv[1], int(sys.argv[2]))))
