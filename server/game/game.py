"""The authoritative game: it queues external events, and changes the world in a tick only.

Theory of operation. A message that arrives is checked and queued with its session. The world changes only in `tick`, in
the sequencer half of it (`server.game.sequencer`); the edge half (`server.game.edge`) and the sending follow. Both
halves share one world here. A tick never waits for a client: it sends the newest snapshot to each client whose
connection has room for one. A client that was left out gets the union of what it missed with its next snapshot. An
error of a peer closes its connection with a code and a reason; no message of a peer raises an exception here.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from server.config.limits import Limits
from server.game.clocks import Clocks
from server.game.commands import Commands
from server.game.connections import Connections
from server.game.edge import Edge
from server.game.joining import Joining
from server.game.roster import Roster
from server.game.sequencer import Sequencer
from server.game.session import Session
from server.game_api.api import GameApi
from server.journal.recorded_world import RecordedWorld, Saves
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players import persisted_state
from server.players.player import Player
from server.replication.client_stream import Transport
from server.rewind import Rewind
from server.rules import Rules, checked_function, equipped
from shared import messages
from shared.checks import SceneError, shown, whole
from shared.messages import (
    Bye,
    Command,
    Hello,
    Inputs,
    Ping,
    Pong,
    ProtocolError,
    Restart,
    Resync,
    decode_from_client,
    encode,
)
from shared.scene import Scene

RESYNC_S = 1.0
"""Minimum time between two resynchronisations that one client requests, in seconds."""
SEED_MAX = (1 << 63) - 1
"""Largest seed of the random numbers."""


class Game:
    """One world, its players and their connections.

    Args:
        scene: the scene to play.
        limits: the limits.
        compiled: whether the kernel is compiled, as for `World`.
        world: the world to play in, with its blocks; None: a new one with the terrain of the scene.
        saves: the store of the world, if it is saved. The game restores the persisted state from it, and sends the
            result of a command when no crash can undo the command any more.
        rules: the rules of the game; None: players can only move and edit.
        seed: seed of the rules' random numbers.
        authenticate: returns the subject of a client's token, or raises a `ValueError`, whose text is sent to the
            refused client. None: anyone may play.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        limits: Limits | None = None,
        compiled: bool | None = None,
        world: RecordedWorld | None = None,
        saves: Saves | None = None,
        rules: Rules | None = None,
        seed: int = 0,
        authenticate: Callable[[str], str] | None = None,
    ) -> None:
        for value, at, kind in ((scene, "scene", Scene), (limits, "limits", Limits), (world, "world", RecordedWorld)):
            if not isinstance(value, kind) and (value is not None or kind is Scene):
                raise SceneError(f"{at} = {shown(value)}: must be a `{kind.__name__}`")
        if isinstance(rules, Rules):
            scene = equipped(scene, rules)
        if world is not None and world.scene.fingerprint != scene.fingerprint:
            raise SceneError(f"world: is one of {world.scene!r}, and not of {scene!r}")
        if authenticate is not None:
            checked_function(authenticate, "authenticate")
        whole(seed, "seed", -SEED_MAX, SEED_MAX)
        self.scene = scene
        self.limits = limits or Limits()
        self._row_bytes = scene.input_row_bytes
        if world is None:
            world = RecordedWorld(scene, compiled=compiled)
            world.load_terrain()
        self.world = world
        self.rewind = Rewind(self.world, self.limits.rewind_s)
        self.counters = Counters()
        kept = None
        if saves is not None and self.world.tick > 0:
            kept = persisted_state.restored([*(saves.kept or ()), *(value for _, value in saves.notes)])
        self.api = GameApi(self.world, self.rewind, self.counters, rules or Rules(), kept=kept, seed=seed)
        self.faults = FaultReporter()
        self.roster = Roster(self.world, self.api, self.limits, self.counters)
        self.commands = Commands(self.world, self.api, self.limits, self.faults, saves)
        self.edge = Edge(self.world, self.api.kept, self.limits, self.counters, lambda: self.commands.durable_tick)
        self.log, self.sender = self.edge.log, self.edge.sender
        self.log.faults = self.faults
        self.connections = Connections(self.roster, self.counters, self.faults)
        self.clocks = Clocks(scene.tick_rate, self.limits, self.connections, self.roster)
        self.joining = Joining(
            self.world,
            self.limits,
            self.counters,
            self.faults,
            self.connections,
            self.roster,
            self.commands,
            authenticate,
            rules or Rules(),
        )
        self.sequencer = Sequencer(
            self.world, self.api, self.rewind, self.roster, self.joining, self.commands, self.connections
        )

    @property
    def sessions(self) -> list[Session]:
        """The sessions of all connections, joined or not; do not change the list."""
        return self.connections.sessions

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity, in the order in which they joined; do not change the dictionary."""
        return self.api.kept.players

    # -- external events: queued ---------------------------------------------------------------------------

    def open(self, link: Transport, now: float) -> Session:
        """Adds a new connection and returns its session. Its client has to send a Hello within `Limits.hello_s`."""
        return self.connections.open(link, now)

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """Checks one message of a client and queues it, or closes the connection if it is not allowed."""
        if session.closed:
            return
        if not self.clocks.allow(session, now):
            self.connections.kick(session, messages.MALFORMED, "too many messages")
            return
        if len(data) > self.limits.message_bytes_max:
            reason = f"a message longer than {self.limits.message_bytes_max} bytes"
            self.connections.kick(session, messages.TOO_BIG, reason)
            return
        try:
            message = decode_from_client(data, self._row_bytes)
        except ProtocolError as error:
            self.counters.malformed += 1
            self.connections.kick(session, messages.MALFORMED, str(error))
            return
        if isinstance(message, Inputs) and session.entity:
            if len(message.rows) > self.limits.input_rows_max * self._row_bytes:
                reason = f"more than {self.limits.input_rows_max} inputs in a message"
                self.connections.kick(session, messages.MALFORMED, reason)
                return
            session.inputs.file(message, self.world.tick, self.clocks.ticks_left(now))
            self.sender.acked(session.stream, message.acked, now)
        elif isinstance(message, Ping):
            tick = self.world.tick + 1 - self.clocks.ticks_left(now)
            session.send(encode(Pong(message.sent, tick)))
            if session.corrections >= 0:  # the first report of a connection includes those of the connection before
                self.counters.corrections += max(message.corrections - session.corrections, 0)
            session.corrections = max(message.corrections, session.corrections)
        elif isinstance(message, Hello) and not session.entity and session.hello is None and not session.loading:
            self.joining.hello(session, message, now)
        elif isinstance(message, Command) and session.entity:
            assert session.player is not None
            self.commands.file(session.player, message)
        elif isinstance(message, Resync) and session.entity:
            if now - session.resynced_at >= RESYNC_S:
                session.resynced_at = now
                self.counters.resyncs += 1
                self.sender.forget(session.stream)
        elif isinstance(message, Restart) and session.entity:
            session.inputs.restart(message.tick)
        elif isinstance(message, Bye):
            self.connections.leave(session)
        else:
            state = "after the join" if session.entity else "before the join"
            self.connections.kick(session, messages.MALFORMED, f"unexpected {type(message).__name__} {state}")

    def lost(self, session: Session, now: float) -> None:
        """Removes a session whose connection is gone. Its player may reconnect."""
        self.connections.lost(session, now)

    def shut_down(self, reason: str, wait: float, code: int = messages.GOING_AWAY) -> None:
        """Lets the rules finish (`on_stop`), and closes all connections.

        Args:
            reason: the reason, sent to the clients.
            wait: seconds after which the clients should reconnect; negative: they should not.
            code: the close code.
        """
        with self.api.turn:
            self.api.hooks.stop()
        self.connections.shut_down(reason, wait, code)

    def keep(self) -> list[list[Any]]:
        """Returns the persisted state and the unanswered commands as notes, for a checkpoint."""
        return [*persisted_state.whole(self.api.kept), *self.edge.answers.notes()]

    # -- the tick: the only place where the world changes --------------------------------------------------

    def tick(self, deadline: float, now: float) -> None:
        """Computes the next tick.

        Args:
            deadline: the time at which this tick was due, in seconds of the same clock as `now`. At this moment the
                server time equals the number of the tick.
            now: the current time in seconds.
        """
        self.clocks.begin(deadline, now)
        self.edge.follow(self.sequencer.advance(now))
        self.clocks.refill()
        self._send(now)
        self.sequencer.finish()
        self.clocks.check(now)

    def _send(self, now: float) -> None:
        """Sends each client that has joined what is due: its welcome, or the newest snapshot and events."""
        for session in tuple(self.sessions):
            if session.entity and not session.closed:
                try:
                    self.api.shared_values.show(session.stream)
                    if session.greeting is None or self.joining.greet(session, *session.greeting):
                        assert session.player is not None
                        self.sender.serve(session.stream, session.player, now)
                    else:  # the welcome waits for the disk, which is not a stall of the client
                        session.stream.sent_at = now
                except Exception:
                    self.connections.fail(session, "serving a client")

    def stats(self) -> dict[str, Any]:
        """Returns all counters, including the inputs of the present players, and the size of the game."""
        totals = dataclasses.replace(self.counters)
        for player in self.players.values():
            totals.add(player.inputs)
        return dataclasses.asdict(totals) | {
            "tick": self.world.tick,
            "tick_rate": self.scene.tick_rate,
            "clients": sum(session.entity > 0 for session in self.sessions),
            "players": len(self.players),
            "entities": len(self.world),
            "entities_awake": self.world.awake_count,
            "segments": len(self.world.blocks.rows),
        }
