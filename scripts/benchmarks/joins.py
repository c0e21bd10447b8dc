"""`bench.py joins`: the CPU time of the server for a join, with its first snapshot and terrain, while others play.

Clients join until 200 play, eight in a tick or alone, all over hills: at one spawn point, where they stand in a crowd,
or at a spawn point each. The time is that of the messages and of the tick in which they join, less a tick without
joins. The rest of the terrain follows in later ticks and does not count. There are no sockets. On a busy machine, the
least of several games, join by join, is nearest to the cost.
"""

import argparse
import itertools
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from scripts.benchmarks.memory import Sink, wide
from scripts.benchmarks.server import RATE, scene_toml
from server.config.limits import Limits
from server.game import Game
from server.game.session import Session
from server.runtime.event_loop import freeze
from server.runtime.warmup import warm_up
from shared import messages
from shared.messages import Hello, Inputs, encode
from shared.scene import Scene, load_scene

CLIENTS, SKIPPED = 200, 24
"""Clients in the end, and the first of them, whose joins do not count."""
AT_ONCE = (8, 1)
"""Numbers of clients that join in a tick."""
BETWEEN = 12
"""Ticks between two ticks with joins, in which the terrain follows."""


class Joined:
    """A game and its clients, which stand still.

    Args:
        scene: the scene.
        at_once: number of clients that join in a tick.
    """

    def __init__(self, scene: Scene, at_once: int) -> None:
        self.game, self.now, self._at_once = Game(scene, limits=Limits(joins_per_tick=at_once)), 0.0, at_once
        self.clients: list[Session] = []

    def tick(self) -> float:
        """Runs a tick, after the inputs of all clients. Returns the CPU time of the tick in seconds."""
        tick = self.game.world.tick
        for session in self.clients:
            self.game.receive(session, encode(Inputs(tick + 2, tick, bytes(3))), self.now)
        self.now += 1 / RATE
        began = time.thread_time()
        self.game.tick(self.now, self.now)
        return time.thread_time() - began

    def join(self) -> float:
        """Lets clients join in a tick. Returns the CPU time of each in seconds, without that of the tick itself."""
        idle = statistics.median([self.tick() for _ in range(BETWEEN)][-6:])
        new = []
        began = time.thread_time()
        for number in range(self._at_once):
            new.append(self.game.open(Sink(), self.now))
            hello = Hello(messages.VERSION, {}, f"player {len(self.clients) + number}")
            self.game.receive(new[-1], encode(hello), self.now)
        spent = time.thread_time() - began + self.tick() - idle
        assert all(session.entity for session in new)
        self.clients += new
        return spent / len(new)


def game(scene: Scene, at_once: int) -> list[float]:
    """Returns the time of a join in one game in milliseconds, for each tick with joins."""
    warm_up(scene)
    played = Joined(scene, at_once)
    freeze()
    return [1e3 * played.join() for _ in range(CLIENTS // at_once)][SKIPPED // at_once :]


def scenes() -> dict[str, Scene]:
    """Returns the scenes by what their spawn points are like."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(scene_toml(2 * CLIENTS), "utf-8")
        return {"one spawn point": wide(), "a spawn point each": load_scene(str(path))}


def run(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], int]:
    """Runs `joins`."""
    report: dict[str, Any] = {}
    for (name, scene), at_once in itertools.product(scenes().items(), AT_ONCE):
        games = [game(scene, at_once) for _ in range(args.games)]
        least = statistics.fmean(min(times) for times in zip(*games, strict=True))
        each = [time for times in games for time in times]
        title = f"{name}, {at_once} in a tick"
        report[title] = {"least_ms": least, "median_ms": statistics.median(each), "worst_ms": max(each)}
        console.print(
            f"a join, {title}: {least:.2f} ms (mean of the least of {args.games} games), "
            f"median {statistics.median(each):.2f} ms, worst {max(each):.2f} ms",
            highlight=False,
            soft_wrap=True,
        )
    return report, 0


def add(commands: Any, each: argparse.ArgumentParser) -> None:
    """Adds `joins` to the command line, with the arguments of each command."""
    command = commands.add_parser("joins", parents=[each], help="CPU time of the server for a join")
    command.add_argument("--games", type=int, default=5, metavar="N", help="games for each scene (default: 5)")
    command.set_defaults(run=run)
