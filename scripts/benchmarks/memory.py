"""Memory of a connection, an entity and a loaded segment in the server, and a check that it is freed afterwards.

Counted by tracemalloc, which sees Python's objects and numpy's arrays but not the allocator's slack. It runs in one
process, without sockets.
"""

import gc
import tracemalloc
from collections.abc import Callable
from typing import Any

from server.config.limits import Limits
from server.game import Game
from server.game.session import Session
from shared import messages
from shared.checks import Cell
from shared.messages import Hello, Inputs, encode
from shared.scene import Scene, load_scene
from shared.terrain import generate
from shared.units import SEGMENT

SIDE = 12
"""Segments along one side of the world."""
ENTITIES = 10_000
CLIENTS = 200


def wide() -> Scene:
    """Returns a scene of hills, 384 blocks along each side."""
    table: dict[str, Any] = load_scene("hills").to_table()
    middle = SIDE * SEGMENT / 2
    return Scene.from_table(table | {"size": [SIDE, SIDE, 1], "spawns": [[middle, middle, 28.0]], "tick_rate": 30})


class Sink:
    """A link that discards all messages."""

    def send(self, message: bytes) -> None:
        pass

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        pass


class Played:
    """A game with its clients and its time."""

    def __init__(self) -> None:
        self.game = Game(wide(), limits=Limits(resume_s=0.0, joins_per_tick=1000))
        self.now = 0.0
        self.clients: list[Session] = []

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.now += 1 / 30
            tick = self.game.world.tick
            for session in self.clients:
                if session.entity:
                    self.game.receive(
                        session, encode(Inputs(tick + 2, tick, bytes((127, 0, tick % 64 == 0)))), self.now
                    )
            self.game.tick(self.now, self.now)

    def join(self, n: int) -> None:
        for i in range(n):
            session = self.game.open(Sink(), self.now)
            self.game.receive(session, encode(Hello(messages.VERSION, {}, f"player {i}")), self.now)
            self.clients.append(session)

    def leave(self) -> None:
        for session in self.clients:
            self.game.lost(session, self.now)
        self.clients.clear()

    def churn(self) -> None:
        """Runs a cycle: clients join and leave, entities appear and are removed, a segment is unloaded and loaded."""
        game, side = self.game, SIDE * SEGMENT
        self.join(20)
        made = [game.world.spawn("player", (4 + 3 * i % (side - 8), 9.5, 28.0)) for i in range(100)]
        self.tick(40)
        for entity in made:
            if entity in game.world:
                game.world.remove(entity)
                game.log.note_removal(entity)
        self.leave()
        corner: Cell = (SIDE - 1, SIDE - 1, 0)
        game.world.unload_segment(corner)
        self.tick(5)
        game.world.load_segment(corner, generate(game.scene.terrain, corner))
        self.tick(100)  # more ticks than the server keeps in any history


def held() -> int:
    """Returns the bytes in use."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def cost(n: int, act: Callable[[], Any]) -> float:
    """Returns the bytes that stay in use for each of the `n` things that `act` makes."""
    before = held()
    act()
    return (held() - before) / n


def costs() -> dict[str, float]:
    """Returns the bytes per segment, per entity that has moved and rests, and per connection with a walking entity."""
    played = Played()
    world = played.game.world
    side = SIDE * SEGMENT - 8
    played.tick(80)

    def load() -> None:
        for segment in above():
            world.load_segment(segment, generate(world.scene.terrain, segment))
        played.tick(80)

    def populate() -> None:
        world.spawn_many("player", [(4 + 2 * i % side, 4 + 2 * (2 * i // side), 60.0) for i in range(ENTITIES)])
        played.tick(160)

    def connect() -> None:
        played.join(CLIENTS)
        played.tick(80)

    return {
        "bytes_per_segment": cost(SIDE * SIDE, load),
        "bytes_per_entity": cost(ENTITIES, populate),
        "bytes_per_connection": cost(CLIENTS, connect),
    }


def churn(cycles: int) -> list[int]:
    """Returns the bytes in use after each cycle."""
    played, after = Played(), []
    for _ in range(cycles):
        played.churn()
        after.append(held())
    return after


def run(cycles: int) -> dict[str, Any]:
    """Returns all figures of the benchmark."""
    tracemalloc.start()
    try:
        return {**costs(), "bytes_after_each_cycle": churn(cycles)}
    finally:
        tracemalloc.stop()


def above() -> list[Cell]:
    """Returns the segments above those of the scene."""
    return [(x, y, 1) for x in range(SIDE) for y in range(SIDE)]
