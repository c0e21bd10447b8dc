"""The servers that the benchmarks measure. `bench.py server` and others start them as processes.

    python -m scripts.benchmarks.busy_server KIND SCENE [BYTES]

game      the product
profile   the product, its stack sampled by CPU time; /stats shows the seconds of each part
product   the product; /stats shows the CPU time of its ticks and of garbage collections
default   like "product", but objects are not frozen after the start
off       like "product", without garbage collection
asyncio   like "product", on asyncio's own event loop
churn     the product with rules that add and remove entities and segments all the time
echo      the product's gateway and ticker without a game: the bound. It ignores inputs, and sends each client a message
          of BYTES bytes in every tick
"""

import asyncio
import collections
import functools
import gc
import operator
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import FrameType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, cast

import msgpack

from server import serving
from server.config.settings import Settings
from server.game import Game
from server.game.front import Front
from server.game.sequencer import Sequencer
from server.game.session import Session
from server.net.websocket import Connection
from server.observability.errors import FaultReporter
from server.observability.histogram import Histogram
from server.replication.change_log import ChangeLog
from server.replication.client_stream import Transport
from server.replication.sender import Sender
from server.rewind import Rewind
from server.rules import Rules
from server.runtime import event_loop, log
from server.runtime.ticker import Ticker
from server.runtime.warmup import warm_up
from shared.checks import Cell
from shared.inputs import Input
from shared.layout import X
from shared.messages import Held, Hello, Inputs, Ping, Pong, Welcome, decode_from_client, encode, head_of, join_snapshot
from shared.scene import load_scene
from shared.terrain import generate
from shared.units import TO_SEGMENT
from shared.world import World

INPUTS = head_of(Inputs), head_of(Held)
"""First two bytes of the messages with inputs."""


class Echo:
    """A substitute for `Game` in the gateway and the server. It sends messages of a fixed size."""

    def __init__(self, scene: str, size: int) -> None:
        self.scene = load_scene(scene)
        self.world = World(self.scene)  # for the server's log, which names its kernel
        self.joining = SimpleNamespace(run=None)  # nobody joins, so nothing is loaded
        self.size = size
        self.faults = FaultReporter()
        self.links: dict[int, tuple[Transport, bool]] = {}
        self.ticks = 0
        self._made = 0
        self._deadline = 0.0

    def open(self, link: Transport, now: float) -> int:
        self._made += 1
        self.links[self._made] = (link, False)
        return self._made

    def receive(self, session: int, data: bytes, now: float) -> None:
        if data[:2] in INPUTS:
            return
        message, link = decode_from_client(data), self.links[session][0]
        if isinstance(message, Hello):
            link.send(encode(Welcome(message.version, self.ticks, session, {})))
            self.links[session] = (link, True)
        elif isinstance(message, Ping):
            link.send(encode(Pong(message.sent, self.ticks + (now - self._deadline) * self.scene.tick_rate)))

    def lost(self, session: int, now: float) -> None:
        del self.links[session]

    def tick(self, deadline: float, now: float) -> None:
        self.ticks += 1
        self._deadline = deadline
        segment = msgpack.packb([0, 0, 0, -1, bytes(self.size), b"", b"", 0])
        snapshot = join_snapshot((self.ticks, -1, b"", 0, b"", b"", b""), 1, segment)
        for link, playing in tuple(self.links.values()):
            if playing:
                link.send(snapshot)

    def shut_down(self, reason: str, wait: float) -> None:
        for link, _ in tuple(self.links.values()):
            link.close(1001, reason)

    def stats(self) -> dict[str, Any]:
        return {"tick_rate": self.scene.tick_rate, "clients": len(self.links)}


DOORS: list[tuple[FunctionType, str]] = [
    (cast("FunctionType", function), part)
    for function, part in (
        (Connection.data_received, "receive"),
        (decode_from_client, "decode"),
        (Front.receive, "inputs"),
        (Sequencer.take_inputs, "inputs"),
        (World.step, "step"),
        (ChangeLog.record, "encode"),
        (ChangeLog.encode, "encode"),
        (Rewind.record, "rewind"),
        (Sender.serve, "choose"),
        (Session.send, "send"),
        (Connection.outstanding, "send"),
        (Game.tick, "rest of the tick"),
    )
]
"""Functions that enter a part of the server, with the name of the part."""
SAMPLE_S = 0.002


class Profile:
    """A profile of this process: the CPU time spent in each part, by samples of the stack."""

    def __init__(self) -> None:
        self.samples = dict.fromkeys([*(part for _, part in DOORS), "event loop"], 0.0)
        self._latest = time.process_time()
        self._parts = {function.__code__: part for function, part in DOORS}
        signal.signal(signal.SIGPROF, self._sample)
        signal.setitimer(signal.ITIMER_PROF, SAMPLE_S, SAMPLE_S)

    def _sample(self, number: int, frame: FrameType | None) -> None:
        part = None
        while part is None and frame is not None:
            part = self._parts.get(frame.f_code)
            frame = frame.f_back
        now = time.process_time()
        self.samples[part or "event loop"] += now - self._latest  # signals during its C code wait and merge
        self._latest = now


