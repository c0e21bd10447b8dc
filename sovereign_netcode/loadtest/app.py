"""Connects bots over real sockets to a real server process, and reports what they measured.

Starts a server of its own unless --url is given. The bots are spread over --processes, each with its own event loop.
While they play, the output shows the figures since the last line: clients, ticks, tick lateness (p50 / p99 / max),
bytes, late inputs, corrections, and the lateness of the bots themselves (p99, in the worst of their processes). The
final figures cover the whole window in which all clients are playing. Quantiles are taken over the samples of all
processes together. Exits with 1 if a bot or a process died, a message was malformed, or the server's exit code was not
0. Exits with 2 if the test could not start.
"""

import argparse
import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from client_sdk.bots import POLICIES
from server.rules import RulesError, load_rules
from sovereign_netcode.loadtest.figures import bottleneck, failures, figures, rows, verdict
from sovereign_netcode.loadtest.glance import Look, Stage
from sovereign_netcode.loadtest.glance import rows as glance
from sovereign_netcode.loadtest.processes import (
    CannotStartError,
    DiedError,
    Figures,
    Process,
    Worker,
    cause,
    child,
    own_server,
    stats,
)

JOINS_PER_S = 100.0
JOIN_S_MAX = 30.0
"""Seconds that the joins may take beyond `clients / JOINS_PER_S`."""
SETTLE_S = 0.5
"""Seconds from the last join to the window: the bots collect garbage meanwhile, which delays them."""
LINES_MAX = 20
"""Most lines of figures while the bots play, where the output is no terminal."""


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="sovereign-loadtest",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--clients", type=_positive, default=50, metavar="N", help="number of bots (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds", type=_duration, default=10.0, metavar="S", help="length of the window (default: %(default)g)"
    )
    parser.add_argument(
        "--url",
        help="URL of a running server, like ws://localhost:8765; with /match?kind=NAME each bot finds a world "
        "(default: starts one)",
    )
    parser.add_argument(
        "--game",
        metavar="MODULE:CLASS",
        help="game of the server that is started, or that is played at --url: its behaviours and bots are used",
    )
    parser.add_argument(
        "--policy", choices=sorted(POLICIES), help="behaviour of the bots (default: the game's, else wander)"
    )
    parser.add_argument("--scene", help="scene of the server that is started (default: the game's, else hills)")
    parser.add_argument(
        "--tick-rate",
        type=_positive,
        metavar="HZ",
        help="tick rate of the server that is started (default: the scene's)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the bots (default: %(default)s)")
    parser.add_argument(
        "--processes", type=_positive, default=1, metavar="N", help="processes for the bots (default: 1)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    parser.add_argument(
        "--verdict", action="store_true", help="print in words which figures are good and which are bad"
    )
    args = parser.parse_args(argv)
    if args.game is None:
        args.policy, args.scene = args.policy or "wander", args.scene or "hills"
    return args


async def test(args: argparse.Namespace, console: Console) -> int:
    """Runs the whole test. Returns the exit code."""
    server: Process | None = None
    async with contextlib.AsyncExitStack() as stack:
        url = args.url
        if url is None:
            server, url = await stack.enter_async_context(own_server(args))
        workers = [
            Worker(await stack.enter_async_context(child(*order, patience_s=2.0))) for order in orders(args, url)
        ]
        for worker in workers:
            stack.callback(worker.leave)  # tell all of them to end before waiting for any
        watched = {
            "a process of bots": [worker.process for worker in workers],
            "the server": [server] if server else [],
        }
        measured = await measure(args, url, workers, lambda: check(watched), console)
    asked = {name: getattr(args, name) for name in ("game", "policy", "scene", "seed")}
    measured |= {**asked, "processes": len(workers)}
    failed = failures(measured)
    if server is not None:
        measured["server_exit_code"] = server.returncode
        if server.returncode != 0 and os.name != "nt":
            failed.append(f"the server ended with exit code {server.returncode}: {cause(server)}")
    measured["failures"] = failed
    if args.json is not None:
        args.json.write_text(json.dumps(measured, indent=2) + "\n", "utf-8")
    show(measured, args, console)
    return int(bool(failed))


def check(watched: dict[str, list[Process]]) -> None:
    """Checks that all processes still run.

    Args:
        watched: processes by the name that errors give them.

    Raises:
        DiedError: a process has ended.
    """
    for name, processes in watched.items():
        for process in processes:
            if process.returncode is not None:
                raise DiedError(f"{name} ended during the test with exit code {process.returncode}: {cause(process)}")


