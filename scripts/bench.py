"""Benchmarks: figures with their scatter, and ratios taken in one run.

`physics` times the compiled step on crowds, beside the same step in C, which it builds and which must reach the
same hash. A figure is the median of repeated runs, its range beside it. Two busy cores scatter by a third.

`server` looks for the most clients that one server process holds at 30 Hz, all wandering over hills with some 50
entities in view, beside what the same gateway holds without a game. It needs the machine for itself: while others
work, ticks are late for their sake. The CPU time per client and tick is told as well, and what it comes to.
`server --crowd` puts 300 players (or N) into one segment instead, each seeing all: the fairness is what the worst
served of them gets of what the best served gets.

`jitter` tells how late the ticks of a server with 200 clients begin and how long they take, with garbage collection and
event loop as the product has them and otherwise, in turns.

`bytes` tells what one client is sent at 20 Hz while 100 entities (or N) move in its view, and that its copy of them is
exact in every tick.

`memory` tells the bytes per connection, entity and loaded segment, and what is in use after each cycle of churn; the
same of a server process over sockets, by what it has in RAM: between 200 and 400 clients, and in --minutes of churn.

`entities` tells the CPU time of a tick with 100,000 entities, a tenth of them walking, before, while and after 200
clients join.
"""

import argparse
import itertools
import json
import signal
import statistics
import sys
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import _bench_bytes as wire
import _bench_capacity as capacity
import _bench_entities as entities
import _bench_jitter as jitter
import _bench_memory as memory
import _bench_physics as physics
import _bench_rss as rss
import _step_c
from _bench_server import RigError
from _crowds import Samples
from shared import kernels

Report = dict[str, Any]
"""What `--json` writes; empty: nothing. A command gives it, and the exit code."""


class Row(NamedTuple):
    """A line of the table: the samples in `unit`, and the most that they should be in the middle."""

    name: str
    unit: str
    samples: list[float]
    target: float | None = None

    @property
    def median(self) -> float:
        return statistics.median(self.samples)


def in_unit(samples: list[float], unit: float) -> list[float]:
    return [sample / unit for sample in samples]


def ratios(samples: Samples) -> list[float]:
    """Ours over theirs, round by round."""
    return [ours / theirs for ours, theirs in zip(samples["ours"], samples["c"], strict=True)]


