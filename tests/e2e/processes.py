"""A real server process under test: its output, its pages and its end."""

import json
import math
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from client_sdk.client import Client
from client_sdk.events import Event
from server.runtime.event_loop import COMPILING
from shared.checks import Vec
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
START_S = 400.0
"""Seconds until a server is ready. Compiling the kernel for the first time takes long."""
END_S = PATIENCE_S
BUSY = re.compile("stalled|suspended|goes on|took longer than the time between two")
"""Events of the watchdog and of ticks that took long, which also a machine causes that is busy with other work."""
RECOVERY_S = 2.0
"""Seconds within which a player moves again after a stall or a reconnect."""
MOVING_BLOCKS = 1.0
"""Distance that a walking player covers at least in two seconds on a busy machine; normally it is 6 blocks."""
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


class ServerProcess:
    """A process of `python -m server` whose two output streams are read by threads."""

    def __init__(self, *arguments: str, **environment: str) -> None:
        clean = {name: value for name, value in os.environ.items() if not name.startswith("SOVEREIGN_")}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "server", *arguments],
            cwd=ROOT,
            env=clean | {"SOVEREIGN_LOG_FORMAT": "json"} | environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.out: queue.Queue[str | None] = queue.Queue()
        self.errors: list[str] = []
        self._readers = [
            threading.Thread(target=self._read_out, daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read_out(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.out.put(line)
        self.out.put(None)

    def _read_errors(self) -> None:
        assert self.process.stderr is not None
        self.errors.extend(self.process.stderr)

    def address(self) -> tuple[str, int]:
        """Waits until the server is ready. Returns its host and port."""
        line = self.out.get(timeout=START_S)
        found = re.fullmatch(r"listening on wss?://(\[[^]]+\]|[^:]+):(\d+)\n", line or "")
        assert found, (line, self.errors)
        return found[1].strip("[]"), int(found[2])

    def end(self, number: int | None = None) -> int:
        """Waits for the end, after a signal if one is given. Returns the exit code; both streams have been read to the
        end."""
        if number is not None:
            self.process.send_signal(number)
        code = self.process.wait(END_S if number is not None else START_S)
        for reader in self._readers:
            reader.join(END_S)
        return code

    def log(self, *, but: str = "", busy: bool = False) -> list[dict[str, Any]]:
        """Returns the log so far without the notice about compiling.

        Args:
            but: level of entries that are left out.
            busy: whether it has the entries of the watchdog, too.
        """
        entries = [json.loads(line) for line in self.errors]
        return [
            entry
            for entry in entries
            if entry["level"] != but and entry["event"] != COMPILING and (busy or not BUSY.search(entry["event"]))
        ]

    def rest(self) -> list[str]:
        """Waits for the end of stdout. Returns the lines that have not been read yet."""
        lines = []
        while (line := self.out.get(timeout=END_S)) is not None:
            lines.append(line)
        return lines

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.end()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


@contextmanager
def inheriting(handler: signal.Handlers, *signals: int) -> Iterator[None]:
    """Makes processes that start in the block inherit these signals as ignored (SIG_IGN), or not (SIG_DFL)."""
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


@contextmanager
def running(*arguments: str, **environment: str) -> Iterator[ServerProcess]:
    server = ServerProcess(*arguments, **environment)
    try:
        yield server
    finally:
        server.close()


def other(*arguments: str, **environment: str) -> tuple[int, list[str]]:
    """Runs one of the other commands. Returns its exit code and output."""
    with running(*arguments, **environment) as command:
        return command.end(), command.rest()


def page(address: tuple[str, int], path: str) -> str:
    with urllib.request.urlopen(f"http://{address[0]}:{address[1]}{path}", timeout=END_S) as answer:
        return str(answer.read().decode())


def stats(address: tuple[str, int]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(page(address, "/stats"))
    return found


class Strider:
    """A client in a game's loop that walks in circles and jumps all the time."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.events: list[Event] = []
        self._place: Vec | None = None

    def plays(self, seconds: float = 0.0, until: Callable[[], bool] = lambda: True) -> float:
        """Plays for `seconds`, and then until a condition holds.

        Returns:
            The distance in blocks that the player has walked meanwhile, by the server's snapshots.
        """
        walked, began = 0.0, time.monotonic()
        while (now := time.monotonic()) < began + seconds or not until():
            assert now < began + seconds + START_S, self.events
            self.events += self.client.poll()
            self.client.set_input(math.cos(2 * now), math.sin(2 * now), jump=True)
            self.client.update()
            prediction, entity = self.client.core.prediction, self.client.entity
            if prediction is not None and entity in prediction.confirmed:
                place = prediction.confirmed.position(entity)
                walked += 0.0 if self._place is None else math.dist(place, self._place)
                self._place = place
            time.sleep(0.005)
        return walked
