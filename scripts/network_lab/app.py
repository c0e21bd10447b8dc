"""Measures what a player feels on each kind of link: full matches in simulated time, from one seed.

    python scripts/netlab.py [--preset wifi] [--clients 10] [--minutes 10] [--seed 1] [--json OUT] [--plot OUT.png]

The real server core and real SDK cores play over simulated TCP connections (`client_sdk/netsim/links.py`). All players
wander on `hills`, where they sometimes meet. Late inputs are a share of all inputs. Snapshot age is the age of the
newest snapshot, sampled once per tick. Lead is the time by which the player's own tick is ahead of the server.
"""

import argparse
import json
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from client_sdk.events import Corrected
from client_sdk.netsim.links import PRESETS
from client_sdk.stats import Stats
from scripts.environment import lacking
from scripts.experiments import league
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, Player, wander

SETTLE_S = 10.0
"""Seconds after the last join that are not counted."""


def quantiles(values: list[float], *shares: float) -> dict[str, float]:
    """Returns quantiles by name ("p50", ..., "max"), rounded to four digits; zeros if there are no values."""
    if not values:
        return {**{f"p{share:g}": 0.0 for share in shares}, "max": 0.0}
    found = {f"p{share:g}": round(float(np.percentile(values, share)), 4) for share in shares}
    return {**found, "max": round(max(values), 4)}


class Watch:
    """Samples the snapshot age and the lead of every player once per tick."""

    def __init__(self, match: Match) -> None:
        self.match = match
        self.ages: list[float] = []
        self.leads: list[float] = []
        match.on_tick.append(self._look)

    def _look(self) -> None:
        rate = self.match.game.scene.tick_rate
        for player in self.match.players:
            core = player.core
            if core.prediction is None or core.timeline is None:
                continue
            self.ages.append((self.match.game.world.tick - core.prediction.confirmed.tick) * 1000 / rate)
            server_tick = self.match.now * rate + 1
            self.leads.append((core.timeline.tick(player.local) - server_tick) * 1000 / rate)


def play(preset: str, clients: int, minutes: float, seed: int) -> dict[str, Any]:
    """Plays a match on one preset. Returns its figures."""
    match = Match(load_scene("hills"), seed)
    path = PRESETS[preset]
    players = [match.join(wander, path) for _ in range(clients)]
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 120)
    match.run(SETTLE_S)
    before = [replace(player.core.stats) for player in players]
    for player in players:
        player.events.clear()
    watch = Watch(match)
    began = time.process_time()
    match.run(minutes * 60)
    spent = time.process_time() - began
    return {**figures(match, players, before, watch, minutes), "simulated_s_per_cpu_s": round(minutes * 60 / spent, 1)}


def figures(match: Match, players: list[Player], before: list[Stats], watch: Watch, minutes: float) -> dict[str, Any]:
    """Returns all figures of one match."""

    def gained(name: str) -> float:
        return float(
            sum(
                getattr(player.core.stats, name) - getattr(old, name)
                for player, old in zip(players, before, strict=True)
            )
        )

    corrections = [event for player in players for event in player.events if isinstance(event, Corrected)]
    seconds = minutes * 60 * len(players)
    return {
        "late_inputs_share": round(gained("inputs_late") / max(gained("inputs_sent"), 1), 6),
        "substituted_inputs_share": round(gained("inputs_substituted") / max(gained("inputs_sent"), 1), 6),
        "corrections_per_minute": round(len(corrections) / (minutes * len(players)), 4),
        "correction_blocks": quantiles([event.blocks for event in corrections], 50, 99),
        "corrections_by_cause": dict(Counter(event.cause for event in corrections)),
        "divergences": int(gained("divergences")),
        "replay_ticks": quantiles([float(event.ticks) for event in corrections], 50),
        "snapshot_age_ms": quantiles(watch.ages, 50, 99),
        "snapshots_per_s": round(gained("snapshots") / seconds, 2),
        "bytes_per_client_per_s": {
            "up": round(gained("bytes_up") / seconds, 1),
            "down": round(gained("bytes_down") / seconds, 1),
        },
        "lead_ms": quantiles(watch.leads, 50, 99),
        "disconnects": sum(player.closed is not None for player in players),
        "tick_rate": match.game.scene.tick_rate,
    }


def table(presets: dict[str, dict[str, Any]]) -> Table:
    """Returns the figures as a table for people."""
    shown = Table(title="what the player feels")
    for name in (
        "preset", "late inputs", "corrections /min", "blocks p50 / p99 / max", "causes", "replay p50 / max",
        "snapshot age ms p50 / p99 / max", "bytes/s up / down", "lead ms p50 / p99",
    ):  # fmt: skip
        shown.add_column(name, justify="left" if name in ("preset", "causes") else "right")
    for name, row in presets.items():
        blocks, age, lead, sent = (
            row[key] for key in ("correction_blocks", "snapshot_age_ms", "lead_ms", "bytes_per_client_per_s")
        )
        shown.add_row(
            name,
            f"{100 * row['late_inputs_share']:.2f} %",
            f"{row['corrections_per_minute']:.2f}",
            f"{blocks['p50']:.3f} / {blocks['p99']:.2f} / {blocks['max']:.2f}",
            ", ".join(f"{cause} {n}" for cause, n in row["corrections_by_cause"].items()) or "-",
            f"{row['replay_ticks']['p50']:.0f} / {row['replay_ticks']['max']:.0f}",
            f"{age['p50']:.0f} / {age['p99']:.0f} / {age['max']:.0f}",
            f"{sent['up']:.0f} / {sent['down']:.0f}",
            f"{lead['p50']:.0f} / {lead['p99']:.0f}",
        )
    return shown


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=PRESETS, action="append", help="play only on this link; may be repeated")
    parser.add_argument("--clients", type=int, default=10, help="default: %(default)s")
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated time per link (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parser.add_argument("--no-league", action="store_true", help="do not compare the lead controllers")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures to this file")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw the figures")
    chosen = parser.parse_args()
    if chosen.plot and (why := lacking("matplotlib")):
        parser.error(f"--plot: {why}")
    names = chosen.preset or list(PRESETS)
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    console.print(f"seed {chosen.seed}: {chosen.clients} clients, {chosen.minutes:g} minutes each")
    found: dict[str, dict[str, Any]] = {}
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(2) as pool, Progress(console=console, transient=True) as progress:
        bar = progress.add_task("matches", total=len(names) * (1 if chosen.no_league else 2))
        jobs = {pool.submit(play, name, chosen.clients, chosen.minutes, chosen.seed): name for name in names}
        leagues = (
            [] if chosen.no_league else [pool.submit(league.run, name, chosen.minutes, chosen.seed) for name in names]
        )
        for job in as_completed(jobs):
            found[jobs[job]] = job.result()
            progress.advance(bar)
        for done in leagues:
            rows += done.result()
            progress.advance(bar)
    presets = {name: found[name] for name in names}
    console.print(table(presets))
    speeds = ", ".join(f"{name} {row['simulated_s_per_cpu_s']:.0f}" for name, row in presets.items())
    console.print(f"simulated seconds per CPU second, of all {chosen.clients} clients and their server: {speeds}")
    if rows:
        console.print(league.table(rows))
    if chosen.json:
        chosen.json.write_text(json.dumps({"seed": chosen.seed, "presets": presets, "league": rows}, indent=1) + "\n")
    if chosen.plot:
        from scripts.network_lab import plot

        plot.draw(presets, rows, chosen.plot)
    return 1 if any(row["divergences"] or row["disconnects"] for row in presets.values()) else 0
