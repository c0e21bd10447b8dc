"""What one client is sent while so many entities move in its view, at 20 Hz; `bench.py bytes` runs it.

A whole game core and a whole client core in one process and in simulated time, joined by a wire that loses nothing and
takes no time. The client's copy of what it sees is compared with the server's world after every tick, bit by bit.
"""

import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from client_sdk.bots import POLICIES, Policy
from client_sdk.core import Core
from server.game import Game
from shared.checks import Cell
from shared.inputs import Input, make_input
from shared.layout import CELL, Int64s, X
from shared.scene import Scene, load_scene
from shared.units import TO_SEGMENT
from shared.world import OverlapError, World

RATE = 20
SETTLE_TICKS = 120
"""Nothing is counted before: the client joins, terrain comes in, walkers fall to the ground."""
REACH = 36.0
"""Walkers turn back when they are so many blocks from the player, along an axis: all stay in view."""


class Wire:
    """The server's link to the client: what is sent lies here, and what it is as WebSocket frames is counted."""

    def __init__(self) -> None:
        self.messages: list[bytes] = []
        self.bytes = 0

    def send(self, message: bytes) -> None:
        self.messages.append(message)
        self.bytes += len(message) + (2 if len(message) < 126 else 4)

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        raise RuntimeError(f"closed: {code} {reason}")


class Restless:
    """The worst case: another direction in every tick, and jumps."""

    def __init__(self, rng: random.Random) -> None:
        self._random = rng

    def __call__(self, world: World, me: int) -> Input:
        rng = self._random
        return make_input(2 * rng.random() - 1, 2 * rng.random() - 1, jump=rng.random() < 0.1)


MOTIONS: dict[str, Callable[[random.Random], Policy]] = {
    "wander": POLICIES["wander"],
    "run-and-jump": POLICIES["run-and-jump"],
    "restless": Restless,
}


class Scenery:
    """A player in the middle of so many entities, which the server moves; they join when the player has."""

    def __init__(self, motion: str, entities: int, seed: int, *, compiled: bool | None = None) -> None:
        self.entities, self.motion, self.rng = entities, MOTIONS[motion], random.Random(seed)
        table = load_scene("hills").to_table()
        self.game = Game(Scene.from_table(table | {"tick_rate": RATE}), compiled=compiled)
        self.wire, self.core = Wire(), Core("observer", compiled=compiled)
        self.session = self.game.open(self.wire, 0.0)
        self.core.open(0.0)
        self.centre = (0.0, 0.0, 0.0)
        self.moved: dict[int, Policy] = {}
        self.server_s = self.client_s = 0.0
        """CPU time of all ticks."""

    def tick(self) -> None:
        game, now = self.game, self.game.world.tick / RATE
        if self.session.entity and not self.moved:
            self._populate()
        for entity, policy in self.moved.items():
            game.stage.steered[entity] = self._homewards(entity, policy(game.world, entity))
        began = time.process_time()
        game.tick(now, now)
        ended = time.process_time()
        messages, self.wire.messages = self.wire.messages, []
        for message in messages:
            self.core.receive(message, now)
        self.core.update(now + 0.2 / RATE)
        self.server_s += ended - began
        self.client_s += time.process_time() - ended
        for message in self.core.outgoing():
            game.receive(self.session, message, now + 0.5 / RATE)

    def seen(self, rows: Int64s) -> Int64s:
        """Those that lie in the segments which the client sees."""
        sees: set[Cell] = self.session.sight.sees
        cells = (rows[:, X : X + 3] >> TO_SEGMENT).tolist()
        seen: Int64s = rows[np.array([tuple(cell) in sees for cell in cells], bool)]
        return seen

    def _populate(self) -> None:
        world = self.game.world
        self.centre = world.position(self.session.entity)
        x, y, z = self.centre
        while len(self.moved) < self.entities:
            place = (x + self.rng.uniform(-REACH, REACH), y + self.rng.uniform(-REACH, REACH), z + 2)
            try:
                self.moved[world.spawn(self.game.scene.player, place)] = self.motion(self.rng)
            except OverlapError:
                continue

    def _homewards(self, entity: int, wish: Input) -> Input:
        """The wish, turned around where it leads out of the view."""
        x, y = (
            -part if abs(at - middle) > REACH and (at - middle) * part > 0 else part
            for part, at, middle in zip(wish[:2], self.game.world.position(entity), self.centre, strict=False)
        )
        return Input(x, y, wish.buttons)


def run(motion: str, entities: int, ticks: int, seed: int, *, compiled: bool | None = None) -> dict[str, Any]:
    """One client for so many ticks among so many entities; `differing`: ticks in which its copy was not exact."""
    scenery = Scenery(motion, entities, seed, compiled=compiled)
    for _ in range(SETTLE_TICKS):
        scenery.tick()
    bytes_0, server_0, client_0 = scenery.wire.bytes, scenery.server_s, scenery.client_s
    in_view = moving = differing = 0
    for _ in range(ticks):
        scenery.tick()
        world, prediction = scenery.game.world, scenery.core.prediction
        assert prediction is not None
        truth = scenery.seen(world.states())
        differing += prediction.known.states.tobytes() != truth[:, :CELL].tobytes()
        in_view += len(truth)
        moving += len(scenery.seen(world.changed))
    return {
        "motion": motion,
        "seed": seed,
        "ticks": ticks,
        "differing": differing,
        "in_view": in_view / ticks,
        "moving": moving / ticks,
        "bytes_per_s": (scenery.wire.bytes - bytes_0) / ticks * RATE,
        "server_us_per_tick": (scenery.server_s - server_0) / ticks * 1e6,
        "client_us_per_tick": (scenery.client_s - client_0) / ticks * 1e6,
    }
