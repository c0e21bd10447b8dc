"""An edge of a world on many processes: the connections of some clients, on a replica of the world.

Theory of operation. `collect` is called at the edge's own deadline of a tick, a little ahead of the sequencer's: it
takes one input per player, and makes the batch for the sequencer. `follow` is called with each record of the log: it
advances the replica, and sends the clients what is due. What became of the inputs of a tick is decided by its record:
if the edge's batch was not in it, they count as late. Batches that are in no record yet are sent again when an epoch
begins. A batch has the inputs that changed. A sequencer that begins knows the others from the world, where they may be
neutral ones; so the edge states all inputs then, and compares until a record has that batch. Clients steer by the
edge's time: `collect` is the deadline that their arrival margins refer to.
"""

import secrets
from collections import deque
from collections.abc import Callable
from typing import Any, cast

import msgpack

from server.config.limits import Limits
from server.game.clocks import Clocks
from server.game.commands import Commands
from server.game.connections import Connections
from server.game.edge import Edge
from server.game.fast_path import FastPath
from server.game.front import Front
from server.game.joining import Joining, join_welcome
from server.game.roster import Roster, digest_of
from server.game.session import Session
from server.game_api.input_api import held_input
from server.game_api.shared_values import SharedValues
from server.journal.records import input_record, recorded_inputs
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.persisted_state import PersistedState
from server.rules import Rules
from server.scale.clients import EdgeCommands, EdgeInputs, EdgeRoster
from server.scale.moves import Moves
from server.scale.replica import Replica
from server.scale.wire import COMMAND, GONE, HERE, JOIN, KNOWS, SWITCH, Batch, Record, rows
from shared import fields, messages
from shared.bounds import bounds, in_ticks
from shared.inputs import Input
from shared.messages import Hello, pack

RESEND_TICKS, RESENT_MAX = 8, 64
"""Ticks without a batch in the records after which the unrecorded batches are sent again: one of them was lost on the
way. Maximum number of batches that are sent again at once."""
STILL_S = 30.0
"""Seconds for which time may stand still, while clients go on, before commands are refused as too far ahead."""
AHEAD_MAX = 8
"""Maximum number of batches that are in no record yet. An edge that hears nothing of the sequencer stops there."""
IN_TIME_S = 0.5
"""Time for which all inputs of a client have to be in time over its second connection before it changes to that, in
seconds."""


