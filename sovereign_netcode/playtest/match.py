"""A match in simulated time: the real server core and real SDK cores, one `now`, one seed.

Nothing sleeps, and the result does not depend on the machine. Every delivery, tick and frame is an entry in one queue,
ordered by simulated time. The wires (`client_sdk.netsim.links`) model TCP: a message may be late, but is not lost or
reordered.
"""

import math
import random
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from itertools import count
from typing import Any

from client_sdk import bots
from client_sdk.core import Core
from client_sdk.events import Event
from client_sdk.netsim.links import Link as Link
from client_sdk.netsim.links import LinkEvents, TcpStream
from server.config.limits import Limits
from server.game import Game
from server.rules import Rules, prepared
from server.worlds.host import Way
from server.worlds.kinds import Kind
from shared.inputs import Input
from shared.scene import Scene
from sovereign_netcode.playtest.local_worlds import LocalWorlds

Policy = Callable[[Core, random.Random], Input]


class Player:
    """One client: its core, its clock, its policy and its two wires. It also serves as the server's `Link`."""

    def __init__(self, match: "Simulation", core: Core, path: Link, policy: Policy, seed: int) -> None:
        self.match, self.core, self.policy = match, core, policy
        self.rng = random.Random(seed)
        self.drift = self.rng.uniform(-200e-6, 200e-6)
        self.clock_start = self.rng.uniform(0, 1e5)
        self.events: list[Event] = []
        self._way: Way
        self.closed: tuple[int, str] | None = None
        self.session: Any = None
        self.link_events = LinkEvents(path, seed + 3)
        self._seed = seed
        self._connect_wires()
        self._acted = -1
        self.frame_s = 0.0
        """Seconds between two frames, in which the client reads and updates; 0: whenever something is due."""
        self._inbox: list[bytes] = []
        self._away = False

    @property
    def place(self) -> str:
        """The path of the next connection, behind the address of its server if the client was sent to another one."""
        return self.core.travel.server + self.core.travel.path

    @property
    def local(self) -> float:
        """Time on the client's own clock."""
        return self.clock_start + self.match.now * (1 + self.drift)

    def _connect_wires(self) -> None:
        self.up = TcpStream(self.match, self.link_events, self._seed + 1, self._at_server)
        self.down = TcpStream(self.match, self.link_events, self._seed + 2, self._at_client)
        self._seed += 10

    def connect(self) -> None:
        """Opens the connection to the path that the core names."""
        way = self.match.route(self.place)
        if isinstance(way, str):
            self.core.port.lost(1006, way, self.local)
        else:
            self._way, self.closed = way, None
            self.session = way.open(self, self.match.now)
            self.core.port.open(self.local)
        self._update()

    def disconnect(self) -> None:
        """Breaks the connection. Messages in transit are lost. The client reconnects if its core has `patience_s`."""
        assert self.session is not None
        self._way.lost(self.session, self.match.now)
        self._inbox.clear()
        self._cut(1006, "gone")
        self._update()

    def _cut(self, code: int, reason: str) -> None:
        self.session = None
        self.up.cut()
        self.down.cut()
        self._connect_wires()
        self.core.port.lost(code, reason, self.local)

    def suspend(self, seconds: float) -> None:
        """Suspends the client's program. Messages that arrive meanwhile wait until it continues."""
        self._away = True
        self.match.at(self.match.now + seconds, self._resume)

    def _resume(self) -> None:
        self._away = False
        self._read()
        self._update()

    # -- the server's `Link` ---

    def send(self, message: bytes) -> None:
        self.down.send(message)

    def outstanding(self) -> int:
        return self.down.outstanding()

    def close(self, code: int, reason: str) -> None:
        self.closed = (code, reason)
        assert self.session is not None
        self._way.lost(self.session, self.match.now)

    def _at_server(self, message: bytes) -> None:
        if self.session is not None:
            self._way.receive(self.session, message, self.match.now)

    def _at_client(self, message: bytes) -> None:
        self._inbox.append(message)
        if self._away or self.frame_s:
            return
        waiting = self.core.state == "joining"
        self._read()
        if waiting:
            self._update()

    def _read(self) -> None:
        core, now = self.core, self.local
        for message in self._inbox:
            core.port.receive(message, now)
        self._inbox.clear()
        self._flush()

    def _update(self) -> None:
        core = self.core
        if self._away:
            return
        if self.frame_s:
            self._read()
        if core.state == "playing" and (prediction := core.prediction) and prediction.predicted.tick != self._acted:
            self._acted = prediction.predicted.tick
            core.set_input(self.policy(core, self.rng))
        now = self.local
        core.port.update(now)
        if self.session is None and core.dials(now):
            core.reconnect.trying()
            self.connect()
            return
        self._flush()
        if self.frame_s:
            self.match.at(self.match.now + self.frame_s, self._update, key=self)
        elif core.state != "closed":
            due = core.port.next_update(now)
            if due < math.inf:
                when = self.match.now + max(due - now, 1e-4) / (1 + self.drift)
                self.match.at(when, self._update, key=self)

    def _flush(self) -> None:
        core = self.core
        for message in core.port.outgoing():
            self.up.send(message)
        self.events += core.events()
        if core.close_request and self.closed is None:
            self.close(*core.close_request)
        if core.travel.leaving:  # for another world, over a new connection
            self._cut(1000, "")
            self.match.at(self.match.now, self._update, key=self)


