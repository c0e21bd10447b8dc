"""A match on many processes in simulated time: a sequencer, edges and standbys, joined by a simulated bus.

    match = ScaledMatch(scene, seed=1, edges=4, standbys=1)
    player = match.join(wander)
    match.run(10)

The bus is in order per pair of parts. Messages are late by chance, stop for a while, and come twice. Any part can be
killed at any time. One seed reproduces a run.
"""

import random
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, cast

from client_sdk.core import Core
from client_sdk.netsim.links import Link
from server.config.limits import Limits
from server.game.session import Session
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.rules import Rules, prepared
from server.scale.edge import EdgeServer
from server.scale.replica import GapError, Replica
from server.scale.sequencer import WorldSequencer
from server.scale.wire import Batch, Record, batch_of, packed, record_of
from server.worlds.host import Way
from shared.scene import Scene
from sovereign_netcode.playtest.match import Player, Policy, Simulation

SILENCE_S = 0.25
"""Seconds without a record after which a standby takes over."""
LEAD_S = 0.008
"""Seconds that an edge's deadline is ahead of the sequencer's at first."""
LEAD_MORE, LEAD_LESS_S, LEAD_S_MAX = 1.5, 0.000002, 0.1
"""Factor of the lead after a late batch; seconds that it falls per tick; its greatest value in seconds."""


class Bus:
    """A simulated bus with one log.

    Args:
        match: has the simulated time.
        seed: source of everything random.
        delay_s: least time of a message, in seconds.
        jitter_s: largest additional time, in seconds.
        stop: about every `stop[0]` seconds, the messages of one pair of parts wait for up to `stop[1]` seconds.
        twice: share of the messages that come twice.
    """

    def __init__(
        self,
        match: "ScaledMatch",
        seed: int,
        *,
        delay_s: float = 0.001,
        jitter_s: float = 0.001,
        stop: tuple[float, float] | None = None,
        twice: float = 0.0,
    ) -> None:
        self._match, self._rng = match, random.Random(seed)
        self._delay_s, self._jitter_s, self._stop, self._twice = delay_s, jitter_s, stop, twice
        self._free: dict[tuple[str, str], float] = {}
        self.log: list[bytes] = []
        """All records that the log has accepted."""
        self.refused = 0
        """Records that the log has refused, because their writer is deposed."""
        self._last = (0, -1)

    def send(self, source: str, target: str, deliver: Callable[[], None]) -> None:
        """Delivers a message from one part to another, after the messages before it."""
        rng, now = self._rng, self._match.now
        due = now + self._delay_s + rng.random() * self._jitter_s
        if self._stop is not None and rng.random() < 1 / (self._stop[0] * self._match.rate):
            due += rng.random() * self._stop[1]
        for _ in range(2 if rng.random() < self._twice else 1):
            due = max(due, self._free.get((source, target), 0.0))
            self._free[source, target] = due
            self._match.at(due, deliver)

    def hold(self, source: str, target: str, seconds: float) -> None:
        """Makes all messages from one part to another wait for some time from now on."""
        self._free[source, target] = self._match.now + seconds

    def append(self, data: bytes, last: tuple[int, int]) -> bool:
        """Appends a record if `last`, its writer's newest record, is the newest of the log. Returns whether it was."""
        if last != self._last:
            self.refused += 1
            return False
        record = record_of(data)
        self._last = (record.epoch, record.tick)
        self.log.append(data)
        self._match.publish(data)
        return True


