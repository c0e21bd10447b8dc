"""The sequencer of a world on many processes: batches of the edges in, one record per tick out.

Theory of operation. A tick never waits for an edge. It takes the batches for this tick and earlier ones that have
arrived, in order. Nothing of a batch waits in the sequencer beyond the tick that takes it, so a batch that is in the
log is carried out completely, and one that is not is sent again by its edge after a takeover. If an edge's batch is
missing, the inputs of its players are repeated, and after `Bounds.repeats` ticks neutral; the record says which batches
it has. An edge without a batch for `SILENT_S` has lost its clients.
"""

import dataclasses

from server.config.limits import Limits
from server.game.commands import Commands
from server.game.connections import Connections
from server.game.sequencer import Sequencer
from server.game.session import Session
from server.game_api.api import GameApi
from server.game_api.input_api import held_input
from server.journal.recorded_world import Observer, RecordedWorld
from server.journal.records import recorded_inputs
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.persisted_state import PersistedState
from server.rewind import Rewind
from server.rules import Rules
from server.scale.remote import BatchInputs, RemoteJoining, RemoteLink, RemoteRoster
from server.scale.replica import Replica
from server.scale.wire import COMMAND, GONE, HERE, JOIN, KNOWS, LEAVE, LOST, SWITCH, Batch, Record, packed, rows
from shared import messages
from shared.bounds import MARGINS_PER_S, in_ticks
from shared.messages import Command, Hello
from shared.world_state import WorldState

SILENT_S = 1.0
"""Seconds without a batch after which the clients of an edge count as lost."""

GONE_S = 600.0
"""Seconds without a batch after which an edge is forgotten. It has to start anew under another name."""


def begin_record(replica: Replica) -> tuple[int, bytes]:
    """Returns the epoch that follows a replica's, and the record that begins it."""
    epoch = replica.epoch + 1
    batches = [part for pair in sorted(replica.batches.items()) for part in pair]
    return epoch, packed(Record(epoch, replica.world.tick, batches, None, [], [], [], [], [], []))


class _Pen(Observer):
    """Keeps the record of the latest tick."""

    def __init__(self) -> None:
        super().__init__(first=False)
        self.record: list[object] = []

    def tick(self, world: WorldState, inputs: object) -> None:
        self.record = self.taken(world, inputs)  # type: ignore[arg-type]


