"""The front of a game: takes the messages of clients, and sends them what is due."""

import dataclasses
from typing import Any, Protocol

from server.config.limits import Limits
from server.game.clocks import Clocks
from server.game.connections import Connections
from server.game.fast_path import FastPath
from server.game.session import Session
from server.game_api.shared_values import SharedValues
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.players.persisted_state import PersistedState
from server.players.player import Player
from server.replication.client_stream import Transport
from server.replication.sender import Sender
from shared import messages
from shared.messages import (
    Beside,
    Bye,
    Command,
    Held,
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


class Greets(Protocol):
    """The handshakes (`server.game.joining`)."""

    def hello(self, session: Session, hello: Hello, now: float) -> None:
        """Checks a Hello."""

    def greet(self, session: Session, tick: int, welcome: bytes) -> bool:
        """Sends the welcome if it may be sent. Returns whether it was."""
        ...


class Files(Protocol):
    """The commands (`server.game.commands`)."""

    def file(self, player: Player, command: Command) -> None:
        """Queues a command that has arrived."""


class Front:
    """The part of a game that faces the clients. The class that joins the parts of a game sets these attributes."""

    limits: Limits
    counters: Counters
    clocks: Clocks
    connections: Connections
    sender: Sender
    joining: Greets
    commands: Files
    world: RecordedWorld
    scene: Scene
    fast_path: FastPath | None = None
    """Serves the sessions that have nothing special to do; None: there is no compiled kernel."""
    takes_second = False
    """Whether a client may open a second connection, to go on over it."""
    _row_bytes: int

    @property
    def kept(self) -> PersistedState:
        """The persisted state: players, attributes and shared values; do not change it."""
        raise NotImplementedError

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity, in the order in which they joined; do not change the dictionary."""
        return self.kept.players

    @property
    def newest(self) -> int:
        """The newest tick whose inputs were taken."""
        raise NotImplementedError

    @property
    def sessions(self) -> list[Session]:
        """The sessions of all connections, joined or not; do not change the list."""
        return self.connections.sessions

    def stats(self) -> dict[str, Any]:
        """Returns all counters, including the inputs of the present players, and the size of the game."""
        totals = dataclasses.replace(self.counters)
        for player in self.players.values():
            totals.add(player.counts)
        return dataclasses.asdict(totals) | {
            "tick": self.world.tick,
            "tick_rate": self.scene.tick_rate,
            "clients": sum(session.entity > 0 for session in self.sessions),
            "players": len(self.players),
            "entities": len(self.world),
            "entities_awake": self.world.awake_count,
            "segments": len(self.world.blocks.rows),
        }

    # -- external events: queued ---------------------------------------------------------------------------

    def open(self, link: Transport, now: float) -> Session:
        """Adds a new connection and returns its session. Its client has to send a Hello within `Limits.hello_s`."""
        return self.connections.open(link, now)

    def lost(self, session: Session, now: float) -> None:
        """Removes a session whose connection is gone. Its player may reconnect."""
        self.connections.lost(session, now)

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """Checks one message of a client and queues it, or closes the connection if it is not allowed."""
        if session.row >= 0:
            assert self.fast_path is not None
            if self.fast_path.arrivals.post(session, data, now):
                return
        if session.closed:
            return
        if session.row < 0 and not self.clocks.allow(session, now):
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
            session.inputs.file(message, self.newest, self.clocks.ticks_left(now))
            self.sender.acked(session.stream, message.acked, now)
        elif isinstance(message, Held) and session.entity:
            inputs = session.inputs
            inputs.hold(message, self.newest, self.clocks.ticks_left(now))
            self.sender.acked(session.stream, inputs.newest - message.behind, now)
        elif isinstance(message, Ping):
            tick = self.newest + 1 - self.clocks.ticks_left(now)
            session.send(encode(Pong(message.sent, tick)))
            if session.corrections >= 0:  # the first report of a connection includes those of the connection before
                self.counters.corrections += max(message.corrections - session.corrections, 0)
            session.corrections = max(message.corrections, session.corrections)
        elif isinstance(message, Hello) and not session.entity and session.hello is None and not session.loading:
            self.hello(session, message, now)
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
        elif isinstance(message, Beside) and self.takes_second and not (session.hello or session.player):
            session.beside = True
            self.hello(session, Hello(message.version, {}, "", message.token, message.resume), now)
        else:
            state = "after the join" if session.entity else "before the join"
            self.connections.kick(session, messages.MALFORMED, f"unexpected {type(message).__name__} {state}")

    def hello(self, session: Session, hello: Hello, now: float) -> None:
        """Takes the first message of a client."""
        self.joining.hello(session, hello, now)

    # -- what goes out, once per tick ------------------------------------------------------------------------

    def _send(self, values: SharedValues, now: float) -> None:
        """Sends each client that has joined what is due: its welcome, or the newest snapshot and events."""
        fast_path = self.fast_path
        if fast_path is not None:
            fast_path.send(values.version, now)
            if self.connections.all_fast:
                return
        for session in self.connections.others:
            if session.entity and not session.closed:
                try:
                    values.show(session.stream)
                    if session.greeting is None or self.joining.greet(session, *session.greeting):
                        assert session.player is not None
                        self.sender.serve(session.stream, session.player, now)
                        if fast_path is not None:
                            fast_path.consider(session, values.version)
                    else:  # the welcome waits for the disk, which is not a stall of the client
                        session.stream.sent_at = now
                except Exception:
                    self.connections.fail(session, "serving a client")