class Simulation:
    """The simulated time: a queue of calls, each at its time.

    Args:
        seed: source of everything random.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.now = 0.0
        self.players: list[Player] = []
        self._queue: list[tuple[float, int, Callable[[], None], object]] = []
        self._latest: dict[object, int] = {}
        self._number = count()

    def at(self, when: float, act: Callable[[], None], key: object = None) -> None:
        """Schedules a call for a time. An entry with a key replaces the earlier entry with that key."""
        number = next(self._number)
        if key is not None:
            self._latest[key] = number
        heappush(self._queue, (when, number, act, key))

    def run(self, seconds: float) -> None:
        """Runs for that many simulated seconds."""
        until = self.now + seconds
        self._advance(until)
        self.now = until

    def run_until(self, condition: Callable[[], bool], seconds: float) -> None:
        """Runs until a condition holds.

        Raises:
            AssertionError: it does not hold within that many simulated seconds.
        """
        if not self._advance(self.now + seconds, condition):
            raise AssertionError(f"seed {self.seed}: the condition did not hold within {seconds} simulated seconds")

    def _advance(self, until: float, condition: Callable[[], bool] | None = None) -> bool:
        """Runs all entries up to `until`, or until the condition holds. Returns whether it holds."""
        queue, latest = self._queue, self._latest
        while queue and queue[0][0] <= until:
            when, number, act, key = heappop(queue)
            if key is None or latest[key] == number:
                if when > self.now:
                    self.now = when
                act()
                if condition is not None and condition():
                    return True
        return False

    def route(self, path: str) -> Way | str:
        """Returns what a path leads to, or the reason why it leads nowhere."""
        raise NotImplementedError


class Match(Simulation):
    """A server, its players and the simulated time.

    Args:
        scene: the scene of the world.
        seed: source of everything random.
        limits: the server's limits; None: the defaults.
        rules: rules of the game, which may change the scene (`Rules.prepare`); None: players only walk and edit.
        worlds: the kinds of further worlds on the server. `game` is then the default world.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int,
        *,
        limits: Limits | None = None,
        rules: Rules | None = None,
        worlds: Sequence[Kind] = (),
    ) -> None:
        super().__init__(seed)
        self.game = Game(scene if rules is None else prepared(rules, scene), limits=limits, rules=rules, seed=seed)
        self.worlds = LocalWorlds(*worlds, default=self.game, limits=limits, seed=seed) if worlds else None
        """The worlds of the server; None: there is only the default one."""
        self._started = 0
        self._tick_s = 1.0 / scene.tick_rate
        self.on_tick: list[Callable[[], None]] = []
        self.at(0.0, self._tick)

    def join(self, policy: Policy, path: Link | None = None, core: Core | None = None, *, to: str = "/") -> Player:
        """Adds a player. Its client connects at once.

        Args:
            policy: called once per predicted tick; returns the input.
            path: properties of its link; None: no latency.
            core: its client; None: a new one.
            to: the path that the client connects to, like "/match?kind=arena".
        """
        seed = self.seed * 1_000_003 + len(self.players) * 7919
        if core is None:
            classes = [entry.code for entry in self.game.scene.behaviours if entry.code is not None]
            core = Core(
                f"player {len(self.players)}", behaviours=classes if self.worlds is None else self.worlds.behaviours
            )
        core.travel.path = to
        player = Player(self, core, path or Link(), policy, seed)
        self.players.append(player)
        self.at(self.now, player.connect)
        return player

    def route(self, path: str) -> Way | str:
        return self.game if self.worlds is None else self.worlds.route(path, self.now)

    def _tick(self) -> None:
        before = self.game.world.tick
        if self.worlds is None:
            self.game.tick(self.now, self.now)
            self._started += 1
            self.at(self._started * self._tick_s, self._tick)
        else:
            self.worlds.advance(self.now)
            self.at(self.worlds.due, self._tick)
        if self.game.world.tick != before:
            for act in self.on_tick:
                act()


def bot(policy: bots.Policy) -> Policy:
    """Turns a policy of `client_sdk.bots`, or one of that form, into a policy for a player of a match."""
    drive = bots.Bot(policy)

    def plays(core: Core, rng: random.Random) -> Input:
        drive(core)
        return core.input

    return plays


def wander(core: Core, rng: random.Random) -> Input:
    """A policy that walks, jumps and stops, and chooses anew about once a second."""
    if rng.random() < 0.04:
        angle = rng.choice(
            [(127, 0), (-127, 0), (0, 127), (0, -127), (90, 90), (-90, 90), (90, -90), (-90, -90), (0, 0)]
        )
        return Input(*angle, int(rng.random() < 0.5))
    return core.input
