"""A match on many processes in simulated time: a sequencer, edges and standbys, joined by a simulated bus.

    match = ScaledMatch(scene, seed=1, edges=4, standbys=1)
    player = match.join(wander)
    match.run(10)

The bus is in order per pair of parts. Messages are late by chance, stop for a while, and come twice. The log can fail.
Any part can be killed at any time. One seed reproduces a run.
"""

import random
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, cast

from client_sdk.core import Core
from client_sdk.netsim.links import Link, TcpStream
from client_sdk.port import Port
from server.config.limits import Limits
from server.game.session import Session
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.rules import Rules, prepared
from server.scale.edge import EdgeServer
from server.scale.replica import Replica
from server.scale.sequencer import WorldSequencer, begin_record
from server.scale.wire import batch_of, record_of
from server.scale.writer import EMPTY, Entry, id_of
from server.worlds.host import Way
from shared.scene import Scene
from sovereign_netcode.playtest.log import Log
from sovereign_netcode.playtest.match import Player, Policy, Simulation
from sovereign_netcode.playtest.parts import Bus, EdgePart, Part, SequencerPart, StandbyPart


class _Dead:
    """The server of a killed edge: it does nothing."""

    def lost(self, session: Session, now: float) -> None:
        pass


class Seat(Player):
    """A client of a scaled match, connected to one edge. The path of its connection is the name of an edge."""

    match: "ScaledMatch"
    second: "_Second | None" = None
    """The second connection, while the client changes to another edge."""

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

    @property
    def place(self) -> str:
        """The address of the edge to connect to; a path stands for any edge."""
        return self.core.travel.server or self.core.travel.path

    def move(self, edge: EdgePart) -> bool:
        """Lets the edge of the client ask it to go on at another edge. Returns whether it has."""
        here = self.edge
        return here is not None and here.core.moves.ask(self.session, edge.address, "a move", self.match.now)

    def _update(self) -> None:
        if self.session is not None and self.session.closed and self.core.state == "reconnecting":
            self._cut(1006, "closed by the server")
        super()._update()

    def _flush(self) -> None:
        super()._flush()
        core = self.core
        if self.second is None and core.second is not None and core.handover is not None:
            edge = self.match.at_address(core.handover.address)
            if edge is None:
                core.second.lost(1006, "no server there", self.local)
            else:
                self.second = _Second(self, edge, core.second)
        if self.second is not None:
            self.second.flush()

    def take_place(self, second: "_Second") -> None:
        """Makes the second connection the only one."""
        if self.session is not None:
            self._way.lost(self.session, self.match.now)
        self.up.cut()
        self.down.cut()
        self.up, self.down, self._way, self.session = second.up, second.down, second.edge.core, second.session
        self.closed, self.second = None, None


class _Second:
    """The second connection of a client, to another edge; also the `Link` of that edge."""

    def __init__(self, seat: Seat, edge: EdgePart, port: Port) -> None:
        self._seat, self.edge, self._port = seat, edge, port
        self._handover = seat.core.handover
        self.up = TcpStream(seat.match, seat.link_events, seat.match.rng.getrandbits(30), self._at_server)
        self.down = TcpStream(seat.match, seat.link_events, seat.match.rng.getrandbits(30), self._at_client)
        self.session: Session = edge.core.open(self, seat.match.now)
        port.open(seat.local)

    def send(self, message: bytes) -> None:
        self.down.send(message)

    def outstanding(self) -> int:
        return self.down.outstanding()

    def close(self, code: int, reason: str) -> None:
        if self._seat.session is self.session:
            self._seat.close(code, reason)
        else:
            self.edge.core.lost(self.session, self._seat.match.now)

    def broke(self) -> None:
        """Breaks the connection, because its edge was killed."""
        self._port.lost(1006, "gone", self._seat.local)

    def flush(self) -> None:
        """Sends what the client has for the second connection, makes it the first, or ends it."""
        seat, handover = self._seat, self._handover
        if seat.core.second is not self._port:
            seat.second = None
            if handover is not None and handover.complete:
                seat.take_place(self)
                seat._flush()
            elif self.edge.alive:
                self.edge.core.lost(self.session, seat.match.now)
            return
        for message in self._port.outgoing():
            self.up.send(message)

    def _at_server(self, message: bytes) -> None:
        if self.edge.alive:
            self.edge.core.receive(self.session, message, self._seat.match.now)

    def _at_client(self, message: bytes) -> None:
        seat = self._seat
        if seat.session is self.session:
            seat._at_client(message)
        elif seat.second is self:
            self._port.receive(message, seat.local)
            self.flush()