class EdgeServer(Front):
    """An edge of one world.

    Args:
        name: name of the edge, which no other edge of the world has had.
        replica: the replica of the world at some tick of the log.
        limits: the limits.
        address: address of the edge for clients, as in ws://HOST:PORT, which the other edges tell theirs; empty: none.
        authenticate: returns the subject of a client's token, as for `Game`.
        rules: the rules, whose `load_player` is run here; its results have to be what MessagePack can hold.
    """

    commands: EdgeCommands
    joining: Joining
    takes_second = True

    def __init__(
        self,
        name: str,
        replica: Replica,
        limits: Limits | None = None,
        *,
        address: str = "",
        authenticate: Callable[[str], str] | None = None,
        rules: Rules | None = None,
    ) -> None:
        world = replica.world
        self.name, self.replica, self.world, self.scene = name, replica, world, world.scene
        self.limits, self.counters, self.faults = limits or Limits(), Counters(), FaultReporter()
        self._row_bytes, self._bounds = self.scene.input_row_bytes, bounds(self.scene.tick_rate)
        self._roster = EdgeRoster(replica.kept.players)
        self.commands = EdgeCommands(self.limits, self._bounds.ahead + in_ticks(STILL_S, self.scene.tick_rate, 1))
        self._half = Edge(world, replica.kept, self.limits, self.counters, lambda: world.tick, apart=True)
        self.log, self.sender = self._half.log, self._half.sender
        self.log.faults = self.faults
        roster = cast("Roster", self._roster)
        self.connections = Connections(roster, self.counters, self.faults)
        self.clocks = Clocks(self.scene.tick_rate, self.limits, self.connections, roster)
        self.moves = Moves(name, address, replica, self.connections)
        self.joining = Joining(
            world,
            self.limits,
            self.counters,
            self.faults,
            self.connections,
            roster,
            _Durable(world),
            authenticate,
            rules or Rules(),
        )
        if world.compiled:
            self.fast_path = FastPath(
                world,
                self.log,
                self.limits,
                self.counters,
                self.clocks,
                replica.kept.players,
                self.connections,
                self.receive,
                world.kernel,
                lambda: self.newest,
                AHEAD_MAX,
            )
        self._values = SharedValues(world, replica.kept.shared)
        self.commands.newest = world.tick
        self._unrecorded: deque[Batch] = deque()
        self._resent = 0
        self._stated = -1
        """Number of the batch that states all inputs; the sequencer may use others before."""
        self._in_time = in_ticks(IN_TIME_S, self.scene.tick_rate, 8)
        self._next, self._before = 0, -1
        self._tokens: dict[int, bytes] = {}
        self._mine = self._roster.mine
        self._known: set[Session] = set()
        self._scene_table = pack(self.scene.to_table())

    @property
    def newest(self) -> int:
        return self.commands.newest

    @property
    def kept(self) -> PersistedState:
        """The persisted state, with all players of the world, also those of other edges."""
        return self.replica.kept

    def hello(self, session: Session, hello: Hello, now: float) -> None:
        """Takes the first message of a client: it wants to join, or to go on here. An edge that drains refuses it."""
        if self.moves.draining:
            self.moves.refuse(session)
        else:
            self.joining.hello(session, hello, now)

    def drain(self) -> None:
        """Begins to send all clients to other edges, because this one is about to stop."""
        self.moves.draining = True

    @property
    def drained(self) -> bool:
        """Whether no client plays over this edge."""
        return not any(session.entity and not session.closed for session in self.sessions)

    # -- to the sequencer ----------------------------------------------------------------------------------

    def collect(self, deadline: float, now: float) -> Batch | None:
        """Takes the inputs and requests for the next tick. Returns the batch; None: the log is too far behind."""
        if self.newest >= self.world.tick + AHEAD_MAX:
            return None
        if self.fast_path is not None:
            self.fast_path.arrivals.flush()
        self.clocks.begin(deadline, now)
        self.commands.newest = tick = self.newest + 1
        changed = {} if self.fast_path is None else self.fast_path.take(tick, everyone=False)
        self._ask_to_join(now)
        inputs: list[int] = []
        requests = self._roster.requests
        address = self.moves.request
        if address is not None:
            requests.append([HERE, 0, address])
        for session, client in self._roster.clients.items():
            player = session.player
            if player is None or session.closed:
                continue
            beside, input_ = False, changed.get(player.entity)
            if session.row < 0:
                beside, input_ = self._take(session, client, tick)
            if input_ is not None:
                inputs += input_record(player.entity, input_, aim=self.scene.aim)
            if session not in self._known and session.acknowledged:
                self._known.add(session)
                requests.append([KNOWS, client])
            while beside and player.commands and player.commands[0].number in player.settled:
                player.commands.popleft()  # the other edge has sent it
            while not beside and player.commands and player.commands[0].tick <= tick:
                requests.append([COMMAND, client, *player.commands.popleft(), session.stream.gaps])
        batch = Batch(self.name, tick, self._before, inputs, list(requests))
        self._before = tick
        requests.clear()
        self._unrecorded.append(batch)
        return batch

    def _take(self, session: Session, client: int, tick: int) -> tuple[bool, Input | None]:
        """Takes the input of a client that is not on the fast path for a tick.

        Returns:
            Whether another edge has its inputs; its input, if it is not the one that was sent last.
        """
        queue = session.inputs
        assert isinstance(queue, EdgeInputs)
        input_ = queue.take(tick)
        if session.beside and not queue.switching and queue.in_time >= self._in_time:
            queue.switching = True
            self._roster.requests.append([SWITCH, client])
        if session.beside and not queue.switching:
            return True, None
        if input_ == queue.sent:
            return False, None
        queue.sent = input_
        return False, input_

    def unrecorded(self) -> list[Batch]:
        """Returns the oldest batches that are in no record yet, to be sent again."""
        return list(self._unrecorded)[:RESENT_MAX]

    def _ask_to_join(self, now: float) -> None:
        """Adds the requests of clients that wait to join."""
        joining = [each for each in self.sessions if each.hello is not None and not each.closed]
        for session in joining[: self.limits.joins_per_tick]:
            if not self._can_send(session):
                continue
            hello, session.hello, session.loading = session.hello, None, True
            assert hello is not None
            session.received_at = session.stream.sent_at = now
            self._next += 1
            client = self._roster.clients[session] = self._next
            token = hello.resume if session.beside else secrets.token_bytes(fields.RESUME_BYTES)
            self._tokens[client] = token
            resume = digest_of(hello.resume) if hello.resume else b""
            known = [hello.name, session.subject, resume, digest_of(token), session.beside]
            self._roster.requests.append([JOIN, client, *known, session.loaded])

    def _can_send(self, session: Session) -> bool:
        """Returns whether the loaded data of a client can be in a batch. If not, the client is closed."""
        try:
            msgpack.packb(session.loaded)
            return True
        except Exception:
            self.connections.fail(session, "sending the result of load_player to the sequencer")
            return False

    # -- from the log --------------------------------------------------------------------------------------

    def follow(self, record: Record, now: float) -> bool:
        """Takes a record of the log. Returns whether `unrecorded` has to be sent again.

        That is so if the record begins an epoch, or if a batch was lost on its way.

        Raises:
            GapError: a record before it is missing.
            DivergedError: the replica differs from the sequencer's world.
        """
        replica = self.replica
        known = set(self.players) if record.seated else set()
        given = self._given(record)
        fast_path = self.fast_path
        if fast_path is not None:
            fast_path.arrivals.flush()
            if given or record.journal is None or dict(rows(record.batches, 2)).get(self.name) != record.tick:
                fast_path.recall_all()  # some of its inputs were not used
        if not replica.take(record):
            return False
        if record.journal is None:
            self._state_all()
            return True
        if fast_path is not None:
            fast_path.confirm(record.tick)
        newest = replica.batches.get(self.name, -1)
        if not self._bounds.stands_in(record.tick - newest):
            self._state_all()
        while self._unrecorded and self._unrecorded[0].number <= newest:
            self._unrecorded.popleft()
        seated = rows(record.seated, 4)
        switched = {client for edge, client, _, beside in seated if edge == self.name and not beside}
        for session in self._roster.clients:
            inputs = session.inputs if session.row < 0 else None
            if isinstance(inputs, EdgeInputs) and session.player is not None:
                session.beside = session.beside and self._roster.clients[session] not in switched
                if session.beside:
                    inputs.skip(record.tick)
                else:
                    inputs.confirm(record.tick, record.tick - newest, given.get(session.player.entity))
        self.commands.newest = max(self.commands.newest, self.world.tick)
        self._seat(record, known, now)
        self._half.follow(replica.outcome)
        replica.outcome.clear()
        if replica.shared_changed:
            replica.shared_changed = False
            self._values.renew()
        self.clocks.refill()
        self._send(self._values, now)
        for edge, client, code, reason in rows(record.ended, 4):
            if edge == self.name and code != GONE:
                self._end(client, code, reason)
        self._forget_others()
        self.moves.tell(self.sessions)
        self.moves.check(now, 1 / self.scene.tick_rate)
        self.clocks.check(now)
        return self._is_lost(record.tick)

    def _state_all(self) -> None:
        """Lets the next batch state the inputs of all clients."""
        self._stated = self.newest + 1
        for session in self._roster.clients:
            if isinstance(session.inputs, EdgeInputs):
                session.inputs.sent = None

    def _given(self, record: Record) -> dict[int, Input]:
        """Returns the inputs that a record gives to the players of this edge, before it is taken.

        It returns none if they are those of the batches for sure.
        """
        if record.journal is None or self._stated <= self.replica.batches.get(self.name, -1):
            return {}
        held = {entity: held_input(self.world, entity) for entity in self._mine if entity in self.world}
        return held | recorded_inputs(record.journal[0] or [], aim=self.scene.aim)

    def _is_lost(self, tick: int) -> bool:
        """Returns whether a batch seems to be lost, and is to be sent again."""
        if not self._unrecorded or tick - max(self._unrecorded[0].number, self._resent) < RESEND_TICKS:
            return False
        self._resent = tick
        return True

    def _seat(self, record: Record, known: set[int], now: float) -> None:
        """Welcomes the clients of this edge that have joined.

        Args:
            record: the record.
            known: the players before it.
            now: the current time in seconds.
        """
        fresh: dict[int, int] = {}
        for to, _ in self.replica.outcome.events:
            for entity in self.players if to is None else to:
                fresh[entity] = fresh.get(entity, 0) + 1
        clients = {client: session for session, client in self._roster.clients.items()}
        for edge, client, entity, beside in rows(record.seated, 4):
            player = self.players.get(entity)
            if player is None or (beside and edge != self.name):
                continue
            if edge != self.name:
                player.recall()
                player.session = None
                self._mine.discard(entity)
                continue
            begins = entity not in self._mine
            self._mine.add(entity)
            session, token = clients.get(client), self._tokens.pop(client, b"")
            if session is None or session.closed or session is player.session:
                continue  # it is gone, or was seated beside its other connection before
            held = held_input(self.world, entity)
            resumed = entity in known and not beside
            player.inputs = EdgeInputs(self._bounds, self._row_bytes, held, resumed=resumed)
            if player.session is not None:
                self._roster.clients.pop(player.session, None)
            player.commands.clear()
            player.outbox.reconnect()
            if begins:
                player.outbox.begin(self.replica.events.get(entity, 0) - fresh.get(entity, 0))
            session.loading = False
            session.seat(player)
            session.received_at = session.stream.sent_at = now
            welcome = join_welcome(record.tick - 1, entity, self._scene_table, token)
            session.stream.private_due = self.replica.kept.private_of(entity)
            session.greeting = (record.tick, welcome)
            session.beginning = self.moves.message()

    def _forget_others(self) -> None:
        """Drops events and verdicts for players of other edges. An edge that seats them later has these as settled."""
        for entity, player in self.players.items():
            if entity not in self._mine and (player.verdicts or len(player.outbox)):
                player.outbox.begin(0)
                player.verdicts.clear()

    def _end(self, client: int, code: int, reason: str) -> None:
        """Ends the connection of a client because the sequencer has ended it."""
        for session in [session for session, number in self._roster.clients.items() if number == client]:
            del self._roster.clients[session]
            self.connections.end(session, code, reason, 0.0 if code == messages.TOO_SLOW else -1.0)


class _Durable(Commands):
    """Says that every record that an edge gets is durable."""

    def __init__(self, world: Any) -> None:
        self._world, self._saves = world, None
