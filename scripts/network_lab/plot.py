"""Draws the picture of the network lab: the figures per link, and the league of lead controllers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

INK, BLUE, ORANGE, GREY = "#222222", "#1f6fb2", "#d9731a", "#9aa3ab"
MARKS = "osD^vPX"


def draw(presets: dict[str, dict[str, Any]], league: list[dict[str, Any]], out: Path) -> None:
    """Writes a PNG: four bars per link at the top, late inputs against added latency below."""
    links = [name for name in presets if any(row["preset"] == name for row in league)]
    columns = max(len(links), 4)
    figure = plt.figure(figsize=(2.6 * columns, 6.4 if links else 3.2), layout="constrained")
    grid = figure.add_gridspec(2 if links else 1, columns)
    bars: tuple[tuple[str, Callable[[dict[str, Any]], float]], ...] = (
        ("late inputs, %", lambda row: 100 * row["late_inputs_share"]),
        ("corrections per minute", lambda row: row["corrections_per_minute"]),
        ("snapshot age p99, ms", lambda row: row["snapshot_age_ms"]["p99"]),
        ("lead p50, ms", lambda row: row["lead_ms"]["p50"]),
    )
    width = columns // 4
    for i, (title, value) in enumerate(bars):
        axes = figure.add_subplot(grid[0, i * width : (i + 1) * width])
        values = [value(row) for row in presets.values()]
        axes.barh(list(presets), values, color=BLUE)
        for y, number in enumerate(values):
            axes.text(number, y, f" {number:.3g}", va="center", fontsize=8, color=INK)
        axes.set_title(title, fontsize=10)
        axes.invert_yaxis()
        axes.margins(x=0.2)
        axes.spines[["top", "right"]].set_visible(False)
    for i, link in enumerate(links):
        axes = figure.add_subplot(grid[1, i])
        rows = [row for row in league if row["preset"] == link and row["late_inputs_share"] < 0.5]
        for mark, row in zip(MARKS * 2, rows, strict=False):
            ours = row["controller"] == "ours"
            axes.scatter(
                100 * row["late_inputs_share"], row["added_latency_ms"], marker=mark, zorder=3 if ours else 2,
                s=70 if ours else 34, color=ORANGE if ours else GREY, label=row["controller"],
            )  # fmt: skip
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_xlim(left=-0.05)
        axes.set_title(link, fontsize=10)
        axes.set_xlabel("late inputs, %", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        if i == 0:
            axes.set_ylabel("added latency, ms", fontsize=8)
        if i == len(links) - 1:
            axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(out, dpi=130)
    plt.close(figure)
