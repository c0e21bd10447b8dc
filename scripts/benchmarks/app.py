"""Runs a benchmark and prints its figures with their scatter. Ratios compare measurements of one run.

`physics` times the compiled step on crowds, and the same step in C, which it builds and which must reach the same hash.
A figure is the median of repeated runs, with its range. Two busy cores scatter by a third.

`server` searches for the most clients that one server process holds at 30 Hz, all wandering over hills with about 50
entities in view, and for the most that the same gateway holds without a game. It needs an idle machine, because other
processes make ticks late. It also prints the CPU time per client and tick, how many times the echo's with as many
clients that is, and the number of clients that it allows. A search takes about three minutes.
`server --crowd` puts 300 players (or N) into one segment instead, where each sees all others. Its fairness is the share
of snapshots of the worst served player over that of the best served one.

`jitter` measures how late the ticks of a server with 200 clients begin and how long they take, in turns with the
product's garbage collection and event loop and with others.

`bytes` measures the bytes that the server sends to one client at 20 Hz while 100 entities (or N) move in its view, and
checks that the client's copy of them is exact in every tick.

`memory` measures the bytes per connection, entity and loaded segment, and the bytes in use after each cycle of churn.
It also measures the RSS of a server process over sockets: between 200 and 400 clients, and in --minutes of churn.

`entities` measures the CPU time of a tick with 100,000 entities, a tenth of which walk, before, while and after 200
clients join.

`abilities` plays one game with a dash that clients predict (a behaviour), and with one that waits for the server (a
command that changes the template), in simulated time. It counts the frames until a player sees its dash, corrections,
and bytes. It also measures a replay of ten ticks of a lone player, with a behaviour and without.

`frame` measures the time that a client takes for a frame with 50 other players in view, in simulated time.

`joins` measures the server's CPU time for a join, with its first snapshot and terrain, until 200 clients play.

`worlds` searches for the most worlds of four players each that one server process holds at 30 Hz, and measures what an
empty world costs (memory, CPU time), and the time from asking for a match to playing in a new world.

`scale` measures what a world on many processes costs beside one process: CPU time per client on an edge, per player in
a replica and in the sequencer, bytes and latency of the bus, and the time to take over.

`peers` plays Colyseus 0.18 (installed from npm into build/) and this project in turn, with their own clients over the
same line, and says where this project is behind. One run takes about ten minutes.
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

from scripts.benchmarks import (
    abilities,
    capacity,
    entities,
    frame,
    jitter,
    joins,
    memory,
    physics,
    rss,
    scale,
    step_c,
    wire,
    worlds,
)
from scripts.benchmarks.crowds import Samples
from scripts.benchmarks.peers import app as peers
from scripts.benchmarks.server import RigError
from shared import kernels

Report = dict[str, Any]
"""Figures of a command, which `--json` writes; empty if the command could not run. A command also returns a status."""


class Row(NamedTuple):
    """A row of the table: the samples in `unit`, and the target for their median, which is an upper limit."""

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
    """Returns our time over that of the step in C, round by round."""
    return [ours / theirs for ours, theirs in zip(samples["ours"], samples["c"], strict=True)]


def run_physics(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    if not kernels.available():
        console.print("error: no prebuilt kernel and no Numba here; the benchmark times the compiled step")
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
    if step_c.available():
        console.print(f"the same hash as the step in C: {'yes' if report['hash_equal_to_c'] else 'NO'}")
    else:
        console.print("gcc is not installed: no rows for the step in C")
    console.print(f"slabs and cells give the same answers: {'yes' if report['obstacles_agree'] else 'NO'}")
    console.print(f"a million entities were spawned in {report['million_spawn_s']:.1f} s, terrain of 2 x 2 km included")
    return report, 0 if report["hash_equal_to_c"] is not False and report["obstacles_agree"] else 1


def run_bytes(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """Runs `bytes`, for each kind of motion. More entities are in view than move, because some pause."""
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
    """Runs `memory`: in one process, over sockets, and under churn over sockets if --minutes is given."""
    report = memory.run(args.cycles)
    for name in ("segment", "entity", "connection"):
        console.print(f"{report[f'bytes_per_{name}']:10,.0f} bytes per {name}")
    after = report["bytes_after_each_cycle"]
    console.print(
        f"{after[0]:10,} bytes in use after a cycle of churn; further bytes in each of the {len(after) - 1} after it:"
    )
    console.print("           " + " ".join(f"{b - a:,}" for a, b in itertools.pairwise(after)))
    if sys.platform == "linux":
        apart = report["rss_bytes_per_connection"] = rss.connections(args.rounds)
        console.print(f"{statistics.median(apart):10,.0f} bytes of RSS per connection over sockets,", end=" ")
        console.print("per server: " + " ".join(f"{value:,.0f}" for value in apart))
    if args.minutes:
        report["churn"] = churn = rss.churn(args.minutes, lambda minute: console.print(f"  {minute}", soft_wrap=True))
        console.print(f"{churn['slope_kb_per_minute']:+10,.1f} KB of RSS per minute of churn over sockets,", end=" ")
        console.print(f"{churn['slope_kb_per_minute_second_half']:+,.1f} in the second half")
    return report, 0


def run_entities(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """Runs `entities` once for each seed."""
    runs = [entities.run(args.entities, args.clients, seed) for seed in range(1, args.seeds + 1)]
    made = Table("figure", title=f"entities: one in {entities.WALKS} walks, {entities.RATE} Hz, CPU time per tick")
    for number in range(1, args.seeds + 1):
        made.add_column(f"seed {number}", justify="right")
    for name in runs[0]:
        made.add_row(name, *(f"{run[name]:,.{1 if name.endswith('_ms') else 0}f}" for run in runs))
    console.print(made)
    return {"rate": entities.RATE, "runs": runs}, 0


def run_abilities(args: argparse.Namespace, console: Console) -> tuple[Report, int]:
    """Runs `abilities`, both ways at each latency."""
    runs = [
        abilities.run(commands, rtt, args.players, args.seconds, args.seed)
        for rtt in abilities.RTTS_MS
        for commands in (False, True)
    ]
    made = Table("RTT ms", "a dash is", title=f"abilities: {args.players} players, {args.seconds:g} s, 60 frames/s")
    forms = {"dashes": "{}", "frames": "{:g}", "frames_p95": "{:g}", "corrections_per_min": "{:.1f}"}
    forms |= {"bytes_down_per_s": "{:,.0f}", "bytes_up_per_s": "{:,.0f}"}
    for name in ("dashes", "frames", "p95", "corr./min", "B/s down", "B/s up"):
        made.add_column(name, justify="right")
    for run in runs:
        made.add_row(f"{run['rtt_ms']}", run["way"], *(form.format(run[name]) for name, form in forms.items()))
    console.print(made)
    replays = {
        way: abilities.replay_us(commands, 5, args.seed) for way, commands in (("behaviour", False), ("none", True))
    }
    for way, samples in replays.items():
        scatter = f"{min(samples):.0f} - {max(samples):.0f}"
        console.print(f"replay of 10 ticks of a lone player, {way}: {statistics.median(samples):.0f} us ({scatter})")
    return {"runs": runs, "replay_us": replays}, 0


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


def parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    each = argparse.ArgumentParser(add_help=False)
    each.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    command = commands.add_parser("physics", parents=[each], help="time of the step")
    command.add_argument("--quick", action="store_true", help="fewer rounds")
    command.set_defaults(run=run_physics)
    command = commands.add_parser("server", parents=[each], help="clients per server process (Linux)")
    command.add_argument("--quick", action="store_true", help="one coarse search, within 45 s")
    command.add_argument("--picows", action="store_true", help="measure another library's echo, too")
    command.add_argument(
        "--crowd",
        type=int,
        nargs="?",
        const=300,
        metavar="N",
        help="put N players into one segment instead (default: 300)",
    )
    command.set_defaults(run=capacity.run)
    command = commands.add_parser("bytes", parents=[each], help="bytes that a client receives")
    command.add_argument("--entities", type=int, default=100, metavar="N", help="entities that move (default: 100)")
    command.add_argument("--quick", action="store_true", help="ten seconds of one seed per kind of motion")
    command.set_defaults(run=run_bytes)
    command = commands.add_parser(
        "memory", parents=[each], help="bytes per connection, entity and segment, and under churn"
    )
    command.add_argument(
        "--cycles", type=int, default=10, metavar="N", help="cycles of churn in one process, 2 s each (default: 10)"
    )
    command.add_argument(
        "--rounds", type=int, default=3, metavar="N", help="rounds of connections over sockets (default: 3; Linux)"
    )
    command.add_argument(
        "--minutes", type=float, default=0.0, metavar="M", help="minutes of churn over sockets (default: none; Linux)"
    )
    command.set_defaults(run=run_memory)
    command = commands.add_parser("entities", parents=[each], help="time of a tick of a large world")
    command.add_argument(
        "--entities", type=int, default=100_000, metavar="N", help="entities, a tenth of which walk (default: 100,000)"
    )
    command.add_argument("--clients", type=int, default=200, metavar="N", help="clients that join (default: 200)")
    command.add_argument("--seeds", type=int, default=2, metavar="N", help="number of runs (default: 2)")
    command.set_defaults(run=run_entities)
    command = commands.add_parser(
        "jitter", parents=[each], help="lateness of ticks, by garbage collection and event loop (Linux)"
    )
    command.add_argument("--clients", type=int, default=200, metavar="N", help="clients that play (default: 200)")
    command.add_argument(
        "--rounds", type=int, default=4, metavar="N", help="rounds of 10 s for each variant (default: 4)"
    )
    command.add_argument("--quick", action="store_true", help="one round of 3 s each, within a minute")
    command.set_defaults(run=jitter.run)
    command = commands.add_parser("abilities", parents=[each], help="a dash that is predicted, and one that is not")
    command.add_argument("--players", type=int, default=10, metavar="N", help="players (default: 10)")
    command.add_argument("--seconds", type=float, default=120.0, metavar="S", help="simulated seconds (default: 120)")
    command.add_argument("--seed", type=int, default=1, metavar="N", help="seed (default: 1)")
    command.set_defaults(run=run_abilities)
    command = commands.add_parser("worlds", parents=[each], help="worlds per server process (Linux)")
    command.add_argument("--quick", action="store_true", help="one step of few worlds, within a minute")
    command.set_defaults(run=worlds.run)
    command = commands.add_parser("scale", parents=[each], help="one world on many processes, on a NATS server")
    command.add_argument("--quick", action="store_true", help="one short round, within two minutes")
    command.add_argument("--players", type=int, default=150, help="most players (default: %(default)s)")
    command.set_defaults(run=scale.run)
    peers.add(commands, each)
    frame.add(commands, each)
    joins.add(commands, each)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
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
