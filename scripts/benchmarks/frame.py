"""`bench.py frame`: the time that a client takes for a frame, with a number of other players in view.

All players wander in one match in simulated time. One of them draws 60 frames a second: it reads what has arrived,
updates and makes a view. The time is that of its calls alone. The server and all other clients run between two of its
frames, so it finds little of its memory in the processor's caches, as beside a program that draws.
"""

import argparse
import time
from typing import Any

from rich.console import Console

from client_sdk.core import Core
from shared import kernels
from shared.scene import load_scene
from sovereign_netcode.playtest import PRESETS, Match, wander

FRAME_S = 1 / 60
SETTLE_S = 4.0
"""Simulated seconds before the count starts."""


class Drawing(Core):
    """A client core that takes the time of its frames."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.frames: list[float] = []
        """Time of each frame, in seconds."""
        self.others = 0
        self._receiving = 0.0

    def receive(self, data: bytes, now: float) -> None:
        began = time.perf_counter()
        super().receive(data, now)
        self._receiving += time.perf_counter() - began

    def update(self, now: float) -> None:
        began = time.perf_counter()
        super().update(now)
        view = self.view(now)
        self.frames.append(self._receiving + time.perf_counter() - began)
        self._receiving, self.others = 0.0, len(view.others)


def measured(entities: int, seconds: float, seed: int) -> dict[str, Any]:
    """Returns the figures of one match.

    Args:
        entities: number of other players.
        seconds: simulated seconds that are measured.
        seed: source of everything random.
    """
    match, core = Match(load_scene("arena"), seed), Drawing("drawing")
    match.join(wander, PRESETS["typical"], core).frame_s = FRAME_S
    for _ in range(entities):
        match.join(wander, PRESETS["lan"])
    match.run(SETTLE_S)
    core.frames.clear()
    match.run(seconds)
    us = sorted(1e6 * each for each in core.frames)
    return {
        "others": core.others,
        "frames": len(us),
        "median_us": us[len(us) // 2],
        "mean_us": sum(us) / len(us),
        "p99_us": us[len(us) * 99 // 100],
    }


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    """Runs `frame` once for each seed."""
    runs = [measured(args.entities, args.seconds, seed) for seed in range(1, args.seeds + 1)]
    console.print(f"a frame of a client, 60 frames/s, arena, {kernels.chosen()} kernel")
    for found in runs:
        console.print(
            f"  {found['others']} others in view, {found['frames']} frames: median {found['median_us']:.0f} us, "
            f"mean {found['mean_us']:.0f}, p99 {found['p99_us']:.0f}",
            highlight=False,
        )
    return {"kernel": kernels.chosen(), "runs": runs}, 0


def add(commands: Any, each: argparse.ArgumentParser) -> None:
    """Adds `frame` to the command line, with the arguments of each command."""
    command = commands.add_parser("frame", parents=[each], help="time of a client's frame")
    command.add_argument("--entities", type=int, default=50, metavar="N", help="other players (default: 50)")
    command.add_argument("--seconds", type=float, default=8.0, metavar="S", help="simulated seconds (default: 8)")
    command.add_argument("--seeds", type=int, default=3, metavar="N", help="number of runs (default: 3)")
    command.set_defaults(run=run)
