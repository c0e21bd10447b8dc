"""Measures the cost of saving a world: latency of command results, time of ticks, checkpoints, bytes, and loading.

It has four parts, each with a new directory under DIR (default: the system's folder for temporary files; check which
disk that is on):

`verdicts`: a game in real time, with one client in the same process that edits a block in every tick. Measures the time
from the step that did an edit to the snapshot with its result, and from a step to its record on disk.
`ticks`: CPU time of a step of 100 walkers, saved and not saved, in turns. The time of the thread that writes is not
included.
`checkpoint`: many entities, a hundred of which walk, and 500 edited segments. Measures the step that copies them
against the other steps, the time until the checkpoint is on disk, and the steps during that time.
`way back`: CPU time to load a checkpoint and a log.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from server.config.limits import Limits
from server.game import Game
from server.persistence.store import Store
from shared import edits, messages
from shared.inputs import Input
from shared.messages import Command, Hello, Inputs, Snapshot, decode_from_server, encode
from shared.scene import Scene, load_scene
from shared.snapshot import VERDICT
from shared.units import SEGMENT

HOW = {"nowhere": None, "process": False, "power": True}
"""Kinds of durability that command results wait for, with the argument `power` of `Store`; None: there is no store."""


class Client:
    """A link to a client that keeps all messages."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, message: bytes) -> None:
        self.sent.append(message)

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        raise RuntimeError(f"closed: {code} {reason}")


EAGER = Limits(edits_per_s=1000.0)


@contextmanager
def opened(directory: str | None, scene: Scene, **how: Any) -> Iterator[Store]:
    with tempfile.TemporaryDirectory(dir=directory) as data:
        store = Store(data, scene, **how)
        try:
            yield store
        finally:
            store.close()


def quantiles(samples: list[float]) -> dict[str, float]:
    ordered = sorted(samples)
    return {
        "p50": statistics.median(ordered),
        "p99": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))],
        "max": ordered[-1],
    }


def verdicts(directory: str | None, ticks: int) -> dict[str, Any]:
    """Returns latencies in ms, by the kind of durability."""
    report: dict[str, Any] = {}
    scene = load_scene("flat")
    for name, power in HOW.items():
        if power is None:
            report[name] = {"verdict_ms": quantiles(edit_on(Game(scene, limits=EAGER), ticks)), "commit_ms": None}
            continue
        with opened(directory, scene, power=power) as store:
            game = Game(scene, limits=EAGER, world=store.world, saves=store)
            store.start(game.keep)
            report[name] = {"verdict_ms": quantiles(edit_on(game, ticks)), "commit_ms": store.commit_s.summary()}
    return report


def edit_on(game: Game, ticks: int) -> list[float]:
    """Plays in real time with one edit per tick. Returns the times from an edit's step to its result, in ms."""
    link, tick_s = Client(), 1 / game.scene.tick_rate
    start = time.monotonic()
    session = game.open(link, start)
    game.receive(session, encode(Hello(messages.VERSION, {}, "bench")), start)
    stepped: dict[int, float] = {}
    waits = []
    cell = [int(part) for part in game.scene.spawns[1]]
    for turn in range(1, ticks + 1):
        time.sleep(max(0.0, start + turn * tick_s - time.monotonic()))
        if session.entity:
            tick = game.world.tick
            game.receive(session, encode(Inputs(tick + 1, tick, bytes(3))), time.monotonic())
            edit = edits.pack(edits.Edit(cell[0], cell[1], cell[2] + 3, turn % 2))
            game.receive(session, encode(Command(turn, tick + 1, 0.0, edits.NAME, edit)), time.monotonic())
        now = stepped[turn] = time.monotonic()
        game.tick(start + turn * tick_s, now)
        after = time.monotonic()
        for message in map(decode_from_server, link.sent):
            if isinstance(message, Snapshot):
                for number, verdict in VERDICT.iter_unpack(message.verdicts):
                    assert verdict == messages.DONE, verdict
                    waits.append((after - stepped.pop(number)) * 1e3)
        link.sent.clear()
    assert len(waits) > 0.9 * ticks
    return waits


def walkers(store_or_none: Store | None, scene: Scene, n: int) -> Any:
    """Returns a world with `n` players on hills."""
    world = Game(scene).world if store_or_none is None else store_or_none.world
    side = int(np.ceil(np.sqrt(n)))
    x, y = np.meshgrid(*(np.linspace(4, part * SEGMENT - 4, side) for part in scene.size[:2]))
    world.spawn_many("player", np.stack([x.ravel(), y.ravel(), np.full(side * side, 29.0)], axis=1)[:n])
    return world


