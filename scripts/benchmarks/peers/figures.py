"""The figures of `bench.py peers`, from the logs of a server and of its clients. Times in seconds of one clock.

A log of inputs has, for each player, a row (number, arrival, tick or -1) per input. The number is the tick that the
input is for (ours), or its place in the order of sending (theirs).
"""

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

Figures = dict[str, float | None]


class Logs(NamedTuple):
    """The notes of a run."""

    ticks: Sequence[float]
    """Times at which the server's ticks began."""
    inputs: Mapping[str, Sequence[Sequence[float]]]
    """Rows of the server's log of inputs, by player."""
    sent: Mapping[str, Mapping[int, float]]
    """Times at which inputs were sent, by number, by player. Only these players count."""
    corrections: Mapping[str, Sequence[Sequence[float]]]
    """Corrections as (time, size in blocks), by player."""


class Name(NamedTuple):
    """The form in which a figure is shown. The lower, the better, except for those without a direction."""

    title: str
    form: str
    judged: bool = True


NAMES = {
    "corrections_per_min": Name("corrections per player and minute", "{:.2f}"),
    "correction_blocks_max": Name("largest correction, blocks", "{:.3f}"),
    "wait_ms_p50": Name("wait of an input at the server, p50, ms", "{:.0f}"),
    "wait_ms_p99": Name("wait of an input at the server, p99, ms", "{:.0f}"),
    "applied_ms_p50": Name("from sent to applied, p50, ms", "{:.0f}"),
    "applied_ms_p99": Name("from sent to applied, p99, ms", "{:.0f}"),
    "empty_share": Name("ticks of a player without an own input", "{:.2%}"),
    "burst_share": Name("ticks of a player with two inputs or more", "{:.2%}"),
    "lost_share": Name("inputs that came too late or were dropped", "{:.2%}"),
    "bytes_up": Name("bytes/s per client, up", "{:,.0f}"),
    "bytes_down": Name("bytes/s per client, down", "{:,.0f}"),
    "cpu_us": Name("CPU of the server per client and tick, us", "{:.0f}"),
    "inputs_per_s": Name("inputs/s of a client that arrived", "{:.1f}", judged=False),
    "tick_rate": Name("ticks/s of the server", "{:.2f}", judged=False),
    "in_view": Name("players that a client sees", "{:.1f}", judged=False),
    "rss_mb": Name("memory of the server, MB", "{:.0f}"),
    "speed": Name("speed of who sends two inputs per step", "{:.2f} x"),
}
"""The figures by name, in the order of the tables."""
BEHIND = 1.05
"""Ratio to the best peer from which a figure counts as behind, if the runs do not overlap."""


def quantile(values: Sequence[float], share: float) -> float | None:
    """Returns the value that a `share` of the values do not exceed; None if there are none."""
    ordered = sorted(values)
    return ordered[max(math.ceil(share * len(ordered)) - 1, 0)] if ordered else None


def played(logs: Logs, begin: float, end: float) -> Figures:
    """Returns the figures of all inputs that arrived, and all ticks that began, from `begin` to `end`."""
    within = {tick for tick, at in enumerate(logs.ticks) if begin <= at < end}
    waits, ways, empty, bursts, came, lost = [], [], 0, 0, 0, 0
    for name, sent in logs.sent.items():
        taken: Counter[int] = Counter()
        for number, arrival, tick in logs.inputs.get(name, ()):
            taken[int(tick)] += 1
            if not begin <= arrival < end or (tick < 0 and arrival > end - 2.0):
                continue  # the newest ones may still be used
            came += 1
            if tick < 0:
                lost += 1
                continue
            if int(number) in sent:  # and not an input that holds without a message of its own
                waits.append(logs.ticks[int(tick)] - arrival)
                ways.append(logs.ticks[int(tick)] - sent[int(number)])
        empty += sum(taken[tick] == 0 for tick in within)
        bursts += sum(taken[tick] > 1 for tick in within)
    arrived = sum(begin <= row[1] < end for rows in logs.inputs.values() for row in rows)
    sizes = [size for rows in logs.corrections.values() for at, size in rows if begin <= at < end]
    players = max(len(logs.sent), 1)
    ticks = max(players * len(within), 1)
    return {
        "corrections_per_min": len(sizes) / players / (end - begin) * 60,
        "correction_blocks_max": max(sizes, default=None),
        "wait_ms_p50": in_ms(quantile(waits, 0.5)),
        "wait_ms_p99": in_ms(quantile(waits, 0.99)),
        "applied_ms_p50": in_ms(quantile(ways, 0.5)),
        "applied_ms_p99": in_ms(quantile(ways, 0.99)),
        "empty_share": empty / ticks,
        "burst_share": bursts / ticks,
        "lost_share": lost / max(came, 1),
        "inputs_per_s": arrived / max(len(logs.inputs), 1) / (end - begin),
    }


def in_ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def served(before: Mapping[str, Any], after: Mapping[str, Any], clients: int) -> Figures:
    """Returns the figures of two reports of a server."""
    ticks = max(after["ticks"] - before["ticks"], 1)
    return {
        "cpu_us": (after["cpu_s"] - before["cpu_s"]) * 1e6 / ticks / clients,
        "tick_rate": ticks / (after["now"] - before["now"]),
        "rss_mb": after["rss_mb"],
        "in_view": after["in_view"],
    }


def carried(before: Mapping[str, int], after: Mapping[str, int], clients: int, seconds: float) -> Figures:
    """Returns the figures of two reports of the proxy: bytes of TCP per client and second."""
    return {f"bytes_{way}": (after[way] - before[way]) / clients / seconds for way in ("up", "down")}


def speed(before: Mapping[str, Any], after: Mapping[str, Any]) -> float:
    """Returns the way of player 0 in relation to that of player 1, who sends one input per step."""
    greedy, honest = (after["walked"][name] - before["walked"][name] for name in ("p0", "p1"))
    return float(greedy / max(honest, 1e-9))


def found(runs: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    """Returns the values of a figure in the runs that have it."""
    return [run["figures"][name] for run in runs if run["figures"].get(name) is not None]


def shown(runs: Sequence[Mapping[str, Any]], name: str) -> str:
    """Returns a figure as text: its median, and its range if there are several runs. A dash: no run has it."""
    values, form = found(runs, name), NAMES[name].form
    if not values:
        return "-"
    text = form.format(statistics.median(values))
    low, high = form.format(min(values)), form.format(max(values))
    return text if low == high else f"{text} ({low} - {high})"


def behind(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the figures in which ours is behind the best peer: by more than 5 %, and in every run."""
    lines = []
    for scenario in dict.fromkeys(run["scenario"] for run in runs):
        mine = [run for run in runs if run["scenario"] == scenario]
        ours = [run for run in mine if run["side"] == "ours"]
        for name in (name for name in NAMES if NAMES[name].judged):
            values = found(ours, name)
            for side in dict.fromkeys(run["side"] for run in mine if run["side"] != "ours"):
                theirs = [run for run in mine if run["side"] == side]
                others = found(theirs, name)
                if values and others and min(values) > BEHIND * max(others):
                    text = f"{shown(ours, name)} against {shown(theirs, name)} of {side}"
                    lines.append(f"{scenario}: {NAMES[name].title}: {text}")
    return lines
