"""`bench.py entities`: a large world of 100,000 entities, a tenth of which walk, and clients that join it.

It runs in one process and without sockets, so it measures only the cores. The figures are CPU time per tick, on which
other processes have little influence. Walkers keep a direction for about a second, as the wandering bots do.
"""

import gc
import random
import statistics
import time
from typing import Any

import numpy as np

from scripts.benchmarks.memory import Sink
from server.game import Game
from server.game.session import Session
from shared import messages
from shared.inputs import make_input
from shared.messages import Hello, Inputs, encode
from shared.scene import Scene, load_scene
from shared.units import SEGMENT

RATE = 30
SIDE = 48
"""Segments along one side of the world."""
WALKS = 10
"""Number of entities per entity that walks."""


def wide(clients: int) -> Scene:
    """Returns a scene of hills, 1,536 blocks along each side, with a spawn point for each client."""
    rng = random.Random(1)
    spawns = [[rng.randrange(8, SIDE * SEGMENT - 8), rng.randrange(8, SIDE * SEGMENT - 8), 28] for _ in range(clients)]
    table: dict[str, Any] = load_scene("hills").to_table()
    return Scene.from_table(table | {"size": [SIDE, SIDE, 1], "spawns": spawns, "tick_rate": RATE})


class Large:
    """The game with its walkers and clients."""

    def __init__(self, entities: int, clients: int, seed: int) -> None:
        self.rng = random.Random(seed)
        self.game = Game(wide(clients))
        across = int(entities**0.5) + 1
        step = (SIDE * SEGMENT - 8) / across
        numbers = np.arange(entities)
        places = np.column_stack((4 + numbers % across * step, 4 + numbers // across * step, np.full(entities, 30.0)))
        ids = self.game.world.spawn_many("player", places)
        self.walkers = list(ids[::WALKS])
        self.sessions: list[Session] = []
        self.now = 0.0
        self._turn(self.walkers)
        self.ticks(3 * RATE)  # all fall to the ground

    def _turn(self, walkers: list[int]) -> None:
        rng = self.rng
        for entity in walkers:
            self.game.api.steered[entity] = make_input(rng.uniform(-1, 1), rng.uniform(-1, 1), jump=rng.random() < 0.1)

    def join(self, clients: int) -> None:
        for number in range(clients):
            session = self.game.open(Sink(), self.now)
            self.game.receive(session, encode(Hello(messages.VERSION, {}, f"player {number}")), self.now)
            self.sessions.append(session)

    def ticks(self, n: int) -> list[float]:
        """Runs `n` ticks. Returns the CPU time of each, in seconds."""
        times: list[float] = []
        for _ in range(n):
            self.now += 1 / RATE
            self._turn(self.rng.sample(self.walkers, len(self.walkers) // RATE))
            tick = self.game.world.tick
            for session in self.sessions:
                if session.entity:
                    self.game.receive(session, encode(Inputs(tick + 2, tick, bytes((127, 0, 0)))), self.now)
            began = time.process_time()
            self.game.tick(self.now, self.now)
            times.append(time.process_time() - began)
        return times


def run(entities: int, clients: int, seed: int) -> dict[str, Any]:
    """Returns the CPU time per tick in ms, before, while and after the clients join."""
    large = Large(entities, clients, seed)
    gc.collect()
    gc.freeze()  # as the server does after its start
    before = large.ticks(2 * RATE)
    large.join(clients)
    joining = large.ticks(clients // large.game.limits.joins_per_tick + 8)
    after = large.ticks(6 * RATE)
    gc.unfreeze()
    world, sent = large.game.world, large.game.counters
    return {
        "entities": len(world),
        "awake": world.awake_count,
        "clients": sum(session.entity > 0 for session in large.sessions),
        "alone_ms": statistics.median(before) * 1e3,
        "joining_ms": statistics.median(joining) * 1e3,
        "joining_worst_ms": max(joining) * 1e3,
        "served_ms": statistics.median(after) * 1e3,
        "served_p99_ms": sorted(after)[int(0.99 * len(after))] * 1e3,
        "bytes_per_client_per_s": sent.snapshot_bytes / max(sent.snapshots_sent, 1) * RATE,
    }
