"""The processes of one world: a NATS server and parts of `sovereign-server`."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scripts.environment import ROOT
from scripts.scale_lab.nats_server import NatsServer

START_S = 120.0
"""Seconds until a part has to be ready."""
TIME_OUT_S = 2.0
"""Seconds that a page may take."""


class CannotStartError(Exception):
    """A part that did not start. The text has the end of its log."""


class PartProcess:
    """A process of one part.

    Args:
        folder: folder for its log.
        name: name of the process in reports and files.
        arguments: arguments of `python -m server`.
    """

    def __init__(self, folder: Path, name: str, arguments: Sequence[str]) -> None:
        self.folder, self.name, self._arguments = folder, name, arguments
        self.role = name.rstrip("0123456789 ")
        self.port, self._bus = 0, ""
        self.recorded = False
        """Whether its world is recorded."""
        self.starts = 0
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> Path:
        """The file with the output of the latest process."""
        return self.folder / f"{self.name}-{self.starts}.log"

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def start(self, bus: str = "") -> None:
        """Starts the process, on its former port if it had one.

        Args:
            bus: address of the bus; empty: the former one.
        """
        self.starts += 1
        self._bus = bus or self._bus
        command = [sys.executable, "-m", "server", *self._arguments, "--port", str(self.port)]
        command += ["--bus", self._bus] if self._bus else []
        command += ["--record", str(self.recording)] if self.recorded else []
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env={**os.environ, **ENVIRONMENT}
            )

    @property
    def recording(self) -> Path:
        """The recording of the latest process."""
        return self.folder / f"{self.name}-{self.starts}.rec"

    async def ready(self) -> None:
        """Waits until the part is ready.

        Raises:
            CannotStartError: it is not in time, or has ended.
        """
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            for line in self.log.read_text("utf-8").splitlines():
                if line.startswith("listening on "):
                    self.port = int(line.rpartition(":")[2])
            if self.port and (await self.page("/readyz"))[0] == 200:
                return
            await asyncio.sleep(0.05)
        raise CannotStartError(f"{self.name}: {self.log.read_text('utf-8')[-2000:]}")

    async def page(self, path: str) -> tuple[int, bytes]:
        """Returns status and body of a page; status 0: there was no answer."""
        return await asyncio.to_thread(_fetched, f"http://127.0.0.1:{self.port}{path}")

    async def stats(self) -> dict[str, Any]:
        """Returns the figures of the part; empty if it does not answer."""
        status, body = await self.page("/stats")
        return json.loads(body) if status == 200 else {}

    def send(self, number: signal.Signals) -> None:
        """Sends a signal to the process."""
        if self.alive and self._process is not None:
            self._process.send_signal(number)

    def kill(self) -> None:
        """Ends the process at once (SIGKILL). Does nothing if it does not run."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def wait(self, seconds: float) -> int | None:
        """Waits for the end of the process. Returns its exit code; None: it goes on."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(seconds)
        return None


class Cluster:
    """A NATS server and the parts of one world.

    Args:
        folder: an existing folder for all files.
        edges, standbys: numbers of these parts.
        arguments: further arguments of all parts.
        store: further settings of the store of the NATS server.
    """

    def __init__(
        self, folder: Path, *, edges: int = 2, standbys: int = 1, arguments: Sequence[str] = (), store: str = ""
    ) -> None:
        self.folder = folder
        (folder / "nats").mkdir(parents=True, exist_ok=True)
        self.nats = NatsServer(folder / "nats", store)
        self._arguments = arguments
        self.sequencer = self._part("sequencer")
        self.edges = [self._part(f"edge{number + 1}") for number in range(edges)]
        self.standbys = [self._part(f"standby{number + 1}") for number in range(standbys)]

    @property
    def parts(self) -> list[PartProcess]:
        return [self.sequencer, *self.edges, *self.standbys]

    async def start(self) -> None:
        """Starts everything, and waits until all parts are ready.

        Raises:
            CannotStartError: a part did not start.
            OSError: the NATS server did not start.
        """
        await self.nats.start()
        for part in self.parts:
            part.start(self.nats.url)
        for part in self.parts:
            await part.ready()

    def close(self) -> None:
        """Ends all processes."""
        for part in self.parts:
            part.send(signal.SIGCONT)
            part.kill()
        self.nats.kill()

    def _part(self, name: str) -> PartProcess:
        role = name.rstrip("0123456789")
        return PartProcess(self.folder, name, ("--role", role, *self._arguments))


ENVIRONMENT = {"PYTHONUNBUFFERED": "1"}
"""Environment variables of the parts."""


def _fetched(url: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(url, timeout=TIME_OUT_S) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()
    except OSError:
        return 0, b""