class ScaledMatch(Simulation):
    """A world on many processes, its players and the simulated time.

    Args:
        scene: the scene of the world.
        seed: source of everything random.
        edges, standbys: numbers of these parts.
        limits: the limits.
        rules: makes the rules of the game, once per sequencer; None: players only walk and edit.
        bus: properties of the bus, as for `Bus`.
        fails: how often and how long the log fails, as for `Log`; None: never.
        hash_every: all parts compare hashes of their worlds at every tick that this divides. The marks of the records
            compare what has changed at every tick.
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
        fails: tuple[float, float] | None = None,
        hash_every: int = 4,
    ) -> None:
        super().__init__(seed)
        self.hash_every = hash_every
        self.rng = random.Random(seed + 29)
        self._limits, self._rules = limits, rules
        made = None if rules is None else rules()
        self.scene = scene if made is None else prepared(made, scene)
        self.rate = self.scene.tick_rate
        self.bus = Bus(self, seed + 17, **bus)
        self.log = Log(self, seed + 41, fails)
        self.log.on_stored = self._stored
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
        name, (epoch, data) = self._name("sequencer"), begin_record(first)
        begin = Entry(id_of(epoch, 0, name), EMPTY, data)
        self.sequencer = SequencerPart(self, name, core, begin)
        self._sequencers = [self.sequencer]
        self.log.store(begin)

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
        if path.startswith("ws://"):
            edge = self.at_address(path)
            return "no server there" if edge is None else edge.core
        return self.some_edge().core

    def at_address(self, address: str) -> EdgePart | None:
        """Returns the living edge at an address; None: there is none."""
        return next((edge for edge in self.edges if edge.alive and edge.address == address), None)

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

    def kill(self, part: Part, *, lossy: bool = False) -> None:
        """Kills a part. The connections of an edge's clients break.

        Args:
            part: the part.
            lossy: whether messages of the part that are on their way are lost: batches, and records that the log does
                not have yet.
        """
        part.alive = False
        if lossy:
            self.bus.cut(part.name)
        for player in self.players:
            if isinstance(player, Seat) and player.second is not None and player.second.edge is part:
                second, player.second = player.second, None
                second.broke()
            if isinstance(player, Seat) and player.edge is part:
                player.cut()

    # -- called by the parts ----------------------------------------------------------------------------------

    def deliver(self, data: bytes) -> None:
        """Delivers a batch to all sequencers."""
        self._sequencers = [each for each in self._sequencers if each.alive]
        for sequencer in self._sequencers:
            sequencer.core.receive(batch_of(data), self.now)

    def take_over(self, standby: StandbyPart, begin: Entry) -> None:
        """Makes a standby the sequencer, whose record that begins an epoch was stored."""
        replica = standby.replica
        rules = None if self._rules is None else self._rules()
        if rules is not None:
            prepared(rules, self.scene)
        core = WorldSequencer(replica.world, rules, self._limits, seed=self.seed, replica=replica)
        self.sequencer = SequencerPart(self, standby.name, core, begin)
        self._sequencers.append(self.sequencer)

    def _stored(self, entry: Entry) -> None:
        """Delivers a record that the log has stored to all edges and standbys."""
        seq = len(self.log.records)
        for part in (*self.edges, *self.standbys):
            if part.alive:
                self.bus.send("log", part.name, partial(part.receive, seq, entry.data), sure=False)
        for sequencer in self._sequencers:
            hashed = sequencer.hashes.pop(entry.id, None)
            if hashed is not None:
                self.seen(sequencer.name, record_of(entry.data).tick, hashed)

    def seen(self, name: str, tick: int, hashed: bytes) -> None:
        """Compares the hash of a part's world with those of the others at the same tick."""
        if self.hashes.setdefault(tick, hashed) != hashed:
            self.differ.append((tick, name))

    def _edge(self, replica: Replica) -> EdgePart:
        return EdgePart(self, self._name("edge"), replica.copy(), self._limits)

    def _name(self, kind: str) -> str:
        self._number_of_parts += 1
        return f"{kind} {self._number_of_parts}"
