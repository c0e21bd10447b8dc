"""The processes of a load test: a server, its `/stats`, and processes of bots. No process outlives its `with` block."""

import argparse
import asyncio
import contextlib
import http.client
import json
import sys
from collections.abc import AsyncIterator
from typing import Any
from urllib.parse import urlsplit
from weakref import WeakKeyDictionary

from sovereign_netcode.stderr import Stderr

START_S_MAX = 120.0
"""Seconds in which a server must start. Its first start may compile the physics."""
END_S = 10.0
"""Seconds that a process has to end after it was asked to. Then it is killed."""
RESULT_S_MAX = 30.0
LINE_BYTES_MAX = 1 << 24

Figures = dict[str, Any]
Process = asyncio.subprocess.Process
_stderr: WeakKeyDictionary[Process, Stderr] = WeakKeyDictionary()


class CannotStartError(Exception):
    """The test cannot start. The message says why."""


class DiedError(Exception):
    """A process has ended that should still run. The message says which, and with what exit code."""


class Worker:
    """The load test's side of a process of bots (`sovereign_netcode.loadtest.swarm`)."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.report: Figures = {"playing": 0, "ended": []}
        """The latest report of the process; the docstring of the module `swarm` lists its fields."""
        self._result: Figures | None = None
        self._reading = asyncio.create_task(self._read())

    async def tell(self, command: str) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(ConnectionError):  # it has ended, which `app.check` reports
            self.process.stdin.write(f"{command}\n".encode())
            await self.process.stdin.drain()

    async def result(self) -> Figures:
        """Returns the counts of the bots in the window.

        Raises:
            DiedError: the process ended without reporting them.
        """
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._reading, RESULT_S_MAX)
        if self._result is None:
            raise DiedError(f"a process of bots has not reported its figures: {cause(self.process)}")
        return self._result

    def leave(self) -> None:
        """Tells the process to end, by closing its input."""
        assert self.process.stdin is not None
        self.process.stdin.close()

    async def _read(self) -> None:
        assert self.process.stdout is not None
        while (line := await self.process.stdout.readline()).endswith(b"\n"):  # else it died within a line
            report = json.loads(line)
            if "clients" in report:
                self._result = report
            else:
                self.report = report


@contextlib.asynccontextmanager
async def child(*command: str, patience_s: float = 0.0) -> AsyncIterator[Process]:
    """Runs a process of this Python within the block. Ctrl-C reaches only the parent process.

    At the end of the block the child's input is closed, which ends bots. After `patience_s` the child gets SIGTERM,
    which ends a server. After a further `END_S` it is killed.
    """
    errors = Stderr()
    try:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", *command),  # -P: modules in the current folder cannot hide others
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=errors.pipe,
            limit=LINE_BYTES_MAX,
            start_new_session=True,
        )
    finally:
        errors.started()
    _stderr[process] = errors
    assert process.stdin is not None
    try:
        yield process
    finally:
        try:
            process.stdin.close()
            if not await ended(process, patience_s):
                process.terminate()
                await ended(process, END_S)
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()


def cause(process: Process) -> str:
    """Returns why a `child` failed: the last line that it wrote on stderr, or its exit code."""
    return _stderr[process].cause(process.returncode)


async def ended(process: Process, seconds: float) -> bool:
    """Waits at most `seconds` for a process to end. Returns whether it has ended."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), seconds)
    return process.returncode is not None


@contextlib.asynccontextmanager
async def own_server(args: argparse.Namespace) -> AsyncIterator[tuple[Process, str]]:
    """Runs a server on a free port. Yields its process and URL once it listens.

    Raises:
        CannotStartError: the server did not start. The message says why.
    """
    given = {"--game": args.game, "--scene": args.scene, "--tick-rate": args.tick_rate}
    flags = [text for flag, value in given.items() if value for text in (flag, str(value))]
    command = (
        "-m",
        "sovereign_netcode.server",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--log-level",
        "warning",
    )
    async with child(*command, *flags) as server:
        assert server.stdout is not None
        line = ""
        with contextlib.suppress(TimeoutError):
            line = (await asyncio.wait_for(server.stdout.readline(), START_S_MAX)).decode()
        if not line.startswith("listening on "):
            await ended(server, END_S if server.stdout.at_eof() else 0.0)
            raise CannotStartError(f"the server did not start: {cause(server)}")
        yield server, line.removeprefix("listening on ").strip()


async def stats(url: str) -> Figures:
    """Returns the server's `/stats`; empty if the server does not provide it."""

    def get() -> Figures:
        address = urlsplit(url)
        kind = http.client.HTTPSConnection if address.scheme == "wss" else http.client.HTTPConnection
        connection = kind(address.hostname or "", address.port, timeout=5)
        try:
            connection.request("GET", "/stats")
            response = connection.getresponse()
            return dict(json.loads(response.read())) if response.status == 200 else {}
        except (OSError, ValueError, http.client.HTTPException):
            return {}
        finally:
            connection.close()

    return await asyncio.to_thread(get)
