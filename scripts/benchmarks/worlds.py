"""`bench.py worlds`: how many worlds of `PLAYERS` players one server process holds at 30 Hz, and what a world costs.

A number of worlds is held if the ticks of all worlds that are asked are on time (99 % start less than a tick late) and
each client gets at least 95 % of its snapshots. The server is the product, with the worlds made at its start; a
generator of load (`scripts.loadgen.generator`) plays in all of them. The scene is the meadow, in which everybody sees
everybody.
"""

import argparse
import contextlib
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from client_sdk.client import Client
from scripts.benchmarks import server
from scripts.benchmarks.server import RATE, Figures, Rig
from scripts.environment import ROOT

PLAYERS = 4
ASKED_MAX = 12
"""Number of worlds whose figures count, evenly spread."""
FIRST, MOST = 100, 1000
"""Number of worlds of the first step, and the largest number."""
MATCHES = 30
CONFIG = """\
scene = "flat"

[limits]
worlds_max = {most}
creations_per_s = 1000

[worlds.arena]
scene = "{scene}"
players_max = {players}
worlds_max = {most}
start = {start}
empty_s = 1e6

[worlds.fresh]
scene = "{scene}"
players_max = 1
empty_s = 0
"""


class WorldsRig(Rig):
    """A server with many worlds, and a generator of load in all of them.

    Args:
        config: the server's settings, a file.
        names: names of its worlds.
        players: number of players in each.
    """

    def __init__(self, config: Path, names: list[str], players: int) -> None:
        paths = [f"/{name}" for name in names] * players or ["/"]
        super().__init__("server", "--config", str(config), "--port", "0", "--log-level", "warning", paths=paths)
        self._asked = names[:: max(1, len(names) // ASKED_MAX)]

    def stats(self, path: str = "/stats") -> Figures:
        """Returns the figures of the process, with the mean number of ticks and the lateness of the worlds asked."""
        figures = super().stats(path)
        each = [super(WorldsRig, self).stats(f"/{name}/stats") for name in self._asked]
        if each:
            lateness = sum((Counter(dict(one["tick_lateness_counts"])) for one in each), Counter[float]())
            figures["ticks"] = round(statistics.mean(one["ticks"] for one in each))
            figures["tick_lateness_counts"] = sorted(lateness.items())
        return figures


@contextlib.contextmanager
def rig(worlds: int, players: int = PLAYERS) -> Iterator[WorldsRig]:
    """Runs a server with a number of worlds."""
    names = ["arena", *(f"arena-{number}" for number in range(2, worlds + 1))][:worlds]
    with tempfile.TemporaryDirectory() as folder:
        scene, config = Path(folder) / "meadow.toml", Path(folder) / "server.toml"
        meadow = (ROOT / "shared" / "scenes" / "meadow.toml").read_text("utf-8")
        scene.write_text(f"tick_rate = {RATE}\n{meadow}", "utf-8")
        config.write_text(CONFIG.format(scene=scene, players=PLAYERS, most=MOST, start=worlds), "utf-8")
        running = WorldsRig(config, names, players)
        try:
            yield running
        finally:
            running.close()


def idle(worlds: int, seconds: float) -> tuple[float, float]:
    """Returns memory (MB of RSS) and CPU time (share of a core) of a server whose worlds are all empty."""
    with rig(worlds) as running:
        time.sleep(1.0)
        before = Rig.stats(running)
        time.sleep(seconds)
        after = Rig.stats(running)
    return after["rss_mb"], (after["cpu_s"] - before["cpu_s"]) / (after["uptime_s"] - before["uptime_s"])


def matches(count: int) -> list[float]:
    """Returns the seconds from asking for a match to playing, in a new world each time."""
    found = []
    with rig(0) as running:
        for number in range(count):
            begun = time.monotonic()
            with Client.match(f"ws://127.0.0.1:{running.port}", "fresh", name=f"player {number}") as client:
                while not client.playing:
                    client.poll()
                    client.update()
                    if client.closed or time.monotonic() - begun > server.PATIENCE_S:
                        raise server.RigError(f"no match: {client.overlay()}")
                    time.sleep(0.001)
                found.append(time.monotonic() - begun)
    return found


def step(worlds: int, seconds: float, console: Console) -> Figures:
    """Measures a number of worlds, prints a line, and returns the figures."""
    with rig(worlds) as running:
        try:
            stage = running.hold(PLAYERS * worlds, seconds)
        except TimeoutError:  # the server is far beyond its limit
            console.print(f"  {worlds:4} worlds of {PLAYERS}: not held, the server does not answer")
            return {"worlds": worlds, "held": False, "server_cpu_share": 1.0}
    console.print(
        f"  {worlds:4} worlds of {PLAYERS}: {'held' if stage['held'] else 'not held'}, ticks late "
        f"{stage['tick_lateness_ms']['p99']:.1f} ms (p99), worst client {stage['snapshots_share_worst']:.0%}, "
        f"CPU {stage['server_cpu_share']:.0%}, {stage['cpu_us_per_client_tick']:.1f} us per client and tick",
        highlight=False,
        soft_wrap=True,
    )
    return stage | {"worlds": worlds}


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    """Runs `worlds`."""
    seconds, steps, first = (1.5, 1, 20) if args.quick else (5.0, 6, FIRST)
    few, many = 1, 40 if args.quick else 200
    (rss_few, cpu_few), (rss_many, cpu_many) = idle(few, seconds), idle(many, seconds)
    stages: list[Figures] = []
    good, bad, worlds = 0, MOST + 1, first
    while len(stages) < steps and worlds > 1:
        stage = step(worlds, seconds, console)
        stages.append(stage)
        good, bad = (worlds, bad) if stage["held"] else (good, worlds)
        room = min(0.97 / max(stage["server_cpu_share"], 0.1), 2.0)
        worlds = min(int(worlds * room), bad - 1) if stage["held"] else (good + bad) // 2
        if bad - good <= 0.05 * good or worlds <= good:
            break
    waits = sorted(matches(5 if args.quick else MATCHES))
    report = {
        "worlds_held": good,
        "players_per_world": PLAYERS,
        "mb_per_empty_world": (rss_many - rss_few) / (many - few),
        "cpu_share_of_empty_worlds": cpu_many - cpu_few,
        "empty_worlds": many,
        "match_ms_p50": 1e3 * statistics.median(waits),
        "match_ms_max": 1e3 * waits[-1],
    }
    made = Table("figure", "", title=f"worlds: {RATE} Hz, one process")
    for name, value in report.items():
        made.add_row(name, f"{value:,.4g}")
    console.print(made)
    return report | {"rate": RATE, "stages": stages}, 0
