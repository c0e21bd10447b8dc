"""A client without its socket: messages and times in, messages, events and a view out.

    joining   Hello and pings are sent; the welcome, the terrain around the player and the server's time arrive
    playing   in each tick: step the predicted world with the input, and send the input; after each snapshot: reconcile
              (`client_sdk.input_loop`)
    away      the connection is lost; prediction goes on, at most 4 s beyond the newest snapshot. Over a new connection,
              the client sends unanswered commands again, fetches the world into a second replica, and then replaces
              the old one
    closed    the connection is over for good

A `Go` of the server leads to another world: the client joins it from the start, over a new connection
(`client_sdk.travel`).

`now` is always a time in float seconds; all calls use one monotonic clock.
"""

import math
from collections.abc import Iterable
from typing import Any

from client_sdk.advice import advised
from client_sdk.changing import TAKEN_OVER_S, Changing
from client_sdk.events import Disconnected, Joined, Left, Resumed, SegmentLoaded
from client_sdk.port import READ_BYTES
from client_sdk.reconnect import Reconnect
from client_sdk.replica import Replica
from client_sdk.travel import progress
from shared import fields, messages
from shared.behaviours import Behaviour, BehaviourError
from shared.checks import duration, text
from shared.messages import ProtocolError, decode_from_server, encode
from shared.scene import Scene

COME_AGAIN = (messages.TOO_SLOW, messages.GOING_AWAY, messages.NO_HELLO)
"""Close codes after which a client reconnects although the server did not ask for it: the connection was at fault."""
NAME_MAX = 1 << 16
"""Longest name that a program may pass, in characters; only the first `fields.NAME_MAX` characters are sent."""