class Part:
    """A process of the match: it can be killed."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True


class SequencerPart(Part):
    """The sequencer in one process."""

    def __init__(self, match: "ScaledMatch", name: str, core: WorldSequencer, last: tuple[int, int]) -> None:
        super().__init__(name)
        self._match, self.core, self._last = match, core, last
        self._began, self._ticks = match.now, 0
        self._append(core.begin(), None)
        self._schedule()

    def _schedule(self) -> None:
        self._ticks += 1
        self._match.at(self._began + self._ticks / self._match.rate, self._tick)

    def _tick(self) -> None:
        if not self.alive:
            return
        data, world = self.core.tick(self._match.now), self.core.world
        hashed = world.state_hash()
        self._match.bus.send(self.name, "log", lambda: self._append(data, hashed))
        self._schedule()

    def _append(self, data: bytes, hashed: bytes | None) -> None:
        """Is called when a record arrives at the log, also after its writer was killed."""
        record = record_of(data)
        if (record.epoch, record.tick) <= self._last:
            return  # it came twice
        if self._match.bus.append(data, self._last):
            self._last = (record.epoch, record.tick)
            if hashed is not None:
                self._match.seen(self.name, record.tick, hashed)
        else:
            self.alive = False  # another one has taken over


class Reader(Part):
    """A process with a replica: an edge or a standby."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica) -> None:
        super().__init__(name)
        self.match, self.replica = match, replica
        self.heard_at = match.now
        self.hashes: dict[int, bytes] = {}

    def receive(self, data: bytes) -> None:
        """Takes a record, and fetches the ones before it from the log if they are missing."""
        if not self.alive:
            return
        self.heard_at = self.match.now
        try:
            self.follow(record_of(data))
        except GapError:
            for each in self.match.bus.log:
                self.follow(record_of(each))

    def follow(self, record: Record) -> None:
        """Takes a record."""
        before = self.replica.world.tick
        self.take(record)
        if self.replica.world.tick > before:
            self.match.seen(self.name, self.replica.world.tick, self.replica.world.state_hash())

    def take(self, record: Record) -> None:
        """Passes a record to the core."""
        self.replica.take(record)
        self.replica.settle()


class StandbyPart(Reader):
    """A replica without clients, which takes over if the log falls silent."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica, rank: int) -> None:
        super().__init__(match, name, replica)
        self._silence_s = SILENCE_S * (1 + rank)
        self._watch()

    def _watch(self) -> None:
        if not self.alive:
            return
        if self.match.now - self.heard_at > self._silence_s:
            for each in self.match.bus.log:  # the log's end may be newer than what was delivered
                self.follow(record_of(each))
            self.alive = False
            self.match.take_over(self)
            return
        self.match.at(self.match.now + 1 / self.match.rate, self._watch)


class EdgePart(Reader):
    """An edge, with its clock: it follows the arrival of records."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica, limits: Limits | None) -> None:
        super().__init__(match, name, replica)
        self.core = EdgeServer(name, replica, limits)
        self.lead_s = LEAD_S
        self.late = 0
        """Records that lacked the batch of their tick."""
        self._phase = -1e9

    def take(self, record: Record) -> None:
        again = self.core.follow(record, self.match.now)
        if again:
            for batch in self.core.unrecorded():
                self._send(batch)
            self._phase = -1e9
        if record.journal is None:
            return
        tick, now, rate = record.tick, self.match.now, self.match.rate
        self._phase = max(self._phase - 1e-5, tick - now * rate)
        missing = tick - self.replica.batches.get(self.name, tick)
        self.late += missing > 0
        self.lead_s = min(max(self.lead_s - LEAD_LESS_S, LEAD_S / 4) * (LEAD_MORE if missing else 1), LEAD_S_MAX)
        self._schedule()

    def due(self) -> float:
        """Returns the time of the deadline of the next tick at this edge."""
        return (self.core.newest + 1 - self._phase) / self.match.rate - self.lead_s

    def _schedule(self) -> None:
        self.match.at(max(self.due(), self.match.now + 1e-4), self._collect, key=self)

    def _collect(self) -> None:
        if not self.alive:
            return
        due = self.due()
        if due <= self.match.now + 1e-9:
            batch = self.core.collect(due, self.match.now)
            if batch is None:  # the log is silent
                self.match.at(self.match.now + 1 / self.match.rate, self._collect, key=self)
                return
            self._send(batch)
        self._schedule()

    def _send(self, batch: Batch) -> None:
        data = packed(batch)
        self.match.bus.send(self.name, "sequencer", lambda: self.match.deliver(data))


class _Dead:
    """The server of a killed edge: it does nothing."""

    def lost(self, session: Session, now: float) -> None:
        pass


class Seat(Player):
    """A client of a scaled match, connected to one edge. The path of its connection is the name of an edge."""

    match: "ScaledMatch"

    @property
    def edge(self) -> EdgePart | None:
        """The edge that the client is connected to; None: it is not connected."""
        if self.session is None:
            return None
        return next((edge for edge in self.match.edges if edge.core is self._way), None)

    def cut(self) -> None:
        """Breaks the connection, because its edge was killed."""
        if self.session is not None:
            self._way = cast("EdgeServer", _Dead())
            self.disconnect()


