"""The authoritative game: external events are filed, the tick acts.

Theory of operation. Whatever arrives is checked and filed with its session; the world changes in `tick` and
nowhere else, in the order in which that function reads. A tick never waits for a client: each is sent the newest
snapshot if its link has room for one, and otherwise nothing (it gets the union of what it missed with the next).
A peer's mistake closes its connection with a code and a reason; no input of a peer raises. Links call back: one may
report itself as lost while it is being sent to or closed, so wherever that can happen a copy of the sessions is gone
through.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from server import keeping
from server.auth import checked_subject
from server.counters import Counters
from server.delivery import Delivery
from server.faults import Faults
from server.limits import Limits, catch_up_ticks
from server.orders import Orders
from server.recorder import RecordedWorld, Saves
from server.rewind import Rewind
from server.roster import Roster
from server.rules import Rules, checked_function
from server.session import Link, Session
from server.stage import Stage
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
"""A client may ask for everything anew so often."""
BURST_S, BURST_TICKS_MIN = 1.0, 32
"""A client may send this many seconds' (at least this many ticks') worth of messages at once, and as many more as the
server itself is behind."""
SEED_MAX = (1 << 63) - 1
AWAY_S = 1.0
"""After a pause between two ticks of more than this many seconds, the clients' silence is not counted against them."""


class Game:
    """One world and its clients.

    Args:
        scene: the rules; its terrain is generated at once.
        limits: bounds.
        compiled: as for `World`.
        world: to be played in, with its blocks; by default a new one.
        saves: where that world is saved, if it is: the game goes on with what was kept beside it, and a verdict is told
            when no crash can undo it any more.
        rules: what happens beyond moving and editing.
        seed: of their randomness.
        authenticate: gives the subject of the token that a client shows; a `ValueError` of it refuses the client,
            with its text. None: whoever comes may play.
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
            kept = keeping.restored([*(saves.kept or ()), *(value for _, value in saves.notes)])
        self.stage = Stage(self.world, self.rewind, self.counters, rules or Rules(), kept=kept, seed=seed)
        self.faults = Faults()
        self.log = self.stage.log
        self.log.faults = self.faults
        self.delivery = Delivery(self.world, self.log, self.limits, self.counters)
        self.sessions: list[Session] = []
        self.roster = Roster(self.world, self.stage, self.limits, self.counters)
        self.players = self.roster.players
        self._authenticate = authenticate
        self.orders = Orders(self.world, self.stage, self.limits, self.faults, saves)
        self._deadline: float | None = None
        self._ticked: float | None = None
        self._catch_up = catch_up_ticks(scene.tick_rate)
        self._burst = in_ticks(BURST_S, scene.tick_rate, BURST_TICKS_MIN) * self.limits.messages_per_tick
        self._rules = scene.to_table()

    # -- what arrives is filed -----------------------------------------------------------------------------

    def open(self, link: Link, now: float) -> Session:
        """A connection is there; its client has to say hello."""
        session = Session(link, now)
        self.sessions.append(session)
        return session

    def receive(self, session: Session, data: bytes, now: float) -> None:
        """One message of a client."""
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
            self.delivery.acked(session, message.acked, now)
        elif isinstance(message, Ping):
            tick = self.world.tick + 1 - self._ticks_left(now)
            session.send(encode(Pong(message.sent, tick)))
            if session.corrections >= 0:  # what it begins with has been told over the connection before
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
                self.delivery.forget(session)
        elif isinstance(message, Restart) and session.entity:
            session.inputs.restart(message.tick)
        elif isinstance(message, Bye):
            self.roster.dismiss(session)
            session.close(messages.GOING_AWAY, "goodbye")
        else:
            self._kick(session, messages.MALFORMED, f"{type(message).__name__} at this point")

    def lost(self, session: Session, now: float) -> None:
        """The connection of a session is gone."""
        session.closed = True
        if session in self.sessions:
            self.sessions.remove(session)
        self.roster.lost(session, now)

    def shut_down(self, reason: str, wait: float) -> None:
        """Tells every client, with the seconds after which to come back, and closes the connections."""
        for session in tuple(self.sessions):
            if not session.closed:
                self._end(session, messages.GOING_AWAY, reason, wait)

    def keep(self) -> list[list[Any]]:
        """What belongs to the game and is not in its world, for a checkpoint."""
        return [*keeping.whole(self.stage.kept), *self.orders.notes()]

    # -- the tick acts -------------------------------------------------------------------------------------

    def tick(self, deadline: float, now: float) -> None:
        """One tick. `deadline`: the time it was due, by the same clock as `now`; it ends tick T at `deadline`."""
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
        """The time in which the server itself had no turn (it was suspended) is counted against nobody."""
        paused_s = 0.0 if self._ticked is None else now - self._ticked - 1 / self.scene.tick_rate
        if paused_s > AWAY_S:
            credit = paused_s * self.scene.tick_rate * self.limits.messages_per_tick
            for session in self.sessions:
                session.opened = session.heard = session.sent_at = now
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
                if session.allowance < 0:  # what exceeds the burst has been found excusable
                    session.allowance = min(max(session.allowance, -self._burst) + most, 0.0)
                else:  # for messages that waited while the server had no turn
                    session.allowance = max(session.allowance - most, 0.0)
            if session.entity and not session.closed:
                try:
                    self.stage.show(session)
                    if session.greeting is None or self._greeted(session, *session.greeting):
                        self.delivery.serve(session, now)
                    else:
                        session.sent_at = now  # it waits for the disk, and nobody for it
                except Exception:
                    self._break(session, "serving a client")

    def _greeted(self, session: Session, tick: int, welcome: bytes) -> bool:
        """Lets a client in once its token will last; at once, if it cannot be saved: then it plays all the same."""
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
                self._kick(session, messages.TOO_SLOW, f"nothing heard for {self.limits.silence_s:g} s")
            elif now - session.sent_at > self.limits.stalled_s:
                self._kick(session, messages.TOO_SLOW, f"nothing read for {self.limits.stalled_s:g} s")

    # -- inside --------------------------------------------------------------------------------------------

    def _owes(self, session: Session, now: float) -> bool:
        """Whether ticks that are late explain how much a session has sent since the latest."""
        behind = 0.0 if self._ticked is None else max((now - self._ticked) * self.scene.tick_rate - 1, 0.0)
        return session.allowance >= -self._burst - behind * self.limits.messages_per_tick

    def _ticks_left(self, now: float) -> float:
        """Ticks until the next tick's deadline; negative if it has passed.

        Of more missed ticks than are caught up on, the schedule drops the earliest: they do not count as time here, or
        every client would be told of a time that never comes.
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
                self.faults.report("what authenticates clients")
                self._refuse(session, messages.UNAUTHORISED, "the server cannot use what its check of tokens says")
                return
        session.pacing.answered(now - session.opened, 0, now)  # of a path that was empty
        session.hello = hello._replace(token="")

    def _refuse(self, session: Session, code: int, reason: str) -> None:
        self.counters.refused += 1
        self._end(session, code, reason)

    def _kick(self, session: Session, code: int, reason: str) -> None:
        self.counters.kicked += 1
        if code != messages.TOO_SLOW:  # that is the network's fault
            self.roster.dismiss(session)
        self._end(session, code, reason)

    def _break(self, session: Session, what: str) -> None:
        """An exception of ours has hit one client: it is let go without a word, may come back, and the tick goes on."""
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
        """Counters, with those of the clients that are connected."""
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