async def measure(
    args: argparse.Namespace, url: str, workers: list[Worker], check: Callable[[], None], console: Console
) -> Figures:
    """Waits until all bots play, then measures.

    Args:
        check: raises if one of the processes has ended.

    Raises:
        CannotStartError: no bot could join.
        DiedError: a process has ended.
    """
    with Stage(console) as stage:
        stage.begin(f"{args.clients} clients join", args.clients)
        deadline = time.monotonic() + args.clients / JOINS_PER_S + JOIN_S_MAX
        while sum(worker.report["playing"] + len(worker.report["ended"]) for worker in workers) < args.clients:
            if time.monotonic() > deadline:
                break
            await asyncio.sleep(0.05)
            check()
            stage.at(sum(worker.report["playing"] for worker in workers))
        playing = sum(worker.report["playing"] for worker in workers)
        if not playing:
            reasons = {left["reason"] for worker in workers for left in worker.report["ended"]}
            raise CannotStartError(
                "; ".join(sorted(reasons)) or f"no client joined within {args.clients / JOINS_PER_S + JOIN_S_MAX:.0f} s"
            )

        stage.begin(f"{playing} play", args.seconds)
        for worker in workers:
            await worker.tell("settle")
        await asyncio.sleep(SETTLE_S)
        for worker in workers:
            await worker.tell("measure")
        before, began = await stats(url), time.monotonic()
        rss_mb: list[float] = []
        looked = shown = Look(before, [worker.report for worker in workers])
        sample, line = began + 1, began
        while (now := time.monotonic()) < began + args.seconds:
            check()
            stage.at(now - began)
            if now >= sample:
                sample += 1
                looked = Look(await stats(url), [worker.report for worker in workers])
                rss_mb += [looked.server["rss_mb"]] if "rss_mb" in looked.server else []
                if console.is_terminal or now >= line + args.seconds / LINES_MAX:
                    line = now
                    stage.show(now - began, glance(shown, looked))
                    shown = looked
            await asyncio.sleep(max(0.0, min(began + args.seconds - now, sample - now, 0.25)))
        for worker in workers:
            await worker.tell("stop")
        seconds = time.monotonic() - began
        after = await stats(url)
        results = [await worker.result() for worker in workers]
    return figures(results, seconds, before, after, rss_mb)


def orders(args: argparse.Namespace, url: str) -> list[tuple[str, ...]]:
    """Returns the command line of each process of bots."""
    processes = min(args.processes, args.clients)
    found: list[tuple[str, ...]] = []
    first = 0
    for i in range(processes):
        clients = (args.clients - first) // (processes - i)
        order = {"url": url, "first": first, "clients": clients, "joins_per_s": JOINS_PER_S / processes}
        order |= {"seed": args.seed, "game": args.game, "policy": args.policy}
        found.append(("-m", "sovereign_netcode.loadtest.swarm", json.dumps(order)))
        first += clients
    return found


def show(measured: Figures, args: argparse.Namespace, console: Console) -> None:
    where = f"on {args.url}" if args.url else f"in {args.scene}" if args.scene else ""
    table = Table(title=" ".join(filter(None, (args.game, args.policy, where))))
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
        console.print("all is well" if not bad else f"{bad} of {len(judgements)} figures are bad", style="bold")
    elif held_up := bottleneck(measured):
        console.print(held_up, style="yellow", highlight=False, soft_wrap=True)
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
    """Runs the test until it ends or SIGTERM or SIGINT arrives. A script's background process would ignore SIGINT."""
    task = asyncio.ensure_future(test(args, console))
    with contextlib.suppress(NotImplementedError):  # Windows
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    try:
        return await task
    except CannotStartError as error:
        console.print(f"error: {error}", style="red", highlight=False, soft_wrap=True)
        return 2
    except DiedError as error:
        console.print(f"failed: {error}", style="red", highlight=False, soft_wrap=True)
        return 1


def main(argv: list[str] | None = None) -> int:
    args = arguments(argv)
    try:
        if args.game is not None:
            load_rules(args.game)  # an error is reported before anything is started
    except RulesError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        return asyncio.run(until_signal(args, Console()))
    except (KeyboardInterrupt, asyncio.CancelledError):
        print("stopped", file=sys.stderr)
        return 130
