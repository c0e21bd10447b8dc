"""Bots on real sockets against a real server process, and what they saw.

Starts a server of its own unless --url is given. The figures are of the window in which all clients are playing.
Exits with 1 if a bot died, a message was malformed, or the server did not end well; with 2 if nothing could start.
"""

import argparse
import asyncio
import contextlib
import http.client
import json
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from _figures import Figures, failures, figures, rows, verdict
from client_sdk.bots import POLICIES

ROOT = Path(__file__).resolve().parent.parent
JOINS_PER_S = 100.0
JOIN_S_MAX = 30.0
"""What the joins may take beyond their pace."""
START_S_MAX = 120.0
"""A server's first start compiles the physics."""
END_S = 10.0
"""A process that has not ended by then, though asked to, is killed."""
LINE_BYTES_MAX = 1 << 24

Process = asyncio.subprocess.Process


class CannotStartError(Exception):
    """The test cannot begin; the text says why."""


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--clients", type=_positive, default=50, metavar="N", help="bots (default: %(default)s)")
    parser.add_argument("--seconds", type=_duration, default=10.0, metavar="S", help="window (default: %(default)g)")
    parser.add_argument("--url", help="a running server, like ws://localhost:8765, instead of one of its own")
    parser.add_argument("--policy", choices=sorted(POLICIES), default="wander", help="default: %(default)s")
    parser.add_argument("--scene", default="hills", help="of the own server (default: %(default)s)")
    parser.add_argument("--tick-rate", type=_positive, metavar="HZ", help="of the own server, not the scene's")
    parser.add_argument("--seed", type=int, default=1, help="of the bots (default: %(default)s)")
    parser.add_argument("--processes", type=_positive, default=1, metavar="N", help="for the bots (default: 1)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    parser.add_argument("--verdict", action="store_true", help="say in words what is good and what is not")
    return parser.parse_args(argv)


async def test(args: argparse.Namespace, console: Console) -> int:
    """The whole test; returns the exit code."""
    server: Process | None = None
    async with contextlib.AsyncExitStack() as stack:
        url = args.url
        if url is None:
            server, url = await stack.enter_async_context(own_server(args))
        workers = [await stack.enter_async_context(child(*order, patience_s=2.0)) for order in orders(args, url)]
        measured = await measure(args, url, [Worker(worker) for worker in workers], console)
    measured |= {"policy": args.policy, "scene": args.scene, "seed": args.seed, "processes": args.processes}
    failed = failures(measured)
    if server is not None:
        measured["server_exit_code"] = server.returncode
        if server.returncode != 0 and os.name != "nt":
            failed.append(f"the server ended with {server.returncode}")
    measured["failures"] = failed
    if args.json is not None:
        args.json.write_text(json.dumps(measured, indent=2) + "\n", "utf-8")
    show(measured, args, console)
    return int(bool(failed))


async def measure(args: argparse.Namespace, url: str, workers: "list[Worker]", console: Console) -> Figures:
    """Waits for everybody to play, then measures."""
    with Stage(console) as stage:
        stage.begin(f"{args.clients} clients join", args.clients)
        deadline = time.monotonic() + args.clients / JOINS_PER_S + JOIN_S_MAX
        while sum(worker.playing + len(worker.ended) for worker in workers) < args.clients:
            if time.monotonic() > deadline or any(worker.dead for worker in workers):
                break
            await asyncio.sleep(0.05)
            stage.at(sum(worker.playing for worker in workers))
        playing = sum(worker.playing for worker in workers)
        if not playing:
            reasons = {left["reason"] for worker in workers for left in worker.ended}
            raise CannotStartError("; ".join(sorted(reasons)) or "no client could join in time")
        stage.at(playing)

        stage.begin(f"{playing} play", args.seconds)
        for worker in workers:
            await worker.tell("measure")
        before, began = await stats(url), time.monotonic()
        rss_mb: list[float] = []
        sample = began + 1
        while (now := time.monotonic()) < began + args.seconds:
            stage.at(now - began)
            if now >= sample:
                sample += 1
                rss_mb += [told["rss_mb"] for told in [await stats(url)] if "rss_mb" in told]
            await asyncio.sleep(max(0.0, min(began + args.seconds - now, sample - now, 0.25)))
        for worker in workers:
            await worker.tell("stop")
        seconds = time.monotonic() - began
        after = await stats(url)
        results = [await worker.result() for worker in workers]
    return figures(results, seconds, before, after, rss_mb)


class Worker:
    """The other end of a `_swarm.py`."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.playing = 0
        self.ended: list[dict[str, Any]] = []
        self.dead = False
        self._result: dict[str, Any] | None = None
        self._reading = asyncio.create_task(self._read())

    async def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(ConnectionError):  # it is dead: its result will say so
            self._process.stdin.write(f"{command}\n".encode())
            await self._process.stdin.drain()

    async def result(self) -> dict[str, Any]:
        """What its bots counted.

        Raises:
            CannotStartError: the process died.
        """
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._reading, JOIN_S_MAX)
        if self._result is None:
            raise CannotStartError("a process of bots died")
        return self._result

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while line := await self._process.stdout.readline():
            told = json.loads(line)
            if "clients" in told:
                self._result = told
            else:
                self.playing, self.ended = told["playing"], told["ended"]
        self.dead = self._result is None


@contextlib.asynccontextmanager
async def child(*command: str, patience_s: float = 0.0) -> AsyncIterator[Process]:
    """A process that has ended when this has, whatever happens. Ctrl-C goes to this process alone.

    At the end its input is closed, which ends bots; after `patience_s` it gets SIGTERM, which ends a server.
    """
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, *command),
        cwd=ROOT,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        limit=LINE_BYTES_MAX,
        start_new_session=True,
    )
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


async def ended(process: Process, seconds: float) -> bool:
    """Waits for a process to end, at most so long; whether it has."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), seconds)
    return process.returncode is not None


@contextlib.asynccontextmanager
async def own_server(args: argparse.Namespace) -> AsyncIterator[tuple[Process, str]]:
    """A server on a port that the system picks, once it listens."""
    rate = ("--tick-rate", str(args.tick_rate)) if args.tick_rate else ()
    command = ("-m", "server", "--host", "127.0.0.1", "--port", "0", "--scene", args.scene, "--log-level", "warning")
    async with child(*command, *rate) as server:
        assert server.stdout is not None
        line = ""
        with contextlib.suppress(TimeoutError):
            line = (await asyncio.wait_for(server.stdout.readline(), START_S_MAX)).decode()
        if not line.startswith("listening on "):
            raise CannotStartError("the server did not start")
        yield server, line.removeprefix("listening on ").strip()


def orders(args: argparse.Namespace, url: str) -> list[tuple[str, str]]:
    """The command of each process of bots."""
    processes = min(args.processes, args.clients)
    found, first = [], 0
    for i in range(processes):
        clients = (args.clients - first) // (processes - i)
        order = {"url": url, "first": first, "clients": clients, "seed": args.seed, "policy": args.policy}
        order["joins_per_s"] = JOINS_PER_S / processes
        found.append((str(ROOT / "scripts" / "_swarm.py"), json.dumps(order)))
        first += clients
    return found


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


class Stage:
    """What goes on right now: a bar on a terminal, otherwise one line for each stage."""

    def __init__(self, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._console = console

    def __enter__(self) -> "Stage":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, text: str, total: float) -> None:
        if not self._console.is_terminal:
            self._console.print(f"{text} ...")
        for task in self._progress.task_ids:
            self._progress.remove_task(task)
        self._task = self._progress.add_task(text, total=total)

    def at(self, done: float) -> None:
        self._progress.update(self._task, completed=done)


def show(measured: Figures, args: argparse.Namespace, console: Console) -> None:
    table = Table(title=f"{args.policy} in {args.scene}" if args.url is None else f"{args.policy} on {args.url}")
    table.add_column("figure")
    table.add_column("measured")
    for row in rows(measured):
        table.add_row(*row)
    console.print(table)
    if args.verdict:
        judgements = verdict(measured)
        for judgement in judgements:
            mark = "[green]good[/]" if judgement.good else "[red]bad [/]"
            console.print(f"{mark}  {judgement.text}", highlight=False, soft_wrap=True)
        bad = sum(not judgement.good for judgement in judgements)
        console.print("all is well" if not bad else f"{bad} of {len(judgements)} not as it should be", style="bold")
    for failure in measured["failures"]:
        console.print(f"failed: {failure}", style="red", highlight=False, soft_wrap=True)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _duration(text: str) -> float:
    value = float(text)
    if not 0.1 <= value <= 86400:
        raise argparse.ArgumentTypeError("must be from 0.1 to 86400")
    return value


async def until_signal(args: argparse.Namespace, console: Console) -> int:
    """The test; SIGTERM ends it as Ctrl-C does."""
    task = asyncio.ensure_future(test(args, console))
    with contextlib.suppress(NotImplementedError):  # Windows
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    try:
        return await task
    except CannotStartError as error:
        console.print(f"error: {error}", style="red", highlight=False, soft_wrap=True)
        return 2


def main(argv: list[str] | None = None) -> int:
    args = arguments(argv)
    try:
        return asyncio.run(until_signal(args, Console()))
    except (KeyboardInterrupt, asyncio.CancelledError):
        print("stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
