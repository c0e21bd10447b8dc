"""Compares lead controllers: late inputs against added latency, per link, in simulated time.

A trial has no physics (`scripts.experiments.lead_trial`). Its *oracle* is the least constant lead that would have had
the same share of late inputs.

    added latency   mean lead of an input over the server's true time when it was made, minus half the round trip
    fair            only inputs for which a controller could prepare: not those made during a spike or the 250 ms after
                    it, or in a dip's first second
    above           latency added beyond the oracle, over the fair inputs
    it needs        latency that the other controller would add at our late share, with its best setting for this run
    ours then       latency that ours would add at the other's late share, with its best setting for this run
    front           no other controller has both fewer late inputs and less latency

Our controller is compared at its default setting, which is the same on every link. A setting chosen from the run that
it is judged by is better than any that is possible in practice, so both columns favour the controller that is set. With
`--seeds`, the latency that a rule needs at our late share is compared with ours on each run, because one run of ten
minutes decides it only to within a few ms.
"""

import argparse
import json
import math
import statistics
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path as File

from rich import box
from rich.console import Console
from rich.table import Table

from client_sdk.netsim.links import PRESETS
from client_sdk.timing.lead import SAFETY_S, STALL_S
from scripts.experiments.controllers import RIVALS
from scripts.experiments.lead_trial import OURS, RATE, TICK_MS, Row, trial
from shared.priced import PRICE_S

TIE_MS = 0.1 * TICK_MS
SHARE_MAX = 0.5
"""Share of late inputs from which a controller is not compared, because it does not try to be on time."""
LONG_S = 4.0
"""Longest stall, in seconds, as a setting of our controller with which it treats the presets' spikes as stalls."""
SEARCH = 8
"""Trials per search for another controller's setting."""


def run(preset: str, minutes: float, seed: int) -> list[Row]:
    """Runs every controller on one link. Returns the rows of `Trial.row`, ours first, and in each further

    its_latency_ms      latency that it would add at our late share; None: it cannot reach it, or has no setting
    first               ours adds less than that, or the same within `TIE_MS`
    equal_latency_ms    latency that ours would add at its late share; None beyond the curve
    beaten              ours adds less at that share, or the same within `TIE_MS`
    on_front            no other controller has both fewer late inputs and less latency
    """
    rows = [trial(preset, name, minutes, seed) for name in (OURS, *RIVALS)]
    ours = rows[0]
    points = [point(ours)] + [point(trial(preset, OURS, minutes, seed, setting)) for setting in settings(preset)]
    for row in rows:
        late, added = point(row)
        its = added if row is ours else set_to(row, ours, minutes)
        equal = curve(points, late)
        row["its_latency_ms"] = its
        row["first"] = its is None or ours["added_latency_ms"] <= its + TIE_MS
        row["equal_latency_ms"] = equal
        row["beaten"] = equal is not None and equal <= added + TIE_MS
        row["on_front"] = not any(
            other is not row and all(a <= b for a, b in zip(point(other), (late, added), strict=True)) for other in rows
        )
    return rows


def set_to(row: Row, ours: Row, minutes: float) -> float | None:
    """Returns the latency that another controller adds with the least safety at which it is no later than ours.

    It may switch between two settings (`curve`). None: no setting reaches our late share.
    """
    best: list[float] = []
    for spread in RIVALS[row["controller"]].spreads:
        points = [point(row)]
        least = -row["added_latency_ms"] / TICK_MS
        most = least + 2 * ours["added_latency_ms"] / TICK_MS + 2.0
        for _ in range(SEARCH):
            more = (least + most) / 2
            points.append(point(trial(row["preset"], row["controller"], minutes, row["seed"], (more, spread))))
            least, most = (least, more) if points[-1][0] <= ours["late_inputs_share"] else (more, most)
        found = curve(points, ours["late_inputs_share"])
        best += [] if found is None else [found]
    return min(best, default=None)


def settings(preset: str) -> list[tuple[float, float, float]]:
    """Returns settings to try ours with: price, safety and longest stall in seconds, from careless to careful."""
    ticks = [(price, SAFETY_S * RATE) for price in (3.0, 10.0, 30.0, 80.0, 600.0, 2000.0)]
    ticks += [(PRICE_S * RATE, 0.08), (PRICE_S * RATE, 0.15)]
    ticks += [(2000.0, safety) for safety in (0.3, 0.6, 1.0, 1.5, 2.0)]
    found = [(price / RATE, safety / RATE) for price, safety in ticks]
    stalls = (STALL_S, LONG_S) if PRESETS[preset].spike else (STALL_S,)
    return [(*one, stall_s) for one in found for stall_s in stalls]


