"""Measures the speed and the errors of the choices in the physics, in one run.

It varies number format, integrator, tick rate, mover, obstacles and executor, one at a time around the product's
choice, and adds a few combinations that other engines use. Rows of the product run its own world. The others run
variants of the step that exist only for this report. Lengths are in blocks. An error of 0 is exactly 0.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from scripts.environment import lacking
from scripts.experiments.conclusion import Row, conclusion
from scripts.experiments.engines import Choice
from shared import kernels

PRODUCT = Choice(product=True)
PLAIN = Choice(product=True, executor="plain")
RATES = (20, 30, 60, 64, 128)

GROUPS: dict[str, list[Choice]] = {
    "the product": [PRODUCT],
    "number format": [Choice(name) for name in ("float32", "float64", "grid 2^-16", "grid 2^-20", "grid 2^-24")]
    + [Choice(name, tick_rate=128) for name in ("grid 2^-16", "grid 2^-20")],
    "integrator": [
        Choice(integrator=integrator, tick_rate=rate, product=integrator == "semi")
        for integrator in ("semi", "explicit")
        for rate in (20, 32, 64, 128)
    ],
    "tick rate": [Choice(tick_rate=rate, product=True) for rate in RATES],
    "mover": [Choice(mover="rewind"), Choice(mover="impact")],
    "obstacles": [Choice(obstacles="slabs")],
    "executor": [PLAIN],
    "what others do": [
        Choice("float64", "semi", mover="rewind", obstacles="slabs"),
        Choice("float64", "semi", 60),
        Choice("float32", "semi", 60),
        Choice("float32", "semi", 60, "impact"),
    ],
}
"""Rows by what they vary. The first row of the last group is the seed's proposal, taken literally."""

COLUMNS = {
    "ns": "ns per step",
    "apex_error": "apex",
    "landing_error_ms": "landing, ms",
    "minute_error": "after 1 min",
    "inside_share": "inside",
    "inside_depth": "depth",
    "tangential_lost": "wall loss",
    "error_1e6": "at 10^6",
    "error_1e7": "at 10^7",
    "corrections_per_minute": "corr./min",
}
SHARES = ("inside_share", "tangential_lost")


def run(progress: Progress, *, quick: bool) -> list[Row]:
    from scripts.experiments import errors  # compiles the variants

    choices = [(group, choice) for group, members in GROUPS.items() for choice in members]
    task = progress.add_task("speed", total=len(choices) + 1)
    times = errors.ns([choice for _, choice in choices], *((300, 9) if quick else (2000, 61)))
    progress.advance(task)
    rows = []
    for (group, choice), samples in zip(choices, times, strict=True):
        progress.update(task, description=label(asdict(choice)))
        figures = errors.measure(choice, quick=quick)
        scatter = {"ns": errors.middle(samples), "ns_low": min(samples), "ns_high": max(samples)}
        rows.append({"group": group, **asdict(choice), **scatter, **figures})
        progress.advance(task)
    return rows


def label(row: Row) -> str:
    """Returns in words what a row changes."""
    usual = asdict(Choice())
    words = [row["format"]] if row["format"] != usual["format"] else []
    words += [row[key] for key in ("integrator", "mover", "obstacles", "executor") if row[key] != usual[key]]
    words += [f"{row['tick_rate']} Hz"] if row["tick_rate"] != usual["tick_rate"] else []
    return ", ".join(words) or ("the product" if row["product"] else "the same, as a variant")


def shown(column: str, value: float) -> str:
    """Returns a number as a short text. A wall loss below the precision of a double is shown as 0."""
    if value == 0 or (column == "tangential_lost" and abs(value) < 1e-4):
        return "0"
    if column in SHARES:
        return f"{value:.1%}" if abs(value) >= 0.001 else f"{value:.0e}"
    if column == "ns":
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.0e}"


def table(rows: list[Row]) -> Table:
    made = Table("choice", title="speed against error (lengths in blocks)", padding=(0, 1), collapse_padding=True)
    for heading in COLUMNS.values():
        made.add_column(heading, justify="right", no_wrap=True)
    group = ""
    for row in rows:
        if row["group"] != group:
            made.add_section()
            group = row["group"]
        style = "bold green" if row["group"] == "the product" else ""
        made.add_row(label(row), *(shown(column, row[column]) for column in COLUMNS), style=style)
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all rows to this file")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw the report's picture")
    parser.add_argument("--quick", action="store_true", help="fewer players, for less time")
    args = parser.parse_args(argv)
    console = Console()
    if not kernels.numba_installed():
        console.print("error: Numba is not installed; this report compiles its variants with it")
        return 2
    if args.plot and (why := lacking("matplotlib")):
        console.print(f"error: --plot: {why}", highlight=False, markup=False, soft_wrap=True)
        return 2
    with Progress(console=console, transient=True) as progress:
        rows = run(progress, quick=args.quick)
    (console if console.width >= 130 else Console(width=130)).print(table(rows))
    text = conclusion(rows)
    console.print(text, highlight=False)
    if args.json:
        args.json.write_text(
            json.dumps({"quick": args.quick, "rows": rows, "conclusion": text}, indent=1) + "\n", "utf-8"
        )
    if args.plot:
        from scripts.experiments.picture import draw

        draw(rows, args.plot)
    return 0