def run_physics(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    if not kernels.available():
        console.print("error: there is neither a prebuilt kernel nor Numba; the benchmark times the compiled step")
        return {}, 2
    rounds = 10 if args.quick else 60
    rows: list[Row] = []
    report: dict[str, Any] = {"quick": args.quick, "rounds": rounds}
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("physics", total=8)

        def begin(what: str) -> None:
            progress.update(task, description=what, advance=1)

        begin("10,000 walkers")
        report["hash_equal_to_c"] = None
        for name, pairs, target in (("walk", False, 60), ("walk_pairs", True, 150)):
            samples, facts = physics.walk(rounds, pairs=pairs)
            rows.append(Row(name, "ns", in_unit(samples["ours"], 1e-9), target))
            if facts["c"]:
                rows.append(Row(f"{name}_in_c", "ns", in_unit(samples["c"], 1e-9)))
                rows.append(Row(f"{name}_ratio_to_c", "x", ratios(samples), 1.5))
                report["hash_equal_to_c"] = report["hash_equal_to_c"] is not False and facts["hash_equal"]
        begin("10,000 sleepers")
        rows.append(Row("rest", "ns", in_unit(physics.rest(rounds)["rest"], 1e-9), 3))
        begin("a million entities, one per cent awake")
        samples, facts = physics.million(rounds)
        rows.append(Row("million", "ms", in_unit(samples["million"], 1e-3), 2.5))
        report |= {"million_spawn_s": facts["spawn_s"], "million_awake": facts["awake"]}
        begin("scenes")
        samples = physics.scenes(rounds)
        rows += [Row(f"plain: {name}", "ns", in_unit(values, 1e-9)) for name, values in samples.items()]
        begin("edits")
        samples = physics.edits(rounds)
        rows += [Row(name, "us", in_unit(values, 1e-6)) for name, values in samples.items()]
        begin("obstacles")
        samples, facts = physics.obstacles(rounds)
        rows += [Row(name, "ns", in_unit(values, 1e-9)) for name, values in samples.items()]
        report["obstacles_agree"] = facts["same_answers"]
        begin("calls")
        samples = physics.calls(rounds)
        rows += [Row(name, "us", in_unit(values, 1e-6)) for name, values in samples.items()]

    console.print(table(rows))
    medians = {row.name: row.median for row in rows}
    report |= {
        "walk_ns": medians["walk"],
        "walk_pairs_ns": medians["walk_pairs"],
        "rest_ns": medians["rest"],
        "million_ms_per_tick": medians["million"],
        "ratio_to_c": max((medians[name] for name in medians if name.endswith("_ratio_to_c")), default=None),
        "rows": [
            {
                "name": row.name,
                "unit": row.unit,
                "median": row.median,
                "low": min(row.samples),
                "high": max(row.samples),
                "target": row.target,
            }
            for row in rows
        ],
    }
    if _step_c.available():
        console.print(f"the same hash as the step in C: {'yes' if report['hash_equal_to_c'] else 'NO'}")
    else:
        console.print("gcc is not installed: the rows of the step in C are left out")
    console.print(f"slabs and cells give the same answers: {'yes' if report['obstacles_agree'] else 'NO'}")
    console.print(f"a million entities were spawned in {report['million_spawn_s']:.1f} s, terrain of 2 x 2 km included")
    return report, 0 if report["hash_equal_to_c"] is not False and report["obstacles_agree"] else 1


def run_bytes(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """What a client is sent, by how the others move; some of them pause, so there are more in view than move."""
    ticks, seeds = (200, 1) if args.quick else (600, 3)
    runs = [
        wire.run(motion, round(args.entities * more), ticks, seed)
        for motion, more in (("wander", 1.4), ("run-and-jump", 1.0), ("restless", 1.0))
        for seed in range(1, seeds + 1)
    ]
    made = Table("motion", "seed", title=f"bytes: one client, {args.entities} entities move in its view, 20 Hz")
    forms = {"moving": "{:.0f}", "in_view": "{:.0f}", "bytes_per_s": "{:,.0f}", "differing": "{}"}
    forms |= {"server_us_per_tick": "{:.0f}", "client_us_per_tick": "{:.0f}"}
    for name in forms:
        made.add_column(name.replace("_", " "), justify="right")
    for run in runs:
        made.add_row(run["motion"], str(run["seed"]), *(form.format(run[name]) for name, form in forms.items()))
    console.print(made)
    return {"rate": wire.RATE, "runs": runs}, int(any(run["differing"] for run in runs))


def run_memory(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """What things take, and whether anything stays of what is gone."""
    report = memory.run(args.cycles)
    for name in ("segment", "entity", "connection"):
        console.print(f"{report[f'bytes_per_{name}']:10,.0f} bytes per {name}")
    after = report["bytes_after_each_cycle"]
    console.print(f"{after[0]:10,} bytes after a cycle of churn, and in the {len(after) - 1} after it more by")
    console.print("           " + " ".join(f"{b - a:,}" for a, b in itertools.pairwise(after)))
    if sys.platform == "linux":
        apart = report["rss_bytes_per_connection"] = rss.connections(args.rounds)
        console.print(f"{statistics.median(apart):10,.0f} bytes of RSS per connection over sockets,", end=" ")
        console.print("on servers apart: " + " ".join(f"{value:,.0f}" for value in apart))
    if args.minutes:
        report["churn"] = churn = rss.churn(args.minutes, lambda minute: console.print(f"  {minute}", soft_wrap=True))
        console.print(f"{churn['slope_kb_per_minute']:+10,.1f} KB of RSS per minute of churn over sockets,", end=" ")
        console.print(f"{churn['slope_kb_per_minute_second_half']:+,.1f} in the second half")
    return report, 0


def run_entities(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """A large world, once for each seed."""
    runs = [entities.run(args.entities, args.clients, seed) for seed in range(1, args.seeds + 1)]
    made = Table("figure", title=f"entities: one in {entities.WALKS} walks, {entities.RATE} Hz, CPU time per tick")
    for number in range(1, args.seeds + 1):
        made.add_column(f"seed {number}", justify="right")
    for name in runs[0]:
        made.add_row(name, *(f"{run[name]:,.{1 if name.endswith('_ms') else 0}f}" for run in runs))
    console.print(made)
    return {"rate": entities.RATE, "runs": runs}, 0


def table(rows: list[Row]) -> Table:
    made = Table("figure", "unit", title="physics: per entity and tick, per tick, or per call")
    for heading in ("median", "range", "target"):
        made.add_column(heading, justify="right")
    for row in rows:
        target = "" if row.target is None else f"{row.target:g}"
        style = "" if row.target is None else "green" if row.median <= row.target else "red"
        scatter = f"{min(row.samples):.2f} - {max(row.samples):.2f}"
        made.add_row(row.name, row.unit, f"{row.median:.2f}", scatter, target, style=style)
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    each = argparse.ArgumentParser(add_help=False)
    each.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    command = commands.add_parser("physics", parents=[each], help="the step of the shared world")
    command.add_argument("--quick", action="store_true", help="fewer rounds")
    command.set_defaults(run=run_physics)
    command = commands.add_parser("server", parents=[each], help="clients per server process (Linux)")
    command.add_argument("--quick", action="store_true", help="one coarse search, within 45 s")
    command.add_argument(
        "--crowd", type=int, nargs="?", const=300, metavar="N", help="N players in one segment instead (300)"
    )
    command.set_defaults(run=capacity.run)
    command = commands.add_parser("bytes", parents=[each], help="what a client is sent")
    command.add_argument("--entities", type=int, default=100, metavar="N", help="how many of them move (100)")
    command.add_argument("--quick", action="store_true", help="ten seconds of one seed each")
    command.set_defaults(run=run_bytes)
    command = commands.add_parser(
        "memory", parents=[each], help="bytes per connection, entity and segment, and under churn"
    )
    command.add_argument("--cycles", type=int, default=10, metavar="N", help="of churn in process, 2 s each (10)")
    command.add_argument("--rounds", type=int, default=3, metavar="N", help="of connections over sockets (3; Linux)")
    command.add_argument("--minutes", type=float, default=0.0, metavar="M", help="of churn over sockets (none; Linux)")
    command.set_defaults(run=run_memory)
    command = commands.add_parser("entities", parents=[each], help="a tick of a large world")
    command.add_argument("--entities", type=int, default=100_000, metavar="N", help="a tenth of them walk (100,000)")
    command.add_argument("--clients", type=int, default=200, metavar="N", help="that join (200)")
    command.add_argument("--seeds", type=int, default=2, metavar="N", help="runs (2)")
    command.set_defaults(run=run_entities)
    command = commands.add_parser(
        "jitter", parents=[each], help="how late ticks are, by garbage collection and event loop (Linux)"
    )
    command.add_argument("--clients", type=int, default=200, metavar="N", help="that play (200)")
    command.add_argument("--rounds", type=int, default=4, metavar="N", help="of 10 s for each variant (4)")
    command.add_argument("--quick", action="store_true", help="one round of 3 s each, within a minute")
    command.set_defaults(run=jitter.run)
    args = parser.parse_args(argv)
    for number in (signal.SIGINT, signal.SIGTERM):  # the processes of the benchmark end as well
        signal.signal(number, signal.default_int_handler)
    try:
        report, status = args.run(args, Console())
    except RigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    if args.json and report:
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
