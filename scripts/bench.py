"""Benchmarks: figures with their scatter, and ratios taken in one run.

`physics` times the compiled step on crowds, beside the same step in C, which it builds and which must reach the
same hash. A figure is the median of repeated runs, its range beside it. Two busy cores scatter by a third.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import _bench_physics as physics
import _step_c
from _crowds import Samples
from shared import kernels


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


def run_physics(args: argparse.Namespace, console: Console) -> int:
    if not kernels.available():
        console.print("error: Numba is not installed; the benchmark times the compiled step")
        return 2
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
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0 if report["hash_equal_to_c"] is not False and report["obstacles_agree"] else 1


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
    command = commands.add_parser("physics", help="the step of the shared world")
    command.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    command.add_argument("--quick", action="store_true", help="fewer rounds")
    command.set_defaults(run=run_physics)
    args = parser.parse_args(argv)
    return int(args.run(args, Console()))


if __name__ == "__main__":
    sys.exit(main())
