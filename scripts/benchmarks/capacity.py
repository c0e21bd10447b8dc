"""`bench.py server`: runs the searches of `scripts.benchmarks.server` one after the other, and prints their table."""

import argparse
import os
import statistics
from typing import Any

from rich.console import Console
from rich.table import Table

from scripts.benchmarks import server
from scripts.environment import lacking


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    seconds, resolution, steps, searches = (1.5, 0.2, 3, 1) if args.quick else (5.0, 0.04, 9, 3)
    cores = os.cpu_count() or 1
    runs: list[dict[str, Any]] = []
    bounds: list[dict[str, Any]] = []
    if args.crowd:
        return run_crowd(args, console, seconds)

    if args.picows and (reason := lacking("picows")):
        console.print(f"--picows: {reason}", highlight=False, soft_wrap=True)
        return {}, 2

    def report(stage: dict[str, Any]) -> None:
        console.print(
            f"  {stage['clients']:5} clients: {'held' if stage['held'] else 'not held'}, ticks late "
            f"{stage['tick_lateness_ms']['p99']:.1f} ms (p99), worst client {stage['snapshots_share_worst']:.0%}, "
            f"{stage['cpu_us_per_client_tick']:.1f} us, generator {stage['generator_cpu_share']:.0%}",
            highlight=False,
            soft_wrap=True,
        )

    for number in range(searches):
        load = os.getloadavg()[0]
        console.print(f"search {number + 1} of {searches}: the game (load of the machine before: {load:.1f})")
        with server.rig("game", seed=number + 1) as running:
            stages = server.search(running, 400, seconds, resolution, steps, report)
        best = server.most(stages)
        by = best or stages[-1]
        cpu_us = statistics.median(
            stage["cpu_us_per_client_tick"] for stage in stages if stage["ticks_share"] > 0.5 or stage is by
        )
        by_cpu = int(1e6 / server.RATE / cpu_us)
        most = min(by_cpu, server.CAPACITY)
        size = int(by["bytes_down_per_client_per_s"] / server.RATE)
        console.print(f"  the same gateway without a game, {size} bytes a tick")
        with server.rig("echo", str(size), seed=number + 1) as running:
            same = running.hold(by["clients"], seconds)  # many connections cost less each than few
            first = most if args.quick else 1000  # more than the game holds
            echoed = server.search(running, first, seconds, resolution, 1 if args.quick else steps, report)
        if args.picows:
            console.print("  the same on picows, without a game: the bound of another library")
            with server.rig(server.ECHO_PICOWS, str(size), seed=number + 1) as running:
                first = most // 4 if args.quick else 1000
                picows = server.search(running, first, seconds, resolution, 1 if args.quick else steps, report)
            bounds.append({"gateway": "picows", "max_clients": None, "load_before": load, **bound(picows)})
        shares = server.profile(max(50, by["clients"] // (4 if args.quick else 2)), seconds)
        runs.append(
            {
                "gateway": "websockets",
                "max_clients": best["clients"] if best else 0,
                "cpu_us_per_client_tick": cpu_us,
                "clients_by_cpu": by_cpu,
                **bound(echoed),
                "times_the_echo": by["cpu_us_per_client_tick"] / same["cpu_us_per_client_tick"],
                "parts": {name: share * cpu_us for name, share in shares.items()},
                "entities_in_view": by["entities_in_view"],
                "bytes_per_client_per_s": by["bytes_down_per_client_per_s"],
                "snapshot_age_ms": by["snapshot_age_ms"],
                "generator_cpu_share": by["generator_cpu_share"],
                "generator_late_ms": by["generator_late_ms"],
                "load_before": load,
                "stages": stages,
                "echo_stages": echoed,
            }
        )
    console.print(capacity_table(runs, bounds))
    if max(run["load_before"] for run in runs) > cores / 2:
        console.print("other processes were busy: the numbers of clients are too low, use the CPU time instead")
    return {"quick": args.quick, "rate": server.RATE, "cores": cores, "runs": runs + bounds}, 0


def bound(stages: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the figures of a server that only echoes, which are the bound for a game."""
    most = server.most(stages)
    cpu_us = statistics.median(stage["cpu_us_per_client_tick"] for stage in stages)
    return {
        "echo_bound_clients": most["clients"] if most else 0,
        "echo_cpu_us_per_client_tick": cpu_us,
        "echo_clients_by_cpu": int(1e6 / server.RATE / cpu_us),
    }


def run_crowd(args: argparse.Namespace, console: Console, seconds: float) -> tuple[dict[str, Any], int]:
    """Measures `--crowd` players in one segment, each of whom sees all others."""
    with server.rig("game", capacity=args.crowd, per_segment=args.crowd) as running:
        stage = server.packed(running.hold(args.crowd, seconds))
    made = Table("figure", title=f"server: {args.crowd} players in one segment, 30 Hz")
    made.add_column("", justify="right")
    for name, form in (
        ("held", "{}"),
        ("entities_in_view", "{:.0f}"),
        ("cpu_us_per_client_tick", "{:.1f}"),
        ("server_cpu_share", "{:.0%}"),
        ("ticks_share", "{:.1%}"),
        ("snapshots_share_worst", "{:.1%}"),
        ("fairness", "{:.3f}"),
        ("bytes_per_client_per_s", "{:,.0f}"),
        ("generator_cpu_share", "{:.0%}"),
    ):
        made.add_row(name, "" if stage[name] is None else form.format(stage[name]))
    console.print(made)
    return {"quick": args.quick, "rate": server.RATE, "crowd": stage}, 0


def capacity_table(runs: list[dict[str, Any]], bounds: list[dict[str, Any]]) -> Table:
    made = Table("figure", title="server: 30 Hz, one process; a column per search")
    for number in range(len(runs)):
        made.add_column(f"search {number + 1}", justify="right")
    for name, form in (
        ("max_clients", "{:,}"),
        ("echo_bound_clients", "{:,}"),
        ("cpu_us_per_client_tick", "{:.1f}"),
        ("echo_cpu_us_per_client_tick", "{:.1f}"),
        ("times_the_echo", "{:.2f}"),
        ("clients_by_cpu", "{:,}"),
        ("echo_clients_by_cpu", "{:,}"),
        ("entities_in_view", "{:.0f}"),
        ("bytes_per_client_per_s", "{:,.0f}"),
        ("generator_cpu_share", "{:.0%}"),
    ):
        made.add_row(name, *("" if run[name] is None else form.format(run[name]) for run in runs))
    for name, form in (("echo_cpu_us_per_client_tick", "{:.1f}"), ("echo_clients_by_cpu", "{:,}")) if bounds else ():
        made.add_row(f"picows: {name}", *(form.format(run[name]) for run in bounds))
    made.add_section()
    for part in sorted(runs[0]["parts"], key=lambda part: -runs[0]["parts"][part]):
        made.add_row(f"us in {part}", *(f"{run['parts'][part]:.2f}" for run in runs))
    return made
