"""`bench.py scale`: what a world on many processes costs beside one process, and how long a takeover takes.

Players wander over hills at a constant density. Two measurements give a cost per player, each as the slope of a line
through measurements with several numbers of players that take turns:

- `scale_work`: the own work of a game, an edge, a sequencer and a standby, without sockets and bus, in one process.
- `scale_live`: the CPU time of whole processes, with sockets and a NATS server on the same machine.

A cost that does not grow with the players is the value of that line at no players. Each figure is given with two
standard errors as its scatter. A figure that is not above its scatter is not shown as a result. Takeovers are measured
by killing the sequencer.
"""

import argparse
import asyncio
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from scripts.benchmarks.scale_live import PROCESSES, Processes
from scripts.benchmarks.scale_work import PARTS, work
from scripts.benchmarks.server import RATE, RigError, scene_toml
from scripts.benchmarks.slopes import Figure, Line, fit, mean
from scripts.scale_lab.cluster import CannotStartError, Cluster
from scripts.scale_lab.nats_server import binary
from shared.scene import load_scene

LEAST, CAPACITY = 6, 400
"""Least number of players whose cost can be measured, and number of players for whom the scene has spawn points."""
SHARE = 0.7
"""Share of a core that the arithmetic lets a process use."""
WORLDS = (1_000, 2_000, 5_000, 10_000)
"""Numbers of players in the arithmetic."""
TAKEOVER_S = 60.0
"""Seconds within which a standby has to take over."""
Rows = list[dict[str, Any]]


def line(rows: Rows, value: Callable[[dict[str, Any]], float]) -> Line:
    """Returns the line through a value of measurements."""
    return fit([(row["players"], value(row)) for row in rows])


def lines(rows: Rows, names: Sequence[str]) -> dict[str, Line]:
    """Returns the lines through values of measurements by name. Each measurement has some of them."""
    return {name: line([row for row in rows if name in row], itemgetter(name)) for name in names}


async def takeovers(folder: Path, number: int) -> list[float]:
    """Returns the times from the newest record of a killed sequencer to the first tick of the standby, in ms."""
    cluster, times = Cluster(folder, edges=1, standbys=1, arguments=("--scene", "hills")), []
    try:
        await cluster.start()
        leader, standby = cluster.sequencer, cluster.standbys[0]
        for _ in range(number):
            await asyncio.sleep(1.0)
            leader.kill()
            async with asyncio.timeout(TAKEOVER_S):
                while not (stats := await standby.stats()).get("leads"):  # noqa: ASYNC110
                    await asyncio.sleep(0.1)
            times.append(float(stats["takeover_ms"]))
            leader.start()
            await leader.ready()
            leader, standby = standby, leader
        return times
    finally:
        cluster.close()


def arithmetic(figures: dict[str, Line]) -> list[tuple[int, int, float]]:
    """Returns for some numbers of players: the edges that they need, and the share of a core of the sequencer.

    An edge has its base, the cost of its own clients, and a replica of the whole world. 0 edges: the replica alone
    takes more than `SHARE`.
    """
    per = {part: found.per.value for part, found in figures.items()}
    base = {part: max(found.base.value, 0.0) for part, found in figures.items()}
    client, rows = per["edge"] - per["standby"], []
    for players in WORLDS:
        left = SHARE * 1e6 / RATE - base["edge"] - per["standby"] * players
        edges = max(math.ceil(players * client / left), 1) if left > 0 else 0
        rows.append((players, edges, (base["sequencer"] + per["sequencer"] * players) * RATE / 1e6))
    return rows


async def live(folder: Path, players: Sequence[int], seconds: float, rounds: int) -> tuple[Rows, Rows]:
    """Returns the windows of all processes, and the figures of the bus for each number of players and round."""
    windows: Rows = []
    figures: Rows = []
    async with Processes(folder, CAPACITY) as processes:
        for turn in range(rounds):
            for number in players if turn % 2 else reversed(players):
                for where in ("server", "edge1") if turn % 2 else ("edge1", "server"):
                    found, bus = await processes.measured(number, seconds, where)
                    windows += found
                    figures += [] if where == "server" else [bus]
    return windows, figures


def measured(players: Sequence[int], seconds: float, rounds: int, console: Console) -> dict[str, Any]:
    """Returns all measurements."""
    with tempfile.TemporaryDirectory(prefix="sovereign-scale-") as name:
        folder = Path(name)
        scene = folder / "scene.toml"
        scene.write_text(scene_toml(CAPACITY), "utf-8")
        console.print("the parts' own work, without sockets ...")
        own = work(load_scene(str(scene)), players, 2 * rounds, 3)
        console.print("the processes ...")
        (folder / "live").mkdir()
        windows, bus = asyncio.run(live(folder / "live", players, seconds, rounds))
        console.print("takeovers ...")
        (folder / "takeovers").mkdir()
        times = asyncio.run(takeovers(folder / "takeovers", 2 + 2 * rounds))
    return {"players": list(players), "work": own, "live": windows, "bus": bus, "takeover_ms": sorted(times)}


def costs(figures: dict[str, Any]) -> tuple[dict[str, Line], dict[str, Line], Line]:
    """Returns the lines of the own work, those of the processes, and that of an edge's work beyond a game's."""
    more = line(figures["work"], lambda row: row["edge"] - row["game"])
    return lines(figures["work"], (*PARTS, "log", "batches")), lines(calm(figures["live"]), PROCESSES), more