class ScaledMatch(Simulation):
    """A world on many processes, its players and the simulated time.

    Args:
        scene: the scene of the world.
        seed: source of everything random.
        edges, standbys: numbers of these parts.
        limits: the limits.
        rules: makes the rules of the game, once per sequencer; None: players only walk and edit.
        bus: properties of the bus, as for `Bus`.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int,
        *,
        edges: int = 2,
        standbys: int = 1,
        limits: Limits | None = None,
        rules: Callable[[], Rules] | None = None,
        bus: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__(seed)
        self.rng = random.Random(seed + 29)
        self._limits, self._rules = limits, rules
        made = None if rules is None else rules()
        self.scene = scene if made is None else prepared(made, scene)
        self.rate = self.scene.tick_rate
        self.bus = Bus(self, seed + 17, **bus)
        self.hashes: dict[int, bytes] = {}
        """Hash of the world at each tick, as the first part that reached it had it."""
        self.differ: list[tuple[int, str]] = []
        """Ticks and parts whose hash was another one."""
        world = RecordedWorld(self.scene)
        world.load_terrain()
        first = Replica(world, PersistedState())
        self._number_of_parts = 0
        self.edges = [self._edge(first) for _ in range(edges)]
        self.standbys = [StandbyPart(self, self._name("standby"), first.copy(), i) for i in range(standbys)]
        core = WorldSequencer(world, made, limits, seed=seed)
        self.sequencer = SequencerPart(self, self._name("sequencer"), core, (0, -1))

    def join(self, policy: Policy, path: Link | None = None, core: Core | None = None) -> Seat:
        """Adds a player, as `Match.join`. Its client connects to an edge by chance."""
        seed = self.seed * 1_000_003 + len(self.players) * 7919
        if core is None:
            classes = [entry.code for entry in self.scene.behaviours if entry.code is not None]
            core = Core(f"player {len(self.players)}", behaviours=classes, patience_s=60.0)
        player = Seat(self, core, path or Link(), policy, seed)
        self.players.append(player)
        self.at(self.now, player.connect)
        return player

    def route(self, path: str) -> Way | str:
        named = [edge for edge in self.edges if edge.alive and edge.name == path]
        return (named[0] if named else self.some_edge()).core

    def some_edge(self) -> EdgePart:
        """Returns a living edge by chance."""
        return self.rng.choice([edge for edge in self.edges if edge.alive])

    def add_edge(self) -> EdgePart:
        """Starts a new edge from a copy of a replica. It gets the rest from the log."""
        source = next(part for part in [*self.standbys, *self.edges] if part.alive)
        edge = self._edge(source.replica)
        self.edges.append(edge)
        return edge

    def add_standby(self) -> StandbyPart:
        """Starts a new standby from a copy of a replica."""
        source = next(part for part in [*self.standbys, *self.edges] if part.alive)
        standby = StandbyPart(self, self._name("standby"), source.replica.copy(), 0)
        self.standbys.append(standby)
        return standby

    def kill(self, part: Part) -> None:
        """Kills a part. What it has sent still arrives; the connections of an edge's clients break."""
        part.alive = False
        for player in self.players:
            if isinstance(player, Seat) and player.edge is part:
                player.cut()

    # -- called by the parts ----------------------------------------------------------------------------------

    def publish(self, data: bytes) -> None:
        """Delivers a record of the log to all edges and standbys."""
        for part in (*self.edges, *self.standbys):
            if part.alive:
                self.bus.send("log", part.name, partial(part.receive, data))

    def deliver(self, data: bytes) -> None:
        """Delivers a batch to the present sequencer."""
        if self.sequencer.alive:
            self.sequencer.core.receive(batch_of(data))

    def take_over(self, standby: StandbyPart) -> None:
        """Makes a standby the sequencer."""
        replica = standby.replica
        rules = None if self._rules is None else self._rules()
        if rules is not None:
            prepared(rules, self.scene)
        core = WorldSequencer(replica.world, rules, self._limits, seed=self.seed, replica=replica)
        self.sequencer = SequencerPart(self, standby.name, core, (replica.epoch, replica.world.tick))

    def seen(self, name: str, tick: int, hashed: bytes) -> None:
        """Compares the hash of a part's world with those of the others at the same tick."""
        if self.hashes.setdefault(tick, hashed) != hashed:
            self.differ.append((tick, name))

    def _edge(self, replica: Replica) -> EdgePart:
        return EdgePart(self, self._name("edge"), replica.copy(), self._limits)

    def _name(self, kind: str) -> str:
        self._number_of_parts += 1
        return f"{kind} {self._number_of_parts}"
