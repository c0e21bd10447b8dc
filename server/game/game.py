"""The authoritative game: it queues external events, and changes the world in a tick only.

Theory of operation. A message that arrives is checked and queued with its session. The world changes only in `tick`, in
the order of that function's lines. A tick never waits for a client: it sends the newest snapshot to each client whose
connection has room for one. A client that was left out gets the union of what it missed with its next snapshot. An
error of a peer closes its connection with a code and a reason; no message of a peer raises an exception here. A link
may report itself as lost during a call of its `send` or `close`. Loops in which that can happen iterate over a copy of
the sessions.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from server.auth.identity import checked_subject
from server.config.limits import Limits, catch_up_ticks
from server.game.commands import Orders
from server.game.roster import Roster
from server.game.session import Session
from server.game_api.api import Stage
from server.journal.recorded_world import RecordedWorld, Saves
from server.observability.counters import Counters
from server.observability.errors import Faults
from server.players import persisted_state
from server.players.player import Player
from server.replication.client_stream import Link
from server.replication.sender import Delivery
from server.rewind import Rewind
from server.rules import Rules, checked_function
from shared import messages
from shared.bounds import in_ticks
from shared.checks import SceneError, shown, whole
from shared.inputs import Input
from shared.messages import (
    INPUT_ROW_BYTES,
    Bye,
    Command,
    Hello,
    Inputs,
    Ping,
    Pong,
    ProtocolError,
    Restart,
    Resync,
    Welcome,
    decode_from_client,
    encode,
)
from shared.scene import Scene

RESYNC_S = 1.0
"""Minimum time between two resynchronisations that one client requests, in seconds."""
BURST_S, BURST_TICKS_MIN = 1.0, 32
"""Size of a burst of messages: a client may send those of this many seconds (at least of this many ticks) at once.
If ticks of the server are late, the messages of that time are allowed besides."""
SEED_MAX = (1 << 63) - 1
"""Largest seed of the random numbers."""
AWAY_S = 1.0
"""Seconds. After a longer pause between two ticks, the silence of clients during it is not counted against them."""


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
        if world is not None and world.scene.fingerprint != scene.fingerprint:
            raise SceneError(f"world: is one of {world.scene!r}, and not of {scene!r}")
        if authenticate is not None:
            checked_function(authenticate, "authenticate")
        whole(seed, "seed", -SEED_MAX, SEED_MAX)
        self.scene = scene
        self.limits = limits or Limits()
        if world is None:
            world = RecordedWorld(scene, compiled=compiled)
            world.load_terrain()
        self.world = world
        self.rewind = Rewind(self.world, self.limits.rewind_s)
        self.counters = Counters()
        kept = None
        if saves is not None and self.world.tick > 0:
            kept = persisted_state.restored([*(saves.kept or ()), *(value for _, value in saves.notes)])
        self.stage = Stage(self.world, self.rewind, self.counters, rules or Rules(), kept=kept, seed=seed)
        self.faults = Faults()
        self.log = self.stage.log
        self.log.faults = self.faults
        self.delivery = Delivery(self.world, self.log, self.limits, self.counters)
        self.sessions: list[Session] = []
        self.roster = Roster(self.world, self.stage, self.limits, self.counters)
        self._authenticate = authenticate
        self.orders = Orders(self.world, self.stage, self.limits, self.faults, saves)
        self._deadline: float | None = None
        self._ticked: float | None = None
        self._catch_up = catch_up_ticks(scene.tick_rate)
        self._burst = in_ticks(BURST_S, scene.tick_rate, BURST_TICKS_MIN) * self.limits.messages_per_tick
        self._rules = scene.to_table()

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity, in the order in which they joined; do not change the dictionary."""
        return self.stage.kept.players

    # -- external events: queued ---------------------------------------------------------------------------

    def open(self, link: Link, now: float) -> Session:
        """Adds a new connection and returns its session. Its client has to send a Hello within `Limits.hello_s`."""
        session = Session(link, now)
        self.sessions.append(session)
        return session

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """Checks one message of a client and queues it, or closes the connection if it is not allowed."""
        if session.closed:
            return
        session.heard = now
        session.allowance -= 1
        if session.allowance < -self._burst and not self._owes(session, now):
            self._kick(session, messages.MALFORMED, "too many messages")
            return
        if len(data) > self.limits.message_bytes_max:
            self._kick(session, messages.TOO_BIG, f"a message longer than {self.limits.message_bytes_max} bytes")
            return
        try:
            message = decode_from_client(data)
        except ProtocolError as error:
            self.counters.malformed += 1
            self._kick(session, messages.MALFORMED, str(error))
            return
        if isinstance(message, Inputs) and session.entity:
            if len(message.rows) > self.limits.input_rows_max * INPUT_ROW_BYTES:
                self._kick(session, messages.MALFORMED, f"more than {self.limits.input_rows_max} inputs in a message")
                return
            session.inputs.file(message, self.world.tick, self._ticks_left(now))
            self.delivery.acked(session.stream, message.acked, now)
        elif isinstance(message, Ping):
            tick = self.world.tick + 1 - self._ticks_left(now)
            session.send(encode(Pong(message.sent, tick)))
            if session.corrections >= 0:  # the first report of a connection includes those of the connection before
                self.counters.corrections += max(message.corrections - session.corrections, 0)
            session.corrections = max(message.corrections, session.corrections)
        elif isinstance(message, Hello) and not session.entity and session.hello is None:
            self._hello(session, message, now)
        elif isinstance(message, Command) and session.entity:
            assert session.player is not None
            self.orders.file(session.player, message)
        elif isinstance(message, Resync) and session.entity:
            if now - session.resynced_at >= RESYNC_S:
                session.resynced_at = now
                self.counters.resyncs += 1
                self.delivery.forget(session.stream)
        elif isinstance(message, Restart) and session.entity:
            session.inputs.restart(message.tick)
        elif isinstance(message, Bye):
            self.roster.dismiss(session)
            session.close(messages.GOING_AWAY, "goodbye")
        else:
            state = "after the join" if session.entity else "before the join"
            self._kick(session, messages.MALFORMED, f"unexpected {type(message).__name__} {state}")

    def lost(self, session: Session, now: float) -> None:
        """Removes a session whose connection is gone. Its player may reconnect."""
        session.closed = True
        if session in self.sessions:
            self.sessions.remove(session)
        self.roster.lost(session, now)

    def shut_down(self, reason: str, wait: float) -> None:
        """Closes all connections.

        Args:
            reason: the reason, sent to the clients.
            wait: seconds after which the clients should reconnect.
        """
        for session in tuple(self.sessions):
            if not session.closed:
                self._end(session, messages.GOING_AWAY, reason, wait)

    def keep(self) -> list[list[Any]]:
        """Returns the persisted state and the unanswered commands as notes, for a checkpoint."""
        return [*persisted_state.whole(self.stage.kept), *self.orders.notes()]

    # -- the tick: the only place where the world changes --------------------------------------------------

    def tick(self, deadline: float, now: float) -> None:
        """Computes the next tick.

        Args:
            deadline: the time at which this tick was due, in seconds of the same clock as `now`. At this moment the
                server time equals the number of the tick.
            now: the current time in seconds.
        """
        self._excuse(now)
        self._deadline, self._ticked = deadline, now
        with self.stage.turn:
            self.stage.start()
            self.roster.leave(now)
            self._join()
            self.roster.revive()
            self.orders.carry_out()
            self.stage.act()
        inputs = self._take_inputs()
        self.world.step(inputs)
        self.stage.stepped()
        self.log.record()
        self.rewind.record()
        self.roster.fell_out()
        self._send(now)
        self._check_clocks(now)

    def _excuse(self, now: float) -> None:
        """Extends the time limits of all clients after a pause of the server itself, such as a suspended process."""
        paused_s = 0.0 if self._ticked is None else now - self._ticked - 1 / self.scene.tick_rate
        if paused_s > AWAY_S:
            credit = paused_s * self.scene.tick_rate * self.limits.messages_per_tick
            for session in self.sessions:
                session.opened = session.heard = session.stream.sent_at = now
                session.allowance += credit
            self.roster.excuse(paused_s, now)

    def _join(self) -> None:
        joining = [session for session in self.sessions if session.hello is not None and not session.closed]
        for session in joining[: self.limits.joins_per_tick]:
            try:
                self._welcome(session)
            except Exception:
                self._break(session, "a join")

    def _welcome(self, session: Session) -> None:
        assert session.hello is not None
        player, new = self.roster.find(session.hello.resume, session.subject), False
        if player is not None:
            self.counters.resumed += 1
            player.outbox.reconnect()
            if player.session is not None and not player.session.closed:
                self._end(player.session, messages.TAKEN_OVER, "the player goes on over another connection")
            session.seat(player)
        elif self.roster.connected >= self.limits.clients_max:
            self._refuse(session, messages.FULL, f"the server is full ({self.limits.clients_max} clients)")
            return
        else:
            player, new = self.roster.enter(session, session.hello.name), True
            if player is None:
                self._refuse(session, messages.FULL, "no room to spawn")
                return
        try:
            token = self.roster.issue(player)
            welcome = encode(Welcome(messages.VERSION, self.world.tick, player.entity, self._rules, token))
        except Exception:
            if new:
                self.roster.expel(player)
            raise
        session.greeting = (self.world.tick + 1, welcome)

    def _take_inputs(self) -> dict[int, Input]:
        tick = self.world.tick + 1
        inputs = {entity: player.inputs.take(tick) for entity, player in self.players.items()}
        inputs.update(self.stage.steered)
        self.stage.steered.clear()
        return inputs

    def _send(self, now: float) -> None:
        self.orders.answer()
        self.stage.tell(self.limits.outbox_max)
        for session in tuple(self.sessions):
            if session.allowance:
                most = self.limits.messages_per_tick
                if session.allowance < 0:  # messages beyond the burst were allowed because of late ticks
                    session.allowance = min(max(session.allowance, -self._burst) + most, 0.0)
                else:  # credit for messages that waited during a pause of the server
                    session.allowance = max(session.allowance - most, 0.0)
            if session.entity and not session.closed:
                try:
                    self.stage.show(session.stream)
                    if session.greeting is None or self._greeted(session, *session.greeting):
                        assert session.player is not None
                        self.delivery.serve(session.stream, session.player, now)
                    else:
                        session.stream.sent_at = (
                            now  # the welcome waits for the disk, which is not a stall of the client
                        )
                except Exception:
                    self._break(session, "serving a client")

    def _greeted(self, session: Session, tick: int, welcome: bytes) -> bool:
        """Sends the welcome once the resume token in it is durable, or at once if nothing can be saved.

        Returns:
            Whether the welcome has been sent.
        """
        if self.orders.durable_tick < tick and not self.orders.trouble:
            return False
        session.send(welcome)
        session.greeting = None
        return True

    def _check_clocks(self, now: float) -> None:
        for session in tuple(self.sessions):
            if session.closed:
                continue
            if not session.entity:
                if session.hello is None and now - session.opened > self.limits.hello_s:
                    self._kick(session, messages.NO_HELLO, f"no hello within {self.limits.hello_s:g} s")
            elif now - session.heard > self.limits.silence_s:
                self._kick(session, messages.TOO_SLOW, f"no message received for {self.limits.silence_s:g} s")
            elif now - session.stream.sent_at > self.limits.stalled_s:
                self._kick(session, messages.TOO_SLOW, f"the client read nothing for {self.limits.stalled_s:g} s")

    # -- inside --------------------------------------------------------------------------------------------

    def _owes(self, session: Session, now: float) -> bool:
        """Returns whether the ticks that are late now explain why a session exceeds its allowance of messages."""
        behind = 0.0 if self._ticked is None else max((now - self._ticked) * self.scene.tick_rate - 1, 0.0)
        return session.allowance >= -self._burst - behind * self.limits.messages_per_tick

    def _ticks_left(self, now: float) -> float:
        """Returns the ticks until the next tick's deadline, with a fraction; negative if it has passed.

        If more ticks are missed than are caught up on, the schedule drops the earliest. They do not count here;
        otherwise clients would be sent a server time that never comes.
        """
        if self._deadline is None:
            return 1.0
        passed = (now - self._deadline) * self.scene.tick_rate
        return 1.0 - passed if passed < self._catch_up + 1 else 1.0 - self._catch_up - passed % 1.0

    def _hello(self, session: Session, hello: Hello, now: float) -> None:
        if hello.version != messages.VERSION:
            newer = "older" if hello.version < messages.VERSION else "newer"
            reason = f"the client is {newer}: protocol version {hello.version}, the server speaks {messages.VERSION}"
            self._refuse(session, messages.WRONG_VERSION, reason)
            return
        mine = self.scene.digests
        differ = sorted(name for name in mine | hello.scene if mine.get(name) != hello.scene.get(name))
        if hello.scene and differ:
            reason = f"the server plays another scene ({', '.join(name[:40] for name in differ)} differ)"
            self._refuse(session, messages.WRONG_SCENE, reason)
            return
        if len(hello.name) > self.limits.name_max:
            self._refuse(session, messages.MALFORMED, f"a name longer than {self.limits.name_max} characters")
            return
        if self._authenticate is not None:
            try:
                subject = self._authenticate(hello.token)
            except ValueError as error:
                self._refuse(session, messages.UNAUTHORISED, str(error))
                return
            except Exception:
                self._break(session, "authenticating a client")
                return
            try:
                session.subject = checked_subject(subject)
            except ValueError:
                self.faults.report("the result of the authenticator")
                self._refuse(session, messages.UNAUTHORISED, "the server's authenticator returned no valid subject")
                return
        session.stream.pacing.answered(now - session.opened, 0, now)  # a round trip with nothing on the way
        session.hello = hello._replace(token="")

    def _refuse(self, session: Session, code: int, reason: str) -> None:
        self.counters.refused += 1
        self._end(session, code, reason)

    def _kick(self, session: Session, code: int, reason: str) -> None:
        self.counters.kicked += 1
        if code != messages.TOO_SLOW:  # slowness is the network's fault: the player may reconnect
            self.roster.dismiss(session)
        self._end(session, code, reason)

    def _break(self, session: Session, what: str) -> None:
        """Handles an exception in our own code that affects one client: closes its connection, and the tick goes on.

        The player may reconnect.

        Args:
            session: the client's session.
            what: what the exception interrupted, for the log.
        """
        self.faults.report(what)
        try:
            session.close(messages.INTERNAL, "internal error")
        except Exception:
            self.faults.report("closing a link")
        self.lost(session, session.heard)

    def _end(self, session: Session, code: int, reason: str, wait: float = -1.0) -> None:
        reason = reason.encode(errors="replace").decode()[: messages.REASON_MAX]
        self.counters.closed[code] = self.counters.closed.get(code, 0) + 1
        try:
            session.send(encode(Bye(code, reason, wait)))
            session.close(code, reason)
        except Exception:
            self._break(session, "saying goodbye")

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