def calm(rows: Rows) -> Rows:
    """Returns the windows in which hardly any batches were late, or all if there were too few of them."""
    kept = [row for row in rows if row["calm"]]
    enough = all(len({row["players"] for row in kept if name in row}) > 1 for name in ("edge", "server"))
    return kept if enough else rows


def show(figures: dict[str, Any], console: Console) -> None:
    """Prints the figures."""
    own, whole, more = costs(figures)
    table = Table(title=f"CPU time per tick ({RATE} Hz) in us, with {_joined(figures['players'], 0)} players in turn")
    for column in ("", "per player", "without players"):
        table.add_column(column)
    for name, title in OWN.items():
        table.add_row(f"own work: {title}", *map(str, more if name == "more" else own[name]))
    for name, title in WHOLE.items():
        table.add_row(f"process: {title}", *map(str, whole[name]))
    console.print(table)
    kept, late = calm(figures["live"]), sum(not row["calm"] for row in figures["live"])
    if late:
        rest = "count all the same" if len(kept) == len(figures["live"]) else "do not count"
        console.print(f"{late} of {len(figures['live'])} windows of processes, in which many batches were late, {rest}")
    for players, loss in losses(kept).items():
        console.print(f"loss to the bus with {players} clients, in %: {loss}", soft_wrap=True, highlight=False)
    console.print(bus_table(figures, own))
    show_arithmetic({**whole, "sequencer": own["sequencer"], "standby": own["standby"]}, whole, console)


def losses(rows: Rows) -> dict[int, Figure]:
    """Returns what an edge costs more than a server in one process with as many clients, in %, by their number."""
    found = {}
    with_edge, with_server = ({row["players"] for row in rows if name in row} for name in ("edge", "server"))
    for players in sorted(with_edge & with_server):
        edge, one = (
            mean([row[name] for row in rows if row["players"] == players and name in row])
            for name in ("edge", "server")
        )
        ratio = edge.over(one)
        found[players] = Figure(100 * (ratio.value - 1), 100 * ratio.scatter)
    return found


def bus_table(figures: dict[str, Any], own: dict[str, Line]) -> Table:
    """Returns the table of the bus and the takeovers."""
    table = Table(title="bus, on the same machine")
    for column in ("", "each number of players, each round"):
        table.add_column(column)
    bus = figures["bus"]
    table.add_row("players", _joined((row["players"] for row in bus), 0))
    for key, title in (("log_bytes", "log"), ("batch_bytes", "batches")):
        table.add_row(f"{title}, bytes per tick", _joined(row[key] for row in bus))
        table.add_row(f"{title}, bytes per player and tick", str(own[title].per))
    for share in ("p50", "p99"):
        table.add_row(
            f"added latency (batch to record), ms, {share}", _joined(row["bus_round_trip_ms"][share] for row in bus)
        )
    table.add_row("lead of the edge, ms", _joined(row["edge_lead_ms"] for row in bus))
    table.add_row("late batches", ", ".join(f"{row['batches_late']} of {row['ticks']}" for row in bus))
    table.add_row("takeover, ms", _joined(figures["takeover_ms"]))
    return table


def show_arithmetic(per: dict[str, Line], whole: dict[str, Line], console: Console) -> None:
    """Prints the table of players per world, if all figures that it needs were found.

    Args:
        per: lines whose slopes count.
        whole: lines whose values without players count.
        console: where it is printed.
    """
    missing = [name for name in ("edge", "sequencer", "standby") if not per[name].per.found]
    if missing:
        console.print(f"no arithmetic of players per world: the cost per player of {', '.join(missing)} was not found")
        return
    used = {name: Line(per[name].per, whole[name].base) for name in ("edge", "sequencer", "standby")}
    table = Table(title=f"arithmetic from these figures, not measured: processes at {SHARE:.0%} of a core")
    for column in ("players", "edges", "share of a core for the sequencer"):
        table.add_column(column)
    for players, edges, load in arithmetic(used):
        table.add_row(f"{players:,}", str(edges) if edges else "too many for one replica", f"{load:.0%}")
    console.print(table)


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    """Runs the benchmark, as the other commands of `bench.py` do.

    Raises:
        RigError: there is no NATS server, or a process does not start, or `players` is out of range.
    """
    if not LEAST <= args.players <= CAPACITY:
        raise RigError(f"--players {args.players}: must be {LEAST} to {CAPACITY}")
    if not binary():
        raise RigError("there is no nats-server; install the development requirements, or put one on PATH")
    most = args.players
    players, seconds, rounds = ((most // 3, most), 3.0, 1) if args.quick else ((most // 3, 2 * most // 3, most), 6.0, 3)
    try:
        figures = measured(players, seconds, rounds, console)
    except CannotStartError as error:
        raise RigError(str(error)) from error
    show(figures, console)
    return json.loads(json.dumps({**figures, "costs": dict(zip(COSTS, costs(figures), strict=True))})), 0


COSTS = ("own_work", "processes", "edge_less_game")
"""Names of the lines in the report. Each line is its cost per player and its base, and each of them has a scatter."""
OWN = {
    "game": "one process, per client",
    "edge": "edge, per client",
    "more": "edge less one process, per client",
    "sequencer": "sequencer, per player",
    "standby": "replica (a standby), per player",
}
"""Rows of the parts' own work: the part, and its title."""
WHOLE = {
    "server": "one process, per client",
    "edge": "edge, per client",
    "sequencer": "sequencer, per player",
    "standby": "standby, per player",
    "bus": "NATS server, per player",
}
"""Rows of the processes: the process, and its title."""


def _joined(values: Any, digits: int = 1) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