class WorldSequencer:
    """The sequencer of one world.

    Args:
        world: the world.
        rules: the rules; None: players only walk and edit.
        limits: the limits.
        seed: seed of the rules' random numbers.
        replica: the replica of `world` from which a standby takes over; None: a new world.
    """

    def __init__(
        self,
        world: RecordedWorld,
        rules: Rules | None = None,
        limits: Limits | None = None,
        *,
        seed: int = 0,
        replica: Replica | None = None,
    ) -> None:
        self.world, limits = world, limits or Limits()
        self.counters, self.faults = Counters(), FaultReporter()
        self.epoch = 1 if replica is None else replica.epoch + 1
        self._ended: list[object] = []
        self._waiting: dict[str, dict[int, Batch]] = {}
        """Batches by edge and by the number of the batch before. Each waits for that one: none may be left out."""
        self._came: dict[tuple[str, int], float] = {}
        """Times at which the waiting batches came, in seconds, by edge and number."""
        self._margins: dict[str, int] = {}
        """Margins of the batches that the tick takes, by edge (`Record.margins`)."""
        self._newest: dict[str, int] = {} if replica is None else dict(replica.batches)
        self._taken = dict.fromkeys(self._newest, world.tick)
        """Tick that took the newest batch of each edge."""
        self._edges: dict[str, str] = {} if replica is None else dict(replica.edges)
        """Addresses of the edges that take clients, by edge."""
        self._edges_changed = False
        self._sessions: dict[tuple[str, int], Session] = {}
        self._silent = in_ticks(SILENT_S, world.scene.tick_rate, 2)
        self._gone = in_ticks(GONE_S, world.scene.tick_rate, 2)
        self._pen = _Pen()
        world.attach(self._pen)
        rules = rules or Rules()
        kept: PersistedState | None = None if replica is None else replica.kept
        rewind = Rewind(world, limits.rewind_s)
        self.api = GameApi(world, rewind, self.counters, rules, kept=kept, seed=seed)
        self.roster = RemoteRoster(world, self.api, limits, self.counters)
        self.commands = Commands(world, self.api, limits, self.faults)
        self.connections = Connections(self.roster, self.counters, self.faults)
        each = dataclasses.replace(limits, joins_per_tick=limits.clients_max)  # the edges limit them
        self._joining = RemoteJoining(
            world, each, self.counters, self.faults, self.connections, self.roster, self.commands, None, Rules()
        )
        self._joining.seated = []
        self._half = Sequencer(world, self.api, rewind, self.roster, self._joining, self.commands, self.connections)
        if replica is not None:
            self._take_over(replica)

    def receive(self, batch: Batch, now: float) -> None:
        """Keeps a batch for its tick. One that is in the log already is dropped, and so is one that waits already."""
        waiting = self._waiting.setdefault(batch.edge, {})
        if batch.number > self._newest.get(batch.edge, -1) and batch.before not in waiting:
            waiting[batch.before] = batch
            self._came[batch.edge, batch.number] = now

    def tick(self, now: float) -> bytes:
        """Computes the next tick. Returns its record."""
        tick = self.world.tick + 1
        self._margins.clear()
        for edge in sorted(self._waiting):
            waiting = self._waiting[edge]
            while (batch := waiting.get(self._newest.get(edge, -1))) is not None and batch.number <= tick:
                self._take(waiting.pop(batch.before), now)
        self._judge(tick, now)
        outcome = self._half.advance(now)
        journal = self._pen.record
        events = [(None if to is None else sorted(to), message) for to, message in outcome.events]
        acted, removed = sorted(outcome.acted), list(outcome.removed)
        self._half.finish()
        ended, self._ended[:] = list(self._ended), []
        for edge, client, _, _ in rows(ended, 4):
            session = self._sessions.pop((edge, client), None)
            if session is not None:
                self.connections.lost(session, now)
        seated, self._joining.seated = self._joining.seated, []
        placed = sorted(self.world.placed)
        batches, edges = self._batches(), self._told_edges()
        margins = [self._margins.get(edge) for edge in sorted(self._newest)]
        return packed(
            Record(self.epoch, tick, batches, journal, placed, acted, removed, events, seated, ended, edges, margins)
        )

    # -- batches -------------------------------------------------------------------------------------------

    def _batches(self) -> list[object]:
        return [part for pair in sorted(self._newest.items()) for part in pair]

    def _told_edges(self) -> list[str] | None:
        """Returns the addresses of the edges for a record if they have changed."""
        if not self._edges_changed:
            return None
        self._edges_changed = False
        return [part for pair in sorted(self._edges.items()) for part in pair]

    def _address(self, edge: str, address: str) -> None:
        """Notes the address of an edge; empty: it takes no clients."""
        if address != self._edges.get(edge, ""):
            self._edges_changed = True
            self._edges.pop(edge, None)
            if address:
                self._edges[edge] = address

    def _take(self, batch: Batch, now: float) -> None:
        """Carries out the requests of a batch, and takes its inputs."""
        tick = self.world.tick + 1
        self._newest[batch.edge], self._taken[batch.edge] = batch.number, tick
        early_s = now - self._came.pop((batch.edge, batch.number)) - (tick - batch.number) / self.world.scene.tick_rate
        self._margins[batch.edge] = round(early_s * MARGINS_PER_S)
        for kind, client, *parts in batch.requests:
            key = (batch.edge, client)
            session = self._sessions.get(key)
            if kind == HERE:
                self._address(batch.edge, parts[0])
            elif kind == JOIN and session is None:
                name, subject, resume, token, beside, loaded = parts
                session = self._sessions[key] = self._open(batch.edge, client, token, now)
                session.subject, session.loaded = subject, loaded
                if beside:
                    self._joining.seat_beside(session, resume)
                else:
                    session.hello = Hello(messages.VERSION, {}, name, "", resume)
            elif session is None:
                continue
            elif kind == SWITCH:
                self._switch(session)
            elif kind == KNOWS:
                session.stream.acked = max(session.stream.acked, 0)
            elif kind in (LOST, LEAVE):
                if kind == LEAVE:
                    self.roster.dismiss(session)
                self.connections.lost(session, now)
                self._ended += (*key, GONE, "")
                del self._sessions[key]
            elif kind == COMMAND and session.player is not None and session.player.session is session:
                number, tick, seen, name, payload, gaps = parts
                session.stream.gaps = tuple((first, last) for first, last in gaps)
                self.commands.file(session.player, Command(number, min(tick, batch.number), seen, name, payload))
        for entity, input_ in recorded_inputs(batch.inputs, aim=self.world.scene.aim).items():
            player = self.api.players.get(entity)
            home = None if player is None or player.session is None else player.session.link
            if player is not None and isinstance(home, RemoteLink) and home.edge == batch.edge:
                assert isinstance(player.inputs, BatchInputs)
                player.inputs.latest = input_

    def _judge(self, tick: int, now: float) -> None:
        """Notes for how many ticks the batch of each edge is missing, and gives up silent edges."""
        missing = {edge: max(tick - number, 0) for edge, number in self._newest.items()}
        for player in self.api.players.values():
            inputs, session = player.counts, player.session
            if isinstance(inputs, BatchInputs):
                if session is None:
                    inputs.missing += 1
                elif isinstance(link := session.link, RemoteLink):
                    inputs.missing = missing.get(link.edge, 0)
        for edge in [edge for edge, taken in self._taken.items() if tick - taken > self._gone]:
            del self._newest[edge], self._taken[edge]
            self._waiting.pop(edge, None)
            self._came = {key: came for key, came in self._came.items() if key[0] != edge}
        silent = {edge for edge, taken in self._taken.items() if tick - taken > self._silent}
        if silent:
            for edge in silent:
                self._address(edge, "")
            for key in [key for key in self._sessions if key[0] in silent]:
                session = self._sessions.pop(key)
                session.close(messages.TOO_SLOW, "the edge was silent")
                self.connections.lost(session, now)

    def _switch(self, session: Session) -> None:
        """Makes the second connection of a client the one that counts, and ends the first."""
        player = session.player
        assert isinstance(session.link, RemoteLink)
        if player is None or player.entity not in self.api.players or player.session is session:
            return
        if player.session is not None:
            self.connections.end(player.session, messages.TAKEN_OVER, "the player goes on over another connection")
        session.seat(player)
        self._joining.seated += (session.link.edge, session.link.client, player.entity, False)

    # -- sessions ------------------------------------------------------------------------------------------

    def _open(self, edge: str, client: int, token: bytes, now: float) -> Session:
        return self.connections.open(RemoteLink(edge, client, token, self._ended), now)

    def _take_over(self, replica: Replica) -> None:
        """Seats the players of a replica at their edges, as the log says."""
        self.roster.fell_out()
        for entity, (edge, client) in replica.homes.items():
            player = self.api.players.get(entity)
            if player is not None and edge in self._newest:
                session = self._sessions[edge, client] = self._open(edge, client, b"", 0.0)
                session.subject = player.subject
                session.seat(player)
                assert isinstance(player.inputs, BatchInputs)
                player.inputs.latest = held_input(self.world, entity)
        for (edge, client), entity in replica.beside.items():
            if entity in self.api.players and edge in self._newest:
                session = self._sessions[edge, client] = self._open(edge, client, b"", 0.0)
                session.player = self.api.players[entity]
                session.subject = session.player.subject