def ticks(directory: str | None, rounds: int) -> dict[str, Any]:
    """Returns the CPU time in us per step of 100 walkers, all of which get a new input every 16 ticks."""
    scene = load_scene("hills")
    with opened(directory, scene) as store:
        worlds = {"nowhere": walkers(None, scene, 100), "saved": walkers(store, scene, 100)}
        store.start(lambda: None)
        samples: dict[str, list[float]] = {name: [] for name in worlds}
        for turn in range(rounds):
            for name, world in worlds.items():
                before = time.thread_time()
                for tick in range(32):
                    way = 127 if (turn + tick // 16) % 2 else -127
                    world.step({entity: Input(way, 0, 0) for entity in range(1, 101)})
                samples[name].append((time.thread_time() - before) / 32 * 1e6)
                while store.durable_tick < store.world.tick:
                    time.sleep(0.001)
        size = store.stats()["log_bytes"] / store.world.tick
    return {name: quantiles(values) for name, values in samples.items()} | {"log_bytes_per_tick": size}


def checkpoint(directory: str | None, entities: int, rounds: int) -> dict[str, Any]:
    """Returns the times in ms of the step that copies, and of others, with `entities` and 500 edited segments."""
    scene = replace(load_scene("hills"), size=(25, 20, 1))
    every = 40
    names = ("others", "others_time", "copies", "packed", "packed_time")
    report: dict[str, list[float]] = {name: [] for name in names}
    with opened(directory, scene, checkpoint_s=every / scene.tick_rate) as store:
        world = walkers(store, scene, entities)
        store.start(lambda: None)
        for turn in range((3 + rounds) * every):
            if turn % every == every // 2:
                for x, y, _ in scene.segments():
                    world.write_blocks((x, y, 0), [31 << 10], [turn % 255 + 1])
            began, cpu = time.monotonic(), time.thread_time()
            world.step({entity: Input(127, 0, 0) for entity in range(1, 101)})
            wall, cpu = (time.monotonic() - began) * 1e3, (time.thread_time() - cpu) * 1e3
            if turn < 3 * every:
                pass  # the walkers are still falling to the ground
            elif world.tick % every == 0:
                report["copies"].append(cpu)
            elif turn % every != every // 2:
                name = "others" if store.idle else "packed"
                report[name].append(cpu)
                report[f"{name}_time"].append(wall)
            time.sleep(max(0.0, 1 / scene.tick_rate - (time.monotonic() - began)))
        figures = {name: quantiles(values) for name, values in report.items() if values}
        return figures | {"entities": entities, "checkpoint_ms": store.checkpoint_s.summary()}


def way_back(directory: str | None, log_ticks: int) -> dict[str, float]:
    """Returns the CPU time in seconds to load a checkpoint and a log of `log_ticks` ticks of 100 walkers."""
    scene = load_scene("hills")
    with tempfile.TemporaryDirectory(dir=directory) as data, tempfile.TemporaryDirectory(dir=directory) as copy:
        store = Store(data, scene, checkpoint_s=3600)
        world = walkers(store, scene, 100)
        store.start(lambda: None)
        for tick in range(log_ticks):
            world.step({entity: Input(127 if tick // 16 % 2 else -127, 0, 0) for entity in range(1, 101)})
            while store.durable_tick < tick - 100:
                time.sleep(0.001)
        while store.durable_tick < world.tick:
            time.sleep(0.001)
        for path in Path(data).glob("world.db*"):
            (Path(copy) / path.name).write_bytes(path.read_bytes())
        store.close()
        began = time.process_time()
        again = Store(copy, scene)
        took = time.process_time() - began
        assert again.restored == (world.tick, world.state_hash().hex())
        again.close()
        return {"ticks": log_ticks, "cpu_s": took}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--dir",
        metavar="DIR",
        help="folder in which to create the directories (default: the system's for temporary files)",
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of the rounds, and fewer entities")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the figures to this file")
    args = parser.parse_args(argv)
    scale = 1 if args.quick else 10
    crowds = (1_000, 10_000) if args.quick else (1_000, 10_000, 100_000)
    report = {
        "verdicts": verdicts(args.dir, 60 * scale),
        "ticks": ticks(args.dir, 5 * scale),
        "checkpoints": [checkpoint(args.dir, n, max(2, scale // 2)) for n in crowds],
        "way_back": way_back(args.dir, 192 * scale),
    }
    show(report)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n", "utf-8")
    return 0


def show(report: dict[str, Any]) -> None:
    out = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    table = Table("what", "p50", "p99", "max")

    def row(name: str, figures: dict[str, float], unit: str) -> None:
        table.add_row(name, *(f"{figures[part]:.2f} {unit}" for part in ("p50", "p99", "max")))

    for name, figures in report["verdicts"].items():
        row(f"step to verdict, {name}", figures["verdict_ms"], "ms")
        if figures["commit_ms"]:
            row(f"step to disk, {name}", figures["commit_ms"], "ms")
    for name in ("nowhere", "saved"):
        row(f"a step of 100 walkers, {name}, CPU", report["ticks"][name], "us")
    for figures in report["checkpoints"]:
        what = f"{figures['entities']:,} entities, 500 segments"
        row(f"{what}: the step that copies, CPU", figures["copies"], "ms")
        row(f"{what}: steps while it is packed, CPU", figures["packed"], "ms")
        row(f"{what}: other steps, CPU", figures["others"], "ms")
        row(f"{what}: steps while it is packed, time", figures["packed_time"], "ms")
        row(f"{what}: other steps, time", figures["others_time"], "ms")
        row(f"{what}: until it is on disk", figures["checkpoint_ms"], "ms")
    out.print(table)
    out.print(f"log: {report['ticks']['log_bytes_per_tick']:.0f} bytes per tick of 100 walkers")
    back = report["way_back"]
    out.print(f"way back: {back['cpu_s']:.2f} s of CPU for {back['ticks']:,} ticks of 100 walkers")
