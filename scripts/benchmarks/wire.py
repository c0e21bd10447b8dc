"""`bench.py bytes`: the bytes that the server sends to one client while N entities move in its view, at 20 Hz.

A game core and a client core run in one process and in simulated time, joined by a perfect link without latency. After
every tick, the client's copy of the entities in its view is compared with the server's world, bit by bit.
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
"""Ticks before the count starts: the client joins and receives terrain, and the walkers fall to the ground."""
REACH = 36.0
"""Distance from the player, in blocks along an axis, at which walkers turn back. They all stay in view."""


class Wire:
    """The server's link to the client: keeps the messages, and counts their bytes as WebSocket frames."""

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
    """The worst case of a policy: a new direction in every tick, and jumps."""

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
    """A player amid `entities` that the server moves. They appear once the player has joined."""

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
        """CPU time of the server's and of the client's share of all ticks."""

    def tick(self) -> None:
        game, now = self.game, self.game.world.tick / RATE
        if self.session.entity and not self.moved:
            self._populate()
        for entity, policy in self.moved.items():
            game.api.steered[entity] = self._homewards(entity, policy(game.world, entity))
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
        """Returns the rows that lie in the segments which the client sees."""
        sees: set[Cell] = self.session.stream.view.sees
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

    def _homewards(self, entity: int, input_: Input) -> Input:
        """Returns the input, with each axis reversed along which it leads out of the view."""
        x, y = (
            -part if abs(at - middle) > REACH and (at - middle) * part > 0 else part
            for part, at, middle in zip(input_[:2], self.game.world.position(entity), self.centre, strict=False)
        )
        return Input(x, y, input_.buttons)


def run(motion: str, entities: int, ticks: int, seed: int, *, compiled: bool | None = None) -> dict[str, Any]:
    """Returns the figures of one client. `differing` is the number of ticks in which its copy was not exact."""
    scenery = Scenery(motion, entities, seed, compiled=compiled)
    for _ in range(SETTLE_TICKS):
        scenery.tick()
    bytes_0, server_0, client_0 = scenery.wire.bytes, scenery.server_s, scenery.client_s
    in_view = moving = differing = 0
    for _ in range(ticks):
        scenery.tick()
        world, prediction = scenery.game.world, scenery.core.prediction
        assert prediction is not None
        seen = scenery.seen(world.states())
        differing += prediction.confirmed_copy.states.tobytes() != seen[:, :CELL].tobytes()
        in_view += len(seen)
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