class Core(Changing):
    """The client as a state machine.

    Args:
        name: the player's name, shown to others.
        scene: the scene that this program was built for, compared by the server; None: the server's scene is accepted.
        token: proves the client's identity, if the server asks for it.
        patience_s: the client tries to reconnect for this long after a lost connection, in seconds; 0: it does not.
        compiled: True: use a compiled kernel; False: use the plain one; None: use the one that `shared.kernels`
            chooses, and the plain one as long as Numba compiles it, because no call of a core waits for a compiler.
        neighbours: whether the predicted world has other entities, so that blocking each other is predicted.
        behaviours: this program's classes of the game's behaviours. A server whose scene needs others is refused.

    Raises:
        ValueError: the name or the token is not a text, is too long, or UTF-8 cannot hold it.
    """

    def __init__(
        self,
        name: str = "",
        scene: Scene | None = None,
        *,
        token: str = "",
        patience_s: float = 0.0,
        compiled: bool | None = None,
        neighbours: bool = True,
        behaviours: Iterable[type[Behaviour]] = (),
    ) -> None:
        super().__init__(scene, behaviours, compiled=compiled, neighbours=neighbours)
        self.name = text(name, "name", NAME_MAX, shortest=0)
        self.close_request: tuple[int, str] | None = None
        """Close code and reason with which the transport has to close the connection now; None: it must not."""
        self.reconnect = Reconnect(duration(patience_s, "patience_s", endless=True))
        self.shared: dict[str, Any] = {}
        """The values that the rules of the game share with all clients, by name."""
        self.private: dict[str, Any] = {}
        """The values that the rules of the game share with this player only, by name."""
        self._token = text(token, "token", fields.TOKEN_MAX, shortest=0)
        self._resume = b""
        self._scene_asked = scene

    @property
    def appetite(self) -> int:
        """The number of bytes that the transport should read at once."""
        return READ_BYTES

    def outstanding(self) -> int:
        """Returns 0, because without a simulated link, no bytes wait between the transport and the core."""
        return 0

    def dials(self, now: float) -> bool:
        """Returns whether the transport has to open a new connection now, to the path `travel.path`.

        A stream of the old connection that is still open is not needed any more.
        """
        return now >= self.reconnect.retry_at and self.state != "closed"

    # -- what comes in -------------------------------------------------------------------------------------

    def open(self, now: float) -> None:
        """Takes a new connection, and sends Hello."""
        if self.state == "closed":
            return
        self._open = True
        self._out.clear()
        digests = self.scene.digests if self.scene else {}
        self._send(messages.Hello(messages.VERSION, digests, self.name[: fields.NAME_MAX], self._token, self._resume))

    def receive(self, data: bytes, now: float) -> None:
        """Takes one message of the server. A malformed message closes the connection."""
        if self.state == "closed" or not self._open:
            return
        self.stats.bytes_down += len(data)
        try:
            self._take(decode_from_server(data), now)
        except ProtocolError as error:
            self._fail(messages.MALFORMED, f"the server sent something malformed: {error}")

    def lost(self, code: int, reason: str, now: float) -> None:
        """Takes the loss of the connection, or the failure of an attempt to connect."""
        if self.travel.leaving:
            self.close_request = None
            self.reconnect.plan(now + self.travel.left())
        elif (not self._open and self.reconnect.retry_at < math.inf) or (self.handover and self.handover.alone):
            return  # a `Bye` has already announced it
        elif self._comes_back:
            self._cut_off(Left(code, reason, 0.0), now)
        elif self._worlds.filled is None and self.travel.again():
            self._open = False
            self.reconnect.plan(now + self.travel.left())
        else:
            self._end(Left(code, reason))

    def close(self) -> None:
        """Leaves the game: sends Bye and asks the transport to close the connection."""
        if self.state != "closed":
            if self._open:
                self._send(messages.Bye(messages.GOING_AWAY, "", -1.0))
            self.close_request = (1000, "")
            self._end(Left(1000, "closed by this client"))

    # -- time ----------------------------------------------------------------------------------------------

    def update(self, now: float) -> None:
        """Starts the play once the world is complete, predicts every tick that is due, and sends pings that are due."""
        worlds = self._worlds
        if self.handover is not None:
            self._update_second(now)
        if worlds.plain_for_now:
            worlds.speed_up()
        if worlds.play and self.state != "closed":
            for message in worlds.play.follow(now, online=self.state == "playing"):
                self._send(message)
                self._copy(message)
        if self._open and worlds.ping_due(now):
            self._send(messages.Ping(now, self.stats.corrections))
        if self.state in ("joining", "reconnecting") and worlds.filled and worlds.filled.complete:
            self._begin(worlds.filled, now)
        if worlds.play and self.state != "closed":
            for message in worlds.play.update(now, self.controls, online=self.state == "playing"):
                self._send(message)
                self._copy(message)
        else:
            self.controls.forget()

    def next_update(self, now: float) -> float:
        """Returns the local time at which `update` has something to do; `inf`: not before a message arrives."""
        worlds = self._worlds
        due = worlds.connection_clock.next_ping if self._open else self.reconnect.retry_at
        if worlds.play:
            due = min(due, worlds.play.next_tick(now))
        if self.second is not None:
            due = min(due, self.second.next_update(now))
        return max(due, now)  # inf: nothing to do until a message arrives

    # -- what goes out -------------------------------------------------------------------------------------

    def outgoing(self) -> list[bytes]:
        """Returns the messages to send, and forgets them."""
        if not self._out:
            return []
        out, self._out = self._out, []
        self.stats.bytes_up += sum(map(len, out))
        return out

    # -- inside --------------------------------------------------------------------------------------------

    def _take(self, message: messages.Message, now: float) -> None:
        match message:
            case messages.Snapshot():
                self._worlds.snapshot(message, self._commands, now)
            case messages.Pong():
                self._worlds.answered(message, now)
            case messages.Terrain():
                segment = self._worlds.welcomed(message).terrain(message)
                if segment is not None:
                    self._events.append(SegmentLoaded(segment))
            case messages.Welcome():
                self._welcome(message, now)
            case messages.Happened():
                self._happened(message, announced=False)
            case messages.Announce():
                self._happened(message, announced=self._worlds.announced(message))
            case messages.Refusal():
                self._commands.refused(message)
            case messages.NextHappened():
                self._game_events.next(message.number, hold=self._joins)
            case messages.Private():
                self.private = message.values
            case messages.Shared():
                self.shared = message.values
            case messages.Bye():
                self._bye(message, now)
            case messages.Go():
                self._go(message, now)
            case messages.Edges():
                self.travel.edges, self.travel.fronts = message.addresses, self._worlds.filled is None
                self._game_events.apart = self._game_events.apart or self._worlds.filled is not None
            case messages.HandOver():
                self._begin_handover(message, now)
            case messages.Waiting() if self.state in ("joining", "reconnecting") and not self._worlds.filled:
                waiting = progress(message)
                if self.state == "joining":
                    self._events.append(waiting)
            case _:
                raise ProtocolError(f"unexpected {type(message).__name__} message from a server")

    @property
    def _comes_back(self) -> bool:
        """Whether the client reconnects after a lost connection: it has played, or was sent to a world that took it."""
        return self.state in ("playing", "reconnecting") or (self._worlds.filled is not None and self.travel.sent)

    def _welcome(self, welcome: messages.Welcome, now: float) -> None:
        worlds = self._worlds
        if worlds.filled:
            raise ProtocolError("unexpected second Welcome message")
        try:
            world = worlds.replica(welcome, now)
        except BehaviourError as error:
            self._send(messages.Bye(messages.WRONG_SCENE, str(error)[: fields.REASON_MAX], -1.0))  # no seat is kept
            self._fail(messages.WRONG_SCENE, str(error))
            return
        if self.scene is not None and world.scene.digests != self.scene.digests:
            raise ProtocolError("Welcome.scene: not the scene that the client requested")
        self.scene, self._resume = world.scene, welcome.resume
        self.travel.welcomed()
        self.reconnect.spread = welcome.entity
        if worlds.play and welcome.entity == self.entity:
            self._out += self._commands.again()
        elif worlds.play:
            for answered in self._commands.give_up("the connection was lost"):
                self._events.append(answered)
            self._game_events.restart()
            self.private = {}
        worlds.filled = world

    def _begin(self, world: Replica, now: float) -> None:
        """Starts the play in a complete replica, for the first time or after a reconnect."""
        unsent, same = self._worlds.begin(world, now)
        self.state = "playing"
        tick, away_s = world.prediction.predicted.tick, self.reconnect.away_s(now)
        self._events.append(Resumed(tick, away_s) if same else Joined(self.entity, world.scene, tick))
        self._game_events.release()
        self.reconnect.back()
        self.travel.plays(now)
        for message in unsent:
            self._send(message)

    def _bye(self, bye: messages.Bye, now: float) -> None:
        if self.handover is not None and bye.code == messages.TAKEN_OVER:
            self.handover.alone = True
            return
        if bye.code == messages.TAKEN_OVER and now - self._beside_lost < TAKEN_OVER_S:
            self._cut_off(Left(bye.code, bye.reason, 0.0), now)
            return
        left = Left(bye.code, advised(bye.code, bye.reason), bye.wait)
        if self._comes_back and (bye.wait >= 0 or bye.code in COME_AGAIN):
            self._cut_off(left, now)
        elif self.state == "joining" and not self._worlds.filled and self.travel.again(bye, self.reconnect.spread):
            self._depart()
        else:
            self._end(left)

    def _go(self, go: messages.Go, now: float) -> None:
        """Leaves for another world, as a new player there; on the way back to a world, only for its present server."""
        if self.state == "reconnecting" and not self._worlds.filled and self.travel.here(go):
            self.travel.redirect(go)
            self._depart()
            return
        event = self.travel.go(go, now, lobby=self.state == "joining" and not self._worlds.filled)
        for answered in self._commands.give_up("the client went to another world"):
            self._events.append(answered)
        self._game_events.restart()
        if event is not None:
            self._events.append(event)
        self.state, self._resume = "joining", b""
        self.shared, self.private = {}, {}
        if self.scene is not self._scene_asked:
            self.scene = self._scene_asked
            self.controls.restart()
        self._worlds.restart()
        self.reconnect.back()
        self._depart()

    def _depart(self) -> None:
        """Asks the transport to close the connection, and sends nothing more over it."""
        self._open = False
        self._out.clear()
        self.close_request = (1000, "")

    def _cut_off(self, left: Left, now: float) -> None:
        """Starts to reconnect after a lost connection, or ends if the client may not reconnect."""
        self._open, self._worlds.filled, self.handover, self.second = False, None, None, None
        self._out.clear()
        self.travel.elsewhere(self.reconnect.spread)
        wait = max(left.wait_s, 0.0)
        if not self._resume or not self.reconnect.lost(now, wait, elsewhere=self.travel.fresh):
            self._end(left)
            return
        self.state = "reconnecting"
        self._events.append(Disconnected(left.reason, self.reconnect.retry_at - now))

    def _send(self, message: messages.Message) -> None:
        self._out.append(encode(message))

    def _fail(self, code: int, reason: str) -> None:
        self.close_request = (code, reason[:100])
        self._end(Left(code, reason))

    def _end(self, left: Left) -> None:
        if self.state != "closed":
            self.state = "closed"
            self._open, self.handover, self.second = False, None, None
            if self._worlds.play:
                self._game_events.release()
            self._events.append(left)
