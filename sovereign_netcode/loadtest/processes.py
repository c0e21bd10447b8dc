"""The processes of a load test: a server, its `/stats`, and processes full of bots. None of them outlives its block."""

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
"""A server's first start compiles the physics."""
END_S = 10.0
"""A process that has not ended by then, though asked to, is killed."""
RESULT_S_MAX = 30.0
LINE_BYTES_MAX = 1 << 24

Figures = dict[str, Any]
Process = asyncio.subprocess.Process
_stderr: WeakKeyDictionary[Process, Stderr] = WeakKeyDictionary()


class CannotStartError(Exception):
    """The test cannot begin; the text says why."""


class DiedError(Exception):
    """A process has ended that should not have; the text says which, and how."""


class Worker:
    """The other end of a process of bots (`sovereign_netcode.loadtest.swarm`)."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.told: Figures = {"playing": 0, "ended": []}
        """What it has said last; its docstring says what that is."""
        self._result: Figures | None = None
        self._reading = asyncio.create_task(self._read())

    async def tell(self, command: str) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(ConnectionError):  # it is dead, which is found out elsewhere
            self.process.stdin.write(f"{command}\n".encode())
            await self.process.stdin.drain()

    async def result(self) -> Figures:
        """What its bots counted.

        Raises:
            DiedError: the process died.
        """
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._reading, RESULT_S_MAX)
        if self._result is None:
            raise DiedError(f"a process of bots has not told its figures: {cause(self.process)}")
        return self._result

    def leave(self) -> None:
        """Its end may begin."""
        assert self.process.stdin is not None
        self.process.stdin.close()

    async def _read(self) -> None:
        assert self.process.stdout is not None
        while (line := await self.process.stdout.readline()).endswith(b"\n"):  # else it died while it spoke
            told = json.loads(line)
            if "clients" in told:
                self._result = told
            else:
                self.told = told


@contextlib.asynccontextmanager
async def child(*command: str, patience_s: float = 0.0) -> AsyncIterator[Process]:
    """A process that has ended when this has, whatever happens. Ctrl-C goes to this process alone.

    At the end its input is closed, which ends bots; after `patience_s` it gets SIGTERM, which ends a server.
    """
    errors = Stderr()
    try:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", *command),  # -P: modules in the current folder do not matter
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
    """Why a `child` failed, in its own words if it has said something."""
    return _stderr[process].cause(process.returncode)


async def ended(process: Process, seconds: float) -> bool:
    """Waits for a process to end, at most so long; whether it has."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), seconds)
    return process.returncode is not None


@contextlib.asynccontextmanager
async def own_server(args: argparse.Namespace) -> AsyncIterator[tuple[Process, str]]:
    """A server on a port that the system picks, once it listens.

    Raises:
        CannotStartError: it does not; the text says why.
    """
    rate = ("--tick-rate", str(args.tick_rate)) if args.tick_rate else ()
    command = (
        "-m",
        "sovereign_netcode.server",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--scene",
        args.scene,
        "--log-level",
        "warning",
    )
    async with child(*command, *rate) as server:
        assert server.stdout is not None
        line = ""
        with contextlib.suppress(TimeoutError):
            line = (await asyncio.wait_for(server.stdout.readline(), START_S_MAX)).decode()
        if not line.startswith("listening on "):
            await ended(server, END_S if server.stdout.at_eof() else 0.0)
            raise CannotStartError(f"the server did not start: {cause(server)}")
        yield server, line.removeprefix("listening on ").strip()


async def stats(url: str) -> Figures:
    """The server's `/stats`; empty if it does not tell."""

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
