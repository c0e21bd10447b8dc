"""`bench.py peers`: plays Colyseus and Sovereign Netcode in turn on this machine, and prints both."""

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from scripts.benchmarks.peers import figures, install
from scripts.benchmarks.peers.rig import OURS, SIDES, Rig, Window
from scripts.benchmarks.server import RigError


class Lengths(NamedTuple):
    """The sizes of a run: numbers of players, and times in seconds."""

    players: tuple[int, ...] = (1, 10, 100)
    warm_up_s: float = 8.0
    window_s: float = 10.0
    settle_s: float = 4.0
    """Time from the join until the server is stopped, or until a player sends two inputs per step."""
    stop_s: float = 1.0
    after_s: float = 7.0
    """Time from the end of a stall until its figures begin."""
    heal_s: float = 8.0
    """Time from the last late read until the figures begin."""
    short_s: float = 2.0
    """Window of the figures after a stall, and of two inputs per step."""


QUICK = Lengths((12,), 0.5, 1.5, 0.5, 0.5, 0.5, 0.5, 1.0)
WAITS = ("wait_ms_p50", "wait_ms_p99", "applied_ms_p50", "applied_ms_p99")
SINCE = ("corrections_per_min", "correction_blocks_max", "lost_share")
"""Figures after a stall that count from its beginning on."""


def play(side: str, node: str, players: int, lengths: Lengths, seed: int, *, proxied: bool) -> figures.Figures:
    with Rig(side, node, players, proxied=proxied, seed=seed) as rig:
        time.sleep(lengths.warm_up_s)
        return rig.figures(*rig.window(lengths.window_s))


def stop(side: str, node: str, lengths: Lengths, seed: int) -> figures.Figures:
    """Stops the server for a moment."""
    with Rig(side, node, 5, proxied=False, seed=seed) as rig:
        time.sleep(lengths.settle_s)
        first, _ = rig.window(0.0)
        rig.server.stop_for(lengths.stop_s)
        time.sleep(lengths.after_s)
        return settled(rig, first, lengths.short_s)


def heal(side: str, node: str, lengths: Lengths, seed: int) -> figures.Figures:
    """Heals a line that had late reads."""
    with Rig(side, node, 3, proxied=True, seed=seed) as rig:
        time.sleep(lengths.warm_up_s)
        assert rig.proxy is not None
        rig.proxy.ask("heal")
        first, _ = rig.window(0.0)
        time.sleep(lengths.heal_s)
        return settled(rig, first, lengths.short_s)


def settled(rig: Rig, first: Window, seconds: float) -> figures.Figures:
    """Returns the waits from now on. Corrections and lost inputs are those since `first`."""
    late = rig.window(seconds)
    found, whole = rig.figures(*late), rig.figures(first, late[1])
    return {name: (whole if name in SINCE else found)[name] for name in (*WAITS, *SINCE)}


def cheat(side: str, node: str, lengths: Lengths, seed: int) -> figures.Figures:
    with Rig(side, node, 2, proxied=False, per_step=2, seed=seed) as rig:
        time.sleep(lengths.settle_s)
        before, after = rig.window(lengths.short_s)
        return {"speed": figures.speed(before.server, after.server)}


def scenarios(lengths: Lengths, node: str) -> dict[str, Callable[[str, int], figures.Figures]]:
    """Returns the function of each scenario by its name. It takes the side and the seed."""
    made: dict[str, Callable[[str, int], figures.Figures]] = {}
    for proxied, line in ((True, "bad line"), (False, "no proxy")):
        for players in lengths.players:
            title = f"{line}, {players} player{'s' * (players > 1)}"
            made[title] = lambda side, seed, players=players, proxied=proxied: play(  # type: ignore[misc]
                side, node, players, lengths, seed, proxied=proxied
            )
    made[f"{lengths.after_s:g} s after the server stood still for {lengths.stop_s:g} s, 5 players"] = (
        lambda side, seed: stop(side, node, lengths, seed)
    )
    made[f"{lengths.heal_s:g} s after the bad line healed, 3 players"] = lambda side, seed: heal(
        side, node, lengths, seed
    )
    made["a client that sends two inputs per step"] = lambda side, seed: cheat(side, node, lengths, seed)
    return made


def add(commands: Any, each: argparse.ArgumentParser) -> None:
    """Adds the command to a parser's `commands`. `each` has the options that all benchmarks share."""
    command = commands.add_parser("peers", parents=[each], help="Colyseus and this project, in turn (Linux, npm)")
    add_argument = command.add_argument
    add_argument("--runs", type=int, default=1, metavar="N", help="runs of everything, for scatter (default: 1)")
    add_argument("--seconds", type=float, default=10.0, metavar="S", help="measured seconds (default: 10)")
    add_argument("--warm-up", type=float, default=8.0, metavar="S", help="seconds before that (default: 8)")
    add_argument("--only", default="", metavar="TEXT", help="only scenarios with this text in their name")
    add_argument("--quick", action="store_true", help="few players and seconds, to see that it works")
    command.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    if sys.platform != "linux":
        console.print("error: `peers` needs Linux: its load generator polls with epoll")
        return {}, 2
    try:
        node = install.ensure()
    except install.PeersError as error:
        print(f"error: {error}", file=sys.stderr)
        return {}, 2
    lengths = QUICK if args.quick else Lengths(warm_up_s=args.warm_up, window_s=args.seconds)
    chosen = {name: measure for name, measure in scenarios(lengths, node).items() if not args.only or args.only in name}
    if not chosen:
        print(f"error: --only = {args.only!r}: no scenario has this in its name", file=sys.stderr)
        return {}, 2
    runs: list[dict[str, Any]] = []
    failed = 0
    for number in range(args.runs):
        for scenario, measure in chosen.items():
            for side in SIDES:
                load = os.getloadavg()[0]
                try:
                    found = measure(side, number + 1)
                except RigError as error:  # the other runs count
                    failed += 1
                    print(f"error: {scenario}: {side}: {error}", file=sys.stderr)
                    continue
                runs.append({"scenario": scenario, "side": side, "run": number + 1, "load": load, "figures": found})
                text = f"  run {number + 1}: {scenario}: {side} (load of the machine before: {load:.1f})"
                console.print(text, highlight=False, soft_wrap=True)
    for scenario in chosen:
        console.print(table(scenario, [run for run in runs if run["scenario"] == scenario]))
    lines = figures.behind(runs)
    console.print("Ours is behind, in every run and by more than 5 %:" if lines else "Ours is behind in no figure.")
    for line in lines:
        console.print(f"  {line}", highlight=False, soft_wrap=True)
    return {"lengths": lengths._asdict(), "machine": machine(), "runs": runs, "behind": lines}, 2 if failed else 0


def table(scenario: str, runs: list[dict[str, Any]]) -> Table:
    made = Table("figure", title=scenario, title_justify="left")
    for side in SIDES:
        made.add_column("ours" if side == OURS else f"Colyseus, {side}", justify="right")
    for name, shown in figures.NAMES.items():
        if figures.found(runs, name):
            sides = ([run for run in runs if run["side"] == side] for side in SIDES)
            made.add_row(shown.title, *(figures.shown(mine, name) for mine in sides))
    return made


def machine() -> dict[str, Any]:
    """Returns what the figures were measured on."""
    return {"cores": os.cpu_count(), "machine": platform.machine(), "python": platform.python_version()}
