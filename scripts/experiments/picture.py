"""Draws the picture of the accuracy report."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from scripts.experiments.conclusion import Row

OURS, OTHER, FAINT, INK = "#0b7a75", "#c8553d", "#b9b4ad", "#2b2d33"
NAMES = {"rewind": "back along the velocity", "impact": "time of impact", "clamp": "clamp per axis"}


def draw(rows: list[Row], path: Path) -> None:
    figure = Figure(figsize=(13, 9), dpi=150, facecolor="white")
    (speed, apex), (formats, movers) = figure.subplots(2, 2, width_ratios=(1.15, 1))
    figure.subplots_adjust(left=0.09, right=0.97, top=0.88, bottom=0.075, wspace=0.33, hspace=0.36)
    figure.text(0.018, 0.955, "Speed against error", fontsize=19, fontweight="bold", color=INK)
    figure.text(0.262, 0.957, "the product, and what it could have been", fontsize=13, color=INK)
    _speed(speed, rows)
    _apex(apex, rows)
    _formats(formats, rows)
    _movers(movers, rows)
    for axes in (speed, apex, formats, movers):
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(FAINT)
        axes.tick_params(colors=INK, labelsize=10)
        axes.xaxis.label.set(color=INK, fontsize=10.5)
        axes.yaxis.label.set(color=INK, fontsize=10.5)
    figure.savefig(path)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=12.5, color=INK, fontweight="bold", pad=10)


def worst(row: Row) -> float:
    """Returns the largest error of a row, in blocks."""
    names = ("apex_error", "minute_error", "inside_depth", "error_1e6", "error_1e7")
    return max(abs(float(row[name])) for name in names)


def _speed(axes: Axes, rows: list[Row]) -> None:
    _title(axes, "Time of a step, and its worst error of any kind")
    wanted = {
        ("the product", 0): ("the product", (-6, 16), "left"),
        ("executor", 0): ("the product\nwithout Numba", (4, 13), "right"),
        ("number format", 4): ("its variant", (5, -18), "right"),
        ("number format", 0): ("float32", (11, -4), "left"),
        ("number format", 1): ("float64", (11, -4), "left"),
        ("number format", 2): ("grid 2⁻¹⁶", (11, -4), "left"),
        ("integrator", 1): ("semi-implicit", (11, -4), "left"),
        ("mover", 0): ("back along the velocity", (11, -4), "left"),
        ("mover", 1): ("time of impact", (0, -18), "left"),
        ("obstacles", 0): ("slabs", (8, 7), "left"),
        ("what others do", 0): ("the seed, to the letter", (11, -4), "left"),
    }
    seen: dict[str, int] = {}
    for row in rows:
        number = seen.get(row["group"], 0)
        seen[row["group"]] = number + 1
        if (row["group"], number) not in wanted:
            continue
        name, offset, side = wanted[row["group"], number]
        ours = (row["product"] and row["integrator"] == "mean") or name == "its variant"
        axes.plot(
            row["ns"], worst(row), "o", color=OURS if ours else OTHER,
            markersize=15 if row["group"] == "the product" else 9, markeredgecolor="white", zorder=3,
        )  # fmt: skip
        axes.annotate(
            name, (row["ns"], worst(row)), xytext=offset, textcoords="offset points", ha=side, fontsize=10.5,
            color=OURS if ours else INK, fontweight="bold" if ours else "normal", linespacing=1.1,
        )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="ns per entity and tick", ylabel="blocks")
    low, high = axes.get_xlim()
    axes.set_xlim(low * 0.75, high * 1.2)
    low, high = axes.get_ylim()
    axes.set_ylim(low * 0.4, high * 2)
    axes.grid(color="#eeece8", zorder=0)


def _apex(axes: Axes, rows: list[Row]) -> None:
    _title(axes, "Height of a jump beside the closed form")
    lines = {
        "explicit": ("explicit", OTHER, "--", (10, 8)),
        "semi": ("semi-implicit (the seed's)", OTHER, "-", (10, -15)),
        "mean": ("mean of both (the product's)", OURS, "-", (-2, 9)),
    }
    for name, (text, color, style, offset) in lines.items():
        groups = ("the product", "integrator", "tick rate")
        chosen = [row for row in rows if row["integrator"] == name and row["group"] in groups]
        line = {row["tick_rate"]: row["apex_error"] for row in chosen}
        rates = sorted(line)
        axes.plot(
            rates, [line[rate] for rate in rates], style, marker="o", color=color, linewidth=2.2, markersize=7,
            markeredgecolor="white", zorder=3,
        )  # fmt: skip
        axes.annotate(
            text, (32, line[32]), xytext=offset, textcoords="offset points", fontsize=10.5, color=color,
            fontweight="bold" if name == "mean" else "normal",
        )  # fmt: skip
    axes.axhline(0, color=FAINT, linewidth=1, zorder=1)
    axes.set(xscale="log", xlabel="ticks per second", ylabel="blocks too high or too low")
    axes.set_xticks([20, 30, 60, 128], ["20", "30", "60", "128"])
    axes.minorticks_off()
    axes.grid(axis="y", color="#eeece8", zorder=0)


def _bars(axes: Axes, names: list[str], values: list[float], texts: list[str], ours: list[bool]) -> None:
    places = range(len(names))
    axes.barh(places, values, color=[OURS if mine else OTHER for mine in ours], height=0.62, zorder=3)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    for place, value, text, mine in zip(places, values, texts, ours, strict=True):
        axes.annotate(
            text, (value, place), xytext=(6, 0), textcoords="offset points", va="center", fontsize=10.5,
            color=OURS if mine else INK, fontweight="bold" if mine else "normal",
        )  # fmt: skip
    for tick, mine in zip(axes.get_yticklabels(), ours, strict=True):
        tick.set(fontsize=10.5, color=OURS if mine else INK, fontweight="bold" if mine else "normal")
    axes.tick_params(axis="y", length=0)


def _formats(axes: Axes, rows: list[Row]) -> None:
    _title(axes, "Corrections between two machines, per player and minute")
    shown = [row for row in rows if row["group"] == "number format" and row["tick_rate"] == 32]
    shown[-1] = next(row for row in rows if row["group"] == "the product")
    names = [row["format"].replace("^-16", "⁻¹⁶").replace("^-20", "⁻²⁰").replace("^-24", "⁻²⁴") for row in shown]
    names[-1] += "\n(the product)"
    values = [row["corrections_per_minute"] for row in shown]
    texts = [
        f"{row['corrections_per_minute']:.3g}; inside a block "
        + (f"{row['inside_share']:.1%} of the time" if row["inside_share"] else "never")
        + f";\n{_blocks(row['error_1e7'])} off at 10⁷ blocks"
        for row in shown
    ]
    _bars(axes, names, values, texts, [row["product"] for row in shown])
    axes.set_xlim(0, max(*values, 1) * 1.9)
    axes.set_xlabel("one source from two compilers; the product: compiled and plain")


def _blocks(value: float) -> str:
    return f"{value:.2g} block{'s' if value > 1 else ''}" if value else "nothing"


def _movers(axes: Axes, rows: list[Row]) -> None:
    _title(axes, "Motion kept while pressing along a wall")
    shown = [next(row for row in rows if row["group"] == "number format" and row["format"] == "grid 2^-24")]
    shown += [row for row in rows if row["group"] == "mover"]
    kept = [1 - row["tangential_lost"] for row in shown]
    names = [NAMES[row["mover"]] for row in shown]
    texts = [f"{value:.0%}, {row['ns']:.0f} ns" for value, row in zip(kept, shown, strict=True)]
    names[0] += "\n(the product's)"
    _bars(axes, names, [100 * value for value in kept], texts, [True, False, False])
    axes.set_xlim(0, 135)
    axes.set_xticks([0, 25, 50, 75, 100])
    axes.set_xlabel("% of the speed along the wall; ns among the variants, in one source")