def curve(points: list[tuple[float, float]], late: float) -> float | None:
    """Returns the least latency at a late share, where a controller may switch between the settings of two points."""
    under = [point for point in points if point[0] <= late]
    over = [point for point in points if point[0] > late]
    between = [a + (b - a) * (late - x) / (y - x) for x, a in under for y, b in over]
    if not under or late >= SHARE_MAX:
        return None
    return min([*between, *(added for _, added in under)])


def point(row: Row) -> tuple[float, float]:
    """Returns the late share and the added latency of a row."""
    return row["late_inputs_share"], row["added_latency_ms"]


def table(rows: list[Row]) -> Table:
    """Returns the rows of `run` as a table for people. Latencies are in ms."""
    result = Table(title="Lead controllers: late inputs against added latency (ms)", box=box.SIMPLE_HEAD)
    for column in ("preset", "controller"):
        result.add_column(column, no_wrap=True)
    for column in ("late %", "added", "p99", "oracle", "it needs", "ours then", "fair %", "above", "front"):
        result.add_column(column, justify="right", no_wrap=True)
    preset = ""
    for row in rows:
        if preset != row["preset"]:
            result.add_section()
        its, equal, ours = row["its_latency_ms"], row["equal_latency_ms"], row["controller"] == OURS
        result.add_row(
            "" if preset == row["preset"] else row["preset"],
            row["controller"],
            f"{100 * row['late_inputs_share']:.2f}",
            *(f"{row[name]:.1f}" for name in ("added_latency_ms", "added_latency_p99_ms", "oracle_latency_ms")),
            "" if ours or its is None else f"{its:.1f} {'>' if row['first'] else '<'}",
            "" if ours or equal is None else f"{equal:.1f} {'<' if row['beaten'] else '>'}",
            f"{100 * row['fair_late_share']:.2f}",
            f"{row['fair_latency_ms'] - row['fair_oracle_ms']:.1f}",
            "*" if row["on_front"] else "",
            style="bold" if ours else "",
        )
        preset = row["preset"]
    return result


def summary(rows: list[Row]) -> Table:
    """Returns a table of means over the seeds, and of how much less ours adds than each other at our late share."""
    result = Table(title="At our late share: added latency (ms), means over the seeds", box=box.SIMPLE_HEAD)
    for column in ("preset", "controller"):
        result.add_column(column, no_wrap=True)
    for column in ("late %", "added", "it needs", "ours is less by", "at least", "seeds"):
        result.add_column(column, justify="right", no_wrap=True)
    ours = {(row["preset"], row["seed"]): row["added_latency_ms"] for row in rows if row["controller"] == OURS}
    for preset, controller in dict.fromkeys((row["preset"], row["controller"]) for row in rows):
        group = [row for row in rows if (row["preset"], row["controller"]) == (preset, controller)]
        able = [row for row in group if row["its_latency_ms"] is not None]
        less = [row["its_latency_ms"] - ours[preset, row["seed"]] for row in able]
        named = (f"{100 * mean(group, 'late_inputs_share'):.2f}", f"{mean(group, 'added_latency_ms'):.1f}")
        if controller == OURS or len(able) < 2:
            result.add_row(preset, controller, *named, style="bold" if controller == OURS else "")
            continue
        scatter = f"{statistics.mean(less):.1f} ± {statistics.stdev(less) / math.sqrt(len(less)):.1f}"
        needs = f"{mean(able, 'its_latency_ms'):.1f}"
        result.add_row(preset, controller, *named, needs, scatter, f"{min(less):.1f}", str(len(able)))
    return result


def mean(rows: list[Row], name: str) -> float:
    return float(statistics.mean(row[name] for row in rows))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=PRESETS, action="append", help="play only on this link; may be repeated")
    parser.add_argument("--minutes", type=float, default=10, help="simulated time per trial (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="first seed (default: %(default)d)")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds, from --seed on (default: %(default)d)")
    parser.add_argument("--json", type=File, metavar="OUT", help="write the rows to this file")
    chosen = parser.parse_args()
    names = chosen.preset or list(PRESETS)
    seeds = range(chosen.seed, chosen.seed + max(chosen.seeds, 1))
    with ProcessPoolExecutor() as pool:
        done = [pool.submit(run, name, chosen.minutes, seed) for name in names for seed in seeds]
        rows = [row for job in done for row in job.result()]
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    told = f"seed {chosen.seed}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    console.print(table(rows) if len(seeds) == 1 else summary(rows), f"{told}, {chosen.minutes:g} minutes each")
    if chosen.json:
        chosen.json.write_text(json.dumps({"seed": chosen.seed, "league": rows}, indent=1) + "\n")
    return 0
