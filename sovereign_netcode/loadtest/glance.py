"""The display of a running load test: the figures between two samples, and the place where they are shown."""

from typing import NamedTuple

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from server.observability.histogram import between
from sovereign_netcode.loadtest.figures import LATENESS, Figures

Row = tuple[str, str]


class Look(NamedTuple):
    """A sample of both sides at one moment. All counts are totals, so two samples give the figures between them."""

    server: Figures
    """The server's `/stats`; empty if the server does not provide it."""
    bots: list[Figures]
    """The latest report of each process of bots."""


def rows(before: Look, now: Look) -> list[Row]:
    """Returns the figures between two samples: names and values."""
    found = [("clients", _clients(now))]
    if before.server and now.server:
        found += _server(before.server, now.server)
    pairs = list(zip(before.bots, now.bots, strict=True))
    if silent := sum(a.get("at") == b.get("at") for a, b in pairs):  # too busy to report
        found.append(("bots silent", f"{silent} of {len(pairs)} processes"))
    pairs = [(a, b) for a, b in pairs if "at" in a and b["at"] > a["at"]]
    return found + (_bots(pairs) if pairs else [])


def _clients(now: Look) -> str:
    playing, gone = sum(told["playing"] for told in now.bots), sum(len(told["ended"]) for told in now.bots)
    return f"{playing}, {gone} gone" if gone else f"{playing}"


def _server(before: Figures, now: Figures) -> list[Row]:
    seconds = now["uptime_s"] - before["uptime_s"]
    if seconds <= 0:  # the server was restarted
        return []
    lateness = between(before[LATENESS], now[LATENESS])
    return [
        ("ticks", f"{(now['ticks'] - before['ticks']) / seconds:.1f} /s"),
        ("ticks late", f"{lateness['p50']:.1f} / {lateness['p99']:.1f} / {lateness['max']:.1f} ms"),
        ("server's CPU", f"{(now['cpu_s'] - before['cpu_s']) / seconds:.0%}"),
    ]


def _bots(pairs: list[tuple[Figures, Figures]]) -> list[Row]:
    def count(name: str) -> int:
        return int(sum(b[name] - a[name] for a, b in pairs))

    def rate(name: str) -> float:
        return float(sum((b[name] - a[name]) / (b["at"] - a["at"]) for a, b in pairs))

    clients = max(1, sum(b["playing"] for _, b in pairs))
    late, sent = count("inputs_late"), max(1, count("inputs_sent"))
    lag_ms = max(between(a["lag_counts"], b["lag_counts"])["p99"] for a, b in pairs)
    cpu_share = max((b["cpu_s"] - a["cpu_s"]) / (b["at"] - a["at"]) for a, b in pairs)
    return [
        ("down", f"{rate('bytes_down') / clients / 1e3:.2f} KB/s each"),
        ("up", f"{rate('bytes_up') / clients / 1e3:.2f} KB/s each"),
        ("late inputs", f"{late} ({late / sent:.2%})"),
        ("corrections", f"{count('corrections')}"),
        ("bots late", f"{lag_ms:.1f} ms"),
        ("bots' CPU", f"{cpu_share:.0%}"),
    ]


class Stage:
    """The display: a progress bar and figures on a terminal, otherwise one line for each phase and each sample."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console)
        self._live = Live(self._progress, console=console, transient=True) if console.is_terminal else None

    def __enter__(self) -> "Stage":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def begin(self, text: str, total: float) -> None:
        if self._live is None:
            self._console.print(f"{text} ...")
        for task in self._progress.task_ids:
            self._progress.remove_task(task)
        self._task = self._progress.add_task(text, total=total)

    def at(self, done: float) -> None:
        self._progress.update(self._task, completed=done)

    def show(self, seconds: float, figures: list[Row]) -> None:
        """Shows the latest figures, `seconds` after the start of the window."""
        if self._live is None:
            text = ", ".join(f"{name} {value}" for name, value in figures)
            self._console.print(f"{seconds:6.0f} s  {text}", highlight=False, soft_wrap=True)
            return
        table = Table.grid(padding=(0, 2))
        for name, value in figures:
            table.add_row(f"[dim]{name}[/]", value)
        self._live.update(Group(self._progress, table))
