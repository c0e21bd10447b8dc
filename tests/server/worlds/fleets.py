"""A fleet in simulated time: processes, the keys of a bus with delays and losses, a shared disk, and clients."""

import dataclasses
import random
from collections import Counter
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count
from typing import Any

from server.config.limits import Limits
from server.game import Game
from server.worlds.fleet_view import Failed, Result, Value
from server.worlds.fleet_worlds import FleetWorlds
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind
from server.worlds.lease import Request
from shared import messages
from shared.fields import split_place
from shared.messages import Bye, Go, Hello, Message, Ping, Welcome, decode_from_server, encode
from tests.server.worlds.hosts import FLAT, kind

SLOW = dataclasses.replace(FLAT, tick_rate=10)
TICK_S = 0.1
KEY = b"a key of all processes of a fleet"


def slow_kind(name: str = "arena", **more: Any) -> Kind:
    """Returns a kind whose worlds tick ten times per second."""
    return dataclasses.replace(kind(name, **more), scene=SLOW)


class Sim:
    """The simulated time, the keys, the disk and all processes and clients.

    Args:
        seed: source of everything random.
        kinds: the kinds of worlds of all processes.
        saved: whether worlds are saved on the disk.
        delay_s: longest time of a message between a process and the bus.
        lost: share of the requests to the bus that get no answer.
    """

    def __init__(self, seed: int, *kinds: Kind, saved: bool = False, delay_s: float = 0.02, lost: float = 0.0) -> None:
        self.chance, self.kinds, self.saved = random.Random(seed), kinds, saved
        self.delay_s, self.lost = delay_s, lost
        self.now = 100.0
        self.keys: dict[str, Value] = {}
        self.revision = 0
        self.bus_up = True
        self.disk: dict[str, list[int]] = {}
        self.acknowledged: dict[str, list[int]] = {}
        self.edits = count()
        self.processes: list[Process] = []
        self.clients: list[Visitor] = []
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def at(self, when: float, act: Callable[[], None]) -> None:
        heappush(self._queue, (when, next(self._order), act))

    def run(self, seconds: float) -> None:
        """Runs for that many simulated seconds."""
        until = self.now + seconds
        while self._queue and self._queue[0][0] <= until:
            when, _, act = heappop(self._queue)
            self.now = max(self.now, when)
            act()
        self.now = until

    def until(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        end = self.now + seconds
        while not condition():
            assert self.now < end, "the condition did not hold in time"
            self.run(0.1)

    def start(self, **more: Any) -> "Process":
        process = Process(self, len(self.processes), **more)
        self.processes.append(process)
        return process

    def visit(self, path: str, **more: Any) -> "Visitor":
        visitor = Visitor(self, len(self.clients), path, **more)
        self.clients.append(visitor)
        return visitor

    @property
    def alive(self) -> list["Process"]:
        return [process for process in self.processes if process.alive]

    def front(self) -> "Process":
        """Returns a process by chance, as a balancer with health checks would."""
        ready = [process for process in self.alive if self.now >= process.stopped_until and not process.worlds.draining]
        return self.chance.choice(ready or self.alive)

    def at_url(self, url: str) -> "Process | None":
        return next((process for process in self.alive if process.url == url), None)

    def delay(self) -> float:
        return self.chance.uniform(0.1, 1.0) * self.delay_s

    def owners(self, name: str) -> list["Process"]:
        """Returns the processes that would change a world now, also those that are stopped."""
        return [process for process in self.alive if process.worlds.fleet.owns(name, self.now)]

    # -- the keys ----------------------------------------------------------------------------------------------

    def request(self, process: "Process", request: Request) -> None:
        """Carries a request out after a while, and answers it after another while, or after 2 s not at all."""
        lost = self.chance.random() < self.lost
        reaches = self.bus_up and not (lost and self.chance.random() < 0.5)
        answer: list[Result] = [Failed(False)]

        def carry_out() -> None:
            if reaches and self.bus_up:
                result = self.change(request)
                if not lost:
                    answer[0] = result

        def give() -> None:
            process.does(lambda: process.worlds.fleet.answered(request, answer[0], self.now))

        there = self.now + self.delay()
        self.at(there, carry_out)
        self.at(there + self.delay() if reaches and not lost else self.now + 2.0, give)

    def change(self, request: Request) -> Result:
        found = self.keys.get(request.key)
        if request.what == "get":
            return found
        if request.revision != (0 if found is None else found.revision):
            return Failed(True)
        if request.what == "delete":
            self.set(request.key, None)
            return None
        return self.set(request.key, request.value)

    def set(self, key: str, value: bytes | None) -> int:
        """Sets a key, and tells all processes."""
        self.revision += 1
        if value is None:
            self.keys.pop(key, None)
        else:
            self.keys[key] = Value(value, self.revision)
        for process in self.alive:
            process.told(key)
        return self.revision


class Process:
    """One process of the fleet, with its host.

    Args:
        sim: the simulation.
        number: its number.
        limits: its limits.
    """

    def __init__(self, sim: Sim, number: int, limits: Limits | None = None) -> None:
        self.sim, self.number, self.url = sim, number, f"ws://10.0.0.{number + 1}:8765"
        self.alive, self.stopped_until = True, 0.0
        self.limits = limits or Limits(creations_per_s=1000.0)
        self.ticking: dict[str, HostedWorld] = {}
        self.folders: dict[str, str] = {}
        self.worlds = FleetWorlds({kind.name: kind for kind in sim.kinds}, self.limits, self)
        ids = random.Random(f"{sim.chance.random()}")
        self.worlds.join(
            "test",
            self.url,
            self,
            key=KEY,
            clock=lambda: sim.now,
            wall=lambda: sim.now,
            token=lambda: "".join(ids.choices("abcdefghijkmnpqrstuvwxyz23456789", k=16)),
        )
        for key, value in tuple(sim.keys.items()):
            self.worlds.fleet.news(key, value, sim.now)
        sim.at(sim.now + sim.chance.random() * TICK_S, self._tick)

    def does(self, act: Callable[[], None]) -> None:
        """Does something now, or once the process is not stopped any more."""
        if self.sim.now < self.stopped_until:
            self.sim.at(self.stopped_until, lambda: self.does(act))
        elif self.alive:
            act()

    def told(self, key: str) -> None:
        """Reads a key that has changed."""
        fleet = self.worlds.fleet
        due = self.sim.now + self.sim.delay()
        self.sim.at(due, lambda: self.does(lambda: fleet.news(key, self.sim.keys.get(key), self.sim.now)))

    def kill(self) -> None:
        self.alive = False
        for client in self.sim.clients:
            client.cut(self)

    def stop(self, seconds: float) -> None:
        """Suspends the process. A write to the disk that has begun goes on when it wakes."""
        self.stopped_until = self.sim.now + seconds
        late = [(name, self.folders[name]) for name in self.ticking if name in self.folders]

        def write_late() -> None:
            for name, folder in late:
                self._edit(name, folder)

        self.sim.at(self.stopped_until, lambda: self.does(write_late))

    def _tick(self) -> None:
        self.does(self._ticks)

    def _ticks(self) -> None:
        worlds, now = self.worlds, self.sim.now
        for name, world in tuple(self.ticking.items()):
            if worlds.fleet.owns(name, now):
                others = [each for each in self.sim.owners(name) if each is not self]
                assert not others, f"{name} is changed by {self.number} and {others[0].number}"
                world.game.tick(now, now)
                if name in self.folders:
                    self._edit(name, self.folders[name])
        worlds.tick(now)
        requests, worlds.fleet.requests = worlds.fleet.requests, []
        for request in requests:
            self.sim.request(self, request)
        self.sim.at(now + TICK_S, self._tick)

    def _edit(self, name: str, folder: str) -> None:
        """Saves a new edit, and acknowledges it if the world is still owned afterwards."""
        edit = next(self.sim.edits)
        if folder in self.sim.disk:
            self.sim.disk[folder].append(edit)
            if self.worlds.fleet.owns(name, self.sim.now) and self.folders.get(name) == folder:
                self.sim.acknowledged.setdefault(name, []).append(edit)

    # -- the host ----------------------------------------------------------------------------------------------

    def begin(self, world: HostedWorld) -> Game:
        if self.sim.saved:
            self.folders.setdefault(world.name, world.name)
            self.sim.disk.setdefault(self.folders[world.name], [])
        limits = dataclasses.replace(self.limits, clients_max=world.kind.players_max)
        return Game(world.kind.scene, rules=world.kind.rules(), limits=limits)

    def wake(self, world: HostedWorld) -> None:
        self.ticking[world.name] = world

    def rest(self, world: HostedWorld) -> None:
        del self.ticking[world.name]

    def ended(self, world: HostedWorld, *, keep: bool) -> None:
        folder = self.folders.pop(world.name, None)
        if folder is not None and not keep:
            del self.sim.disk[folder]
            self.sim.acknowledged.pop(world.name, None)

    def folder(self, name: str) -> str:
        return self.folders.get(name, "")

    def take(self, name: str, folder: str, number: int, done: Callable[[str | None], None]) -> None:
        def copy() -> None:
            new = f"{name}@{number}" if self.sim.saved else ""
            if folder in self.sim.disk:
                self.sim.disk[new] = list(self.sim.disk[folder])
            done(new)

        self.sim.at(self.sim.now + self.sim.chance.uniform(0, 0.5), lambda: self.does(copy))

    def locate(self, name: str, folder: str) -> None:
        if folder:
            self.folders[name] = folder

    def left(self, world: HostedWorld) -> None:
        self.folders.pop(world.name, None)

    def closed(self, name: str, done: Callable[[], None]) -> None:
        self.sim.at(self.sim.now + 0.05, lambda: self.does(done))


class Visitor:
    """A client as bytes: it follows `Go`, and comes back by the name of its world after a lost connection.

    Args:
        sim: the simulation.
        number: its number.
        path: the path that it asks for, at any process.
        front: the process that it asks first; None: any.
    """

    def __init__(self, sim: Sim, number: int, path: str, front: Process | None = None) -> None:
        self.sim, self.name, self.first, self.path = sim, f"visitor {number}", path, path
        self.server: Process | None = None
        self.url = "" if front is None else front.url
        self.resume, self.entity = b"", 0
        self.world = ""
        """The world that it is in; empty: none."""
        self.tries, self.alone = 0, False
        self.refused: list[str] = []
        self.counts = Counter[str]()
        self._way: Any = None
        self._session: Any = None
        self._line = 0
        sim.at(sim.now, self._connect)
        sim.at(sim.now + 1.0, self._ping)

    # -- the server's side of the connection

    class Link:
        """The connection, as the server sees it."""

        def __init__(self, visitor: "Visitor", line: int) -> None:
            self.visitor, self.line = visitor, line

        def send(self, data: bytes) -> None:
            self.visitor._later(self.line, lambda: self.visitor._got(decode_from_server(data)))

        def outstanding(self) -> int:
            return 0

        def close(self, code: int, reason: str) -> None:
            visitor = self.visitor
            if visitor._line == self.line and visitor._session is not None:
                session, visitor._session = visitor._session, None
                visitor._way.lost(session, visitor.sim.now)
            self.visitor._later(self.line, self.visitor._ended)

    def cut(self, process: Process) -> None:
        """Breaks the connection to a process."""
        if self.server is process:
            self._later(self._line, self._ended)

    def leave(self) -> None:
        """Leaves the game."""
        self.first = ""
        if self._session is not None and self.server is not None:
            way, session = self._way, self._session
            self.server.does(lambda: way.receive(session, encode(Bye(1000, "", -1.0)), self.sim.now))
        self._drop()

    def _later(self, line: int, act: Callable[[], None]) -> None:
        self.sim.at(self.sim.now + 0.01, lambda: act() if line == self._line else None)

    def _drop(self) -> None:
        """Ends the connection. The server notices at once, or when it wakes."""
        self._line += 1
        if self._session is not None and self.server is not None:
            way, session = self._way, self._session
            self.server.does(lambda: way.lost(session, self.sim.now))
        self.server, self._way, self._session, self.world = None, None, None, ""

    def _connect(self) -> None:
        if not self.first:
            return
        self._drop()
        line = self._line
        process = self.sim.at_url(self.url) if self.url else self.sim.front()
        if process is None:
            self._later(line, self._ended)
            return
        self.server = process
        process.does(lambda: self._open(process, line))
        self.sim.at(self.sim.now + 5.0, lambda: self._ended() if line == self._line and not self._session else None)

    def _open(self, process: Process, line: int) -> None:
        if line != self._line:
            return
        way = process.worlds.route(self.path)
        if isinstance(way, str):
            self.refused.append(way)
            self._later(line, self._ended)
            return
        self._way, self._session = way, way.open(self.Link(self, line), self.sim.now)
        self._send(Hello(messages.VERSION, {}, self.name, "", self.resume))

    def _send(self, message: Message) -> None:
        if self._session is not None and self.server is not None:
            way, session = self._way, self._session
            self.server.does(lambda: way.receive(session, encode(message), self.sim.now))

    def _ping(self) -> None:
        if self.first:
            self._send(Ping(self.sim.now, 0))
            self.sim.at(self.sim.now + 1.0, self._ping)

    def _got(self, message: Message) -> None:
        if isinstance(message, Go):
            url, path = split_place(message.path)
            if not self.resume or path.partition("?")[0] != self.path.partition("?")[0]:
                self.resume = b""
            self.url = url or (self.server.url if self.server else "")
            self.path = path
            self._hop()
        elif isinstance(message, Welcome):
            name = self.path.partition("?")[0].strip("/")
            self.counts["same" if self.resume and message.entity == self.entity else "new"] += 1
            self.path, self.world, self.tries = f"/{name}", name, 0
            self.resume, self.entity = message.resume, message.entity
        elif isinstance(message, Bye):
            self.refused.append(message.reason)
            if message.wait < 0 and self.resume:
                self.resume, self.path, self.url = b"", self.first, ""

    def _hop(self) -> None:
        self._drop()
        self.sim.at(self.sim.now + 0.02, self._connect)

    def _ended(self) -> None:
        """Comes again after a lost connection: to its world, or to the first path; at any process."""
        self._drop()
        if not self.first:
            return
        self.tries += 1
        self.url = ""
        if not self.resume:
            self.path = self.first
        self.sim.at(self.sim.now + min(0.25 * 2**self.tries, 2.0), self._connect)