class Churn(Rules):
    """Rules that add an entity among the players in every tick and remove it after `LIFE_S`.

    Every second they unload a segment at the far end of the world, and load it again half a second later.
    """

    LIFE_S = 5.0
    AREA = 160
    """Side of the area with players, in blocks."""

    def __init__(self) -> None:
        self.alive: collections.deque[tuple[int, int]] = collections.deque()
        """Entities that these rules have added, each with the tick at which to remove it."""
        self.counts = dict.fromkeys(("spawned", "removed", "segments_loaded"), 0)

    def on_tick(self) -> None:
        game, world = self.game, self.world
        while self.alive and game.tick >= self.alive[0][0]:
            game.remove(self.alive.popleft()[1])
            self.counts["removed"] += 1
        at = (game.random.uniform(2, self.AREA - 2), game.random.uniform(2, self.AREA - 2), 28.0)
        self.alive.append((game.tick + game.ticks(self.LIFE_S), game.spawn("player", at)))
        self.counts["spawned"] += 1
        corner: Cell = (game.scene.size[0] - 1, game.scene.size[1] - 1, 0)
        if game.tick % game.ticks(1.0) == 0:
            world.unload_segment(corner)
        elif corner not in world.blocks and game.tick % game.ticks(0.5) == 0:
            world.load_segment(corner, generate(game.scene.terrain, corner))
            self.counts["segments_loaded"] += 1

    world: World
    """The game's world. Other rules do not load and unload segments, so the game API does not offer it."""


class Stopwatch:
    """Measures the CPU time of a game's ticks, of their part before the step, and of each garbage collection."""

    def __init__(self, game: Game) -> None:
        self.ticks, self.before_step, self.collections = Histogram(), Histogram(), Histogram()
        self._plain_tick, self._plain_step = game.tick, game.world.step
        cast("Any", serving).Ticker = lambda rate, tick, *more, **options: Ticker(rate, self._tick, *more, **options)
        self._tick_began = self._collection_began = 0.0
        self.full_collection_s: float | None = None
        """CPU time of the collection that SIGUSR1 requested, in seconds; None until it is done."""
        cast("Any", game.world).step = self._step
        gc.callbacks.append(self._collect)
        signal.signal(signal.SIGUSR1, lambda number, frame: self._collect_all())

    def stats(self) -> dict[str, Any]:
        return {
            "tick_cpu_counts": self.ticks.counts(),
            "before_step_cpu_counts": self.before_step.counts(),
            "collection_cpu_counts": self.collections.counts(),
            "collections_cpu_s": self.collections.sum_s,
            "collections": self.collections.count,
            "full_collection_s": self.full_collection_s,
            "collecting": gc.isenabled(),
            "frozen": gc.get_freeze_count(),
            "loop": type(asyncio.get_running_loop()).__module__.partition(".")[0],
        }

    def _collect_all(self) -> None:
        began = time.thread_time()
        gc.collect()
        self.full_collection_s = time.thread_time() - began

    def _tick(self, deadline: float, now: float) -> None:
        self._tick_began = time.thread_time()
        self._plain_tick(deadline, now)
        self.ticks.record(time.thread_time() - self._tick_began)

    def _step(self, inputs: Mapping[int, Input] | None = None) -> None:
        self.before_step.record(time.thread_time() - self._tick_began)
        self._plain_step(inputs)

    def _collect(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._collection_began = time.thread_time()
        else:
            self.collections.record(time.thread_time() - self._collection_began)


VARIANTS: dict[str, tuple[ModuleType, str, Callable[[], Any]]] = {
    "default": (serving, "freeze", lambda: None),
    "off": (serving, "freeze", gc.disable),
    "asyncio": (event_loop, "loop_factory", lambda: asyncio.new_event_loop),
}
"""Function of the product that a variant replaces (module and name), and the replacement."""


def in_view(game: Game) -> float:
    """Returns the average number of entities in the segments that a client sees."""
    cells = game.world.states()[:, X : X + 3] >> TO_SEGMENT
    inhabitants = collections.Counter(map(tuple, cells.tolist()))
    views = [sum(inhabitants[segment] for segment in session.sees) for session in game.sessions]
    return sum(views) / max(len(views), 1)


class Measured(serving.Server):
    """The product's server with more figures in /stats."""

    def __init__(self, settings: Settings, game: Game, more: Sequence[Callable[[], dict[str, Any]]]) -> None:
        self._more = more
        super().__init__(settings, game)

    def stats(self) -> dict[str, Any]:
        return functools.reduce(operator.or_, (each() for each in self._more), super().stats())


def serve(served: Game, *more: Callable[[], dict[str, Any]]) -> None:
    """Runs the server as `python -m server` does, on a free port, with more figures in /stats."""
    settings = Settings(port=0, page=False, log_level="warning")
    log.set_up(settings.log_level, settings.log_format, sys.stderr)
    with asyncio.Runner(loop_factory=event_loop.loop_factory()) as runner:
        runner.run(Measured(settings, served, more).serve())


def main(argv: list[str]) -> int:
    kind, scene = argv[:2]
    if kind == "echo":
        serve(cast("Game", Echo(scene, int(argv[2]))))
        return 0
    rules = load_scene(scene)
    warm_up(rules)
    churn = Churn() if kind == "churn" else None
    made = Game(rules, rules=churn)
    more: list[Callable[[], dict[str, Any]]] = [lambda: {"entities_in_view": in_view(made)}]
    if churn is not None:
        churn.world = made.world
        more.append(lambda: dict(churn.counts))
    if kind in ("product", *VARIANTS):
        more.append(Stopwatch(made).stats)
        if kind != "product":
            module, name, other = VARIANTS[kind]
            assert hasattr(module, name)
            setattr(module, name, other)
    if kind == "profile":
        profile = Profile()
        more.append(lambda: {"samples": dict(profile.samples)})
    serve(made, *more)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
