"""`bench.py jitter`: how late ticks begin and how long they take, for variants of garbage collection and event loop.

Each round starts a server process per variant, in turn, under steady load from simple clients. The rounds are repeated,
so that other work on the machine affects all variants alike. The product freezes all objects that exist after the
start, so that no collection visits them again. Lateness is measured by the clock and includes the effect of other
processes. All other times are CPU time of the server's thread. Quantiles are taken over the samples of all rounds
together.
"""

import argparse
import statistics
from collections import Counter
from typing import Any

from rich.console import Console
from rich.table import Table

from scripts.benchmarks import server
from server.observability.histogram import between

VARIANTS = {
    "product": "product",
    "default": "not frozen",
    "off": "no collector",
    "asyncio": "asyncio's loop",
}
TIMES = {
    "tick_lateness": "tick late by",
    "tick_cpu": "tick takes",
    "before_step_cpu": "until its step",
    "collection_cpu": "collection",
}
FIGURES = {
    "full_collection_ms": ("full collection", 1.0, "{:.1f}"),
    "collections_cpu_share": ("collections, %", 1e2, "{:.3f}"),
    "collections_per_s": ("and per s", 1.0, "{:.1f}"),
    "cpu_us_per_client_tick": ("us/client and tick", 1.0, "{:.1f}"),
    "rss_mb": ("memory in MB", 1.0, "{:.0f}"),
}
"""Title, factor and format of each figure."""
Figures = dict[str, Any]


def measure(kind: str, clients: int, seconds: float, seed: int) -> Figures:
    """Runs one round of one variant. Returns its figures."""
    with server.rig(kind, seed=seed, capacity=clients) as running:
        held = running.hold(clients, seconds)
        return held | {
            "full_collection_ms": running.collect() * 1e3,  # too rare to occur within a round of a few seconds
            "collections_cpu_share": held["collections_cpu_s"] / held["seconds"],
            "collections_per_s": held["collections"] / held["seconds"],
        }


def summary(rounds: list[Figures]) -> Figures:
    """Returns a variant's figures: quantiles over the samples of all rounds, and those of each round."""
    found: Figures = {}
    for name in TIMES:
        counts: Counter[int] = Counter()
        for each in rounds:
            counts.update(dict(each[f"{name}_counts"]))
        found[f"{name}_ms"] = between([], sorted(counts.items()))
        apart = [between([], each[f"{name}_counts"]) for each in rounds]
        found[f"{name}_ms_of_rounds"] = {q: [each[q] for each in apart] for q in found[f"{name}_ms"]}
    found |= {name: [each[name] for each in rounds] for name in FIGURES}
    found["snapshots_share_worst"] = min(each["snapshots_share_worst"] for each in rounds)
    found["generator_cpu_share"] = max(each["generator_cpu_share"] for each in rounds)
    return found


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    rounds, seconds = (1, 3.0) if args.quick else (args.rounds, 10.0)
    stages: dict[str, list[Figures]] = {kind: [] for kind in VARIANTS}
    for number in range(rounds):
        turn = number % len(VARIANTS)  # another variant is the first in each round, when the machine may be cooler
        for kind in [*VARIANTS][turn:] + [*VARIANTS][:turn]:
            stages[kind].append(measure(kind, args.clients, seconds, number + 1))
            console.print(f"round {number + 1} of {rounds}: {VARIANTS[kind]}", highlight=False)
    report = {kind: summary(found) for kind, found in stages.items()}
    console.print(table(report, args.clients, rounds, seconds))
    told = {"clients": args.clients, "rate": server.RATE, "seconds": seconds, "variants": report, "rounds": stages}
    return told, 0


def table(report: dict[str, Figures], clients: int, rounds: int, seconds: float) -> Table:
    title = f"jitter: {clients} clients at {server.RATE} Hz, {rounds} x {seconds:g} s each"
    made = Table("ms (of each round)", title=title)
    for kind in report:
        made.add_column(VARIANTS[kind], justify="right")

    def cell(value: float, apart: list[float], form: str) -> str:
        return f"{form.format(value)} ({form.format(min(apart))} - {form.format(max(apart))})"

    for name, what in TIMES.items():
        for q in ("p50", "p99", "max"):
            values = [(f[f"{name}_ms"][q], f[f"{name}_ms_of_rounds"][q]) for f in report.values()]
            made.add_row(f"{what}, {q}", *(cell(*value, "{:.2f}") for value in values))
        made.add_section()
    for name, (what, factor, form) in FIGURES.items():
        apart = [[value * factor for value in figures[name]] for figures in report.values()]
        made.add_row(what, *(cell(statistics.median(each), each, form) for each in apart))
    return made
