"""The work of the parts of a world on many processes, in one process and without sockets.

The same players wander in a `Game` and in a world with a sequencer, an edge and a standby, tick by tick in turn. The
CPU time of each part's own work is measured in each tick. It has no event loop, no sockets and no bus, so it depends
little on what else the machine does, and the edge is compared with the game within one tick.
"""

import gc
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from scripts.benchmarks.memory import Sink
from server.config.limits import Limits
from server.game import Game
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.runtime.warmup import warm_up
from server.scale.edge import EdgeServer
from server.scale.replica import Replica
from server.scale.sequencer import WorldSequencer, begin_record
from server.scale.wire import batch_of, packed, record_of
from shared import messages
from shared.inputs import Input, row
from shared.messages import Bye, Hello, Inputs, encode
from shared.scene import Scene

PARTS = ("game", "edge", "sequencer", "standby")
SETTLE_TICKS, BLOCK_TICKS = 96, 32
"""Ticks after the joins, in which terrain is delivered. Ticks whose work is one measurement; one of them has a hash of
the world."""


class Served(Protocol):
    """A game or an edge, as its clients see it."""

    world: RecordedWorld

    def open(self, link: Any, now: float) -> Any: ...

    def receive(self, session: Any, data: bytes, now: float) -> None: ...

    def lost(self, session: Any, now: float) -> None: ...


class Clients:
    """The clients of a game or an edge. Equal ones of two servers send equal inputs."""

    def __init__(self, server: Served, newest: Callable[[], int]) -> None:
        self._server, self._newest = server, newest
        self.sessions: list[Any] = []
        self._moves: list[bytes] = []
        self._rng = random.Random(5)

    def join(self, now: float) -> None:
        """Adds a client."""
        session = self._server.open(Sink(), now)
        self._server.receive(session, encode(Hello(messages.VERSION, {}, f"player {len(self.sessions)}")), now)
        self.sessions.append(session)
        self._moves.append(bytes(3))

    def leave(self, now: float) -> None:
        """Lets the client that joined last leave."""
        session = self.sessions.pop()
        self._moves.pop()
        self._server.receive(session, encode(Bye(messages.GOING_AWAY, "", -1.0)), now)
        self._server.lost(session, now)

    def messages(self, rate: int) -> list[tuple[Any, bytes]]:
        """Returns what the clients send in a tick: their inputs, with a new direction about once a second."""
        told, rng = [], self._rng
        for number, session in enumerate(self.sessions):
            if rng.random() < 1 / rate:
                self._moves[number] = row(Input(rng.randint(-127, 127), rng.randint(-127, 127)))
            jump = b"\1" if rng.random() < 0.01 else self._moves[number][2:3]
            inputs = self._moves[number][:2] + jump
            if session.entity:
                told.append((session, encode(Inputs(self._newest() + 2, self._server.world.tick, inputs))))
        return told


class World:
    """A game, and the same world on many processes."""

    def __init__(self, scene: Scene) -> None:
        limits = Limits(joins_per_tick=8)
        self.scene, self.now = scene, 0.0
        self.game = Game(scene, limits=limits)
        world = RecordedWorld(scene)
        world.load_terrain()
        first = Replica(world, PersistedState())
        edge = first.copy()
        self.standby = first.copy()
        self.edge = EdgeServer("edge", edge, limits)
        self.sequencer = WorldSequencer(world, None, limits)
        _, begin = begin_record(first)
        self.edge.follow(record_of(begin), self.now)
        self.standby.take(record_of(begin))
        self.bytes = {"log": 0, "batches": 0}
        self.clients = [
            Clients(self.game, lambda: self.game.newest),
            Clients(self.edge, lambda: self.edge.newest),
        ]

    @property
    def playing(self) -> int:
        """Number of players in the world on many processes that play."""
        return sum(session.acknowledged for session in self.clients[1].sessions)

    def hold(self, players: int) -> None:
        """Lets players join or leave until `players` play, and waits until they have their terrain."""
        for clients in self.clients:
            while len(clients.sessions) > players:
                clients.leave(self.now)
        while len(self.clients[0].sessions) < players:
            for clients in self.clients:
                clients.join(self.now)
            self.tick()
        for _ in range(SETTLE_TICKS):
            self.tick()
        assert self.playing == players == len(self.game.players) == len(self.sequencer.api.players)

    def block(self) -> dict[str, float]:
        """Returns the means of some ticks: the CPU time of each part in microseconds, and the bytes."""
        self.bytes = dict.fromkeys(self.bytes, 0)
        ticks = [self.tick() for _ in range(BLOCK_TICKS)]
        spent = {part: 1e6 * sum(tick[part] for tick in ticks) / BLOCK_TICKS for part in PARTS}
        return spent | {name: size / BLOCK_TICKS for name, size in self.bytes.items()}

    def tick(self) -> dict[str, float]:
        """Runs a tick. Returns the CPU time of each part in seconds."""
        spent = dict.fromkeys(PARTS, 0.0)
        self.now += 1 / self.scene.tick_rate
        now = self.now

        @contextmanager
        def measured(part: str) -> Iterator[None]:
            began = time.thread_time()
            yield
            spent[part] += time.thread_time() - began

        told, same = (clients.messages(self.scene.tick_rate) for clients in self.clients)
        with measured("game"):
            for session, data in told:
                self.game.receive(session, data, now)
            self.game.tick(now, now)
        with measured("edge"):
            for session, data in same:
                self.edge.receive(session, data, now)
            batch = self.edge.collect(now, now)
            assert batch is not None
            sent = packed(batch)
        with measured("sequencer"):
            self.sequencer.receive(batch_of(sent), now)
            log = self.sequencer.tick(now)
        with measured("standby"):
            self.standby.take(record_of(log))
            self.standby.settle()
        with measured("edge"):
            self.edge.follow(record_of(log), now)
        self.bytes["log"] += len(log)
        self.bytes["batches"] += len(sent)
        return spent


def work(scene: Scene, players: Sequence[int], rounds: int, blocks: int) -> list[dict[str, float]]:
    """Returns measurements: the number of `players`, the CPU time of each part per tick in microseconds, and the bytes.

    The numbers of players take turns, so a machine that is slower for a while does not look like a cost of players.

    Args:
        scene: the scene.
        players: the numbers of players.
        rounds: how often there are that many players.
        blocks: number of blocks each time. The one in which the parts took the least time together is returned.
    """
    warm_up(scene)
    world, found = World(scene), []
    for turn in range(rounds):
        for number in players if turn % 2 else reversed(players):
            world.hold(number)
            gc.collect()
            gc.disable()
            try:
                tried = [world.block() for _ in range(blocks)]
            finally:
                gc.enable()
            best = min(tried, key=lambda block: sum(block[part] for part in PARTS))
            found.append({"players": number, **best})
    return found
