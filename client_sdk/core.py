"""A client without its socket: bytes and times in, bytes, events and a picture out.

    joining   hello and pings are out; the welcome, the terrain around the player and the server's time come in
    playing   every tick: step the predicted world with the wish, send the wish; every snapshot: reconcile (`play`)
    away      the connection is lost: prediction goes on for a while; once there is another one, the world is fetched
              anew beside it, what was not acknowledged is sent again, and the new world takes the place of the old
    closed    it is over

`now` is always float seconds of any one monotonic clock.
"""

import math
from collections import deque
from typing import Any, SupportsIndex

from client_sdk.advice import advised
from client_sdk.clock import ServerClock, Timeline
from client_sdk.comeback import Comeback
from client_sdk.controls import Controls
from client_sdk.events import (
    Disconnected,
    Event,
    EventsDropped,
    Happened,
    Joined,
    Left,
    Resumed,
    SegmentLoaded,
)
from client_sdk.orders import Orders
from client_sdk.pending_events import PendingEvents
from client_sdk.picture import NOTHING, View
from client_sdk.play import RECONNECTED, Play
from client_sdk.prediction import Prediction
from client_sdk.replica import Replica
from client_sdk.stats import Stats
from shared import edits, kernels, messages
from shared.checks import SceneError, duration, shown, text, whole
from shared.inputs import Input, checked_input, clamp
from shared.messages import ProtocolError, decode_from_server, encode
from shared.scene import Scene

INPUT_DELAY_MAX = 3
COME_AGAIN = (messages.TOO_SLOW, messages.GOING_AWAY, messages.NO_HELLO)
"""The connection was at fault, not the player."""
NAME_MAX = 1 << 16
"""The longest name that is taken; what goes beyond `messages.NAME_MAX` characters is not sent."""
READ_BYTES = 64 * 1024


class Core:
    """The client as a state machine.

    Args:
        name: shown to others.
        scene: the scene this program was built for, checked by the server; None: the server's is taken.
        token: proves who this is, where the server asks for it.
        patience_s: for so long it tries to come back after a lost connection; 0: that is the end.
        compiled: run a compiled kernel, or the plain one; None: the one that `shared.kernels` chooses, but the plain
            one while that has to be compiled: no call of a core waits for a compiler.
        neighbours: predict blocking others, too (see `Prediction`).

    Raises:
        ValueError: the name or the token is no text, is too long, or UTF-8 cannot hold it.
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
    ) -> None:
        self.name = text(name, "name", NAME_MAX, shortest=0)
        if scene is not None and not isinstance(scene, Scene):
            raise SceneError(f"scene = {shown(scene)}: must be a `Scene`, or None for the server's")
        self.scene = scene
        self.state = "joining"
        self.close_request: tuple[int, str] | None = None
        """The code and reason with which the connection should be closed now, if any."""
        self.stats = Stats()
        self.comeback = Comeback(duration(patience_s, "patience_s", endless=True))
        self.controls = Controls()
        self.shared: dict[str, Any] = {}
        """The values that the game shares with all clients."""
        self._token = text(token, "token", messages.TOKEN_MAX, shortest=0)
        self._resume = b""
        self._compiled = compiled
        self._plain_for_now = False
        self._neighbours = neighbours
        self._delay = 0
        self._open = False
        self._filled: Replica | None = None
        """What the server's messages go into: after a return not yet what is played in."""
        self._play: Play | None = None
        self._orders = Orders()
        self._out: list[bytes] = []
        self._events = PendingEvents()
        self._held = PendingEvents()
        """What the game has told before the player is in, or back in."""
        self._told = 0
        """Events of the game for this player that have come, or are known to be lost."""
        self._pings: deque[float] = deque(maxlen=16)

    @property
    def prediction(self) -> Prediction | None:
        """The world as it is known and as it is predicted; None before there is a welcome."""
        world = self._world
        return world.prediction if world else None

    @property
    def entity(self) -> int:
        """The own entity; 0 before there is a welcome."""
        world = self._world
        return world.prediction.entity if world else 0

    @property
    def clock(self) -> ServerClock:
        """The server's time."""
        world = self._world
        return world.clock if world else ServerClock()

    @property
    def timeline(self) -> Timeline | None:
        """The own time; None before it has `Joined`."""
        return self._play.timeline if self._play else None

    @property
    def _world(self) -> Replica | None:
        """What is played in, or is going to be."""
        return self._play.world if self._play else self._filled

    @property
    def appetite(self) -> int:
        """So many bytes should be read of the connection at once."""
        return READ_BYTES

    # -- what comes in -------------------------------------------------------------------------------------

    def open(self, now: float) -> None:
        """The connection is there: says hello."""
        if self.state == "closed":
            return
        self._open = True
        self._out.clear()
        digests = self.scene.digests if self.scene else {}
        self._send(messages.Hello(messages.VERSION, digests, self.name[: messages.NAME_MAX], self._token, self._resume))

    def receive(self, data: bytes, now: float) -> None:
        """One message of the server. One that is malformed closes the connection."""
        if self.state == "closed" or not self._open:
            return
        self.stats.bytes_down += len(data)
        try:
            self._take(decode_from_server(data), now)
        except ProtocolError as error:
            self._fail(messages.MALFORMED, f"the server sent something malformed: {error}")

    def lost(self, code: int, reason: str, now: float) -> None:
        """The connection is gone, or could not be made."""
        if self.state in ("playing", "away"):
            if self._open or self.comeback.retry_at == math.inf:  # else a `Bye` has told already
                self._cut_off(Left(code, reason, 0.0), now)
        else:
            self._end(Left(code, reason))

    def command(self, name: str, data: Any = None) -> int:
        """Asks the game's rules for something, with the next tick; the number by which it is `Answered`.

        Raises:
            RuntimeError: the client has not joined.
            ValueError: the name or the data are too long (32 characters, 1,024 bytes), or no MessagePack.
        """
        play = self._joined("command")
        return self._order(self._orders.command(play.world.prediction.next_order, play.seen, name, data))

    def edit(self, x: SupportsIndex, y: SupportsIndex, z: SupportsIndex, kind: SupportsIndex) -> int:
        """Places (kind 1 to 255) or removes (0) a block with the next tick; the number by which it is `Answered`.

        Raises:
            RuntimeError: the client has not joined.
            TypeError: something is not a whole number.
            EditError: it is out of range (a `ValueError`).
        """
        play, edit = self._joined("edit"), edits.checked(x, y, z, kind)
        payload = edits.pack(edit)  # first: what cannot be sent is not predicted
        number = self._orders.number()
        tick = play.world.prediction.edit(number, edit)
        return self._order(messages.Command(number, tick, play.seen, edits.NAME, payload))

    def close(self) -> None:
        """Says goodbye."""
        if self.state != "closed":
            if self._open:
                self._send(messages.Bye(messages.GOING_AWAY, "", -1.0))
            self.close_request = (1000, "")
            self._end(Left(1000, "closed by this client"))

    @property
    def wish(self) -> Input:
        """The input that was set last."""
        return self.controls.held

    def set_input(self, wish: Input) -> None:
        """Sets the player's input from the next tick on. A button that is down for a moment counts in that tick.

        Raises:
            ValueError: it is no `Input`.
        """
        self.controls.set(clamp(checked_input(wish, "wish")))

    def set_input_delay(self, ticks: int) -> None:
        """Shows the effect of inputs so many ticks (0 to 3) later than they are sent: fewer and shorter replays.

        Raises:
            ValueError: not 0 to 3.
        """
        ticks = self._delay = whole(ticks, "ticks", 0, INPUT_DELAY_MAX)
        if self.prediction is not None:
            self.prediction.ahead = ticks

    # -- time ----------------------------------------------------------------------------------------------

    def update(self, now: float) -> None:
        """Sends pings that are due, and predicts every tick whose time has come."""
        if self._plain_for_now and kernels.ready():
            self._speed_up()
        if self._play and self.state != "closed":
            for message in self._play.follow(now, online=self.state == "playing"):
                self._send(message)
        if self._open and self._told_clock.due(now):
            self._send(messages.Ping(now, self.stats.corrections))
            self._pings.append(now)
        if self.state in ("joining", "away") and self._filled and self._filled.complete:
            self._begin(self._filled, now)
        if self._play and self.state != "closed":
            for message in self._play.update(now, self.controls, online=self.state == "playing"):
                self._send(message)
        else:
            self.controls.forget()

    def next_update(self, now: float) -> float:
        """The local time at which `update` has something to do."""
        due = self._told_clock.next_ping if self._open else self.comeback.retry_at
        if self._play:
            due = min(due, self._play.next_tick(now))
        return max(due, now)  # inf: only once something has come in

    # -- what goes out -------------------------------------------------------------------------------------

    def outgoing(self) -> list[bytes]:
        """The messages to send since the last call."""
        if not self._out:
            return []
        out, self._out = self._out, []
        self.stats.bytes_up += sum(map(len, out))
        return out

    def events(self) -> list[Event]:
        """What has happened since the last call."""
        return self._events.take() if self._events else []

    def view(self, now: float) -> View:
        """What to draw now: the own entity predicted, the others as they were a moment ago."""
        return self._play.view(now) if self._play else NOTHING

    # -- inside --------------------------------------------------------------------------------------------

    @property
    def _told_clock(self) -> ServerClock:
        """That of the server whose messages come now; after a return not yet the one that is played by."""
        return self._filled.clock if self._filled else self.clock

    def _take(self, message: messages.Message, now: float) -> None:
        match message:
            case messages.Snapshot():
                self._snapshot(message, now)
            case messages.Pong():
                if message.sent in self._pings:  # anything else is no answer to a ping of ours
                    self._pings.remove(message.sent)
                    self.stats.pinged(max(now - message.sent, 0.0))
                    self._stepped(self._told_clock.answered(message.sent, message.tick, now), now)
                    if self._play:
                        self._play.answered(message.sent)
            case messages.Terrain():
                segment = self._welcomed(message).terrain(message)
                if segment is not None:
                    self._events.append(SegmentLoaded(segment))
            case messages.Welcome():
                self._welcome(message, now)
            case messages.Happened():
                self._told += 1
                data = messages.unpack_value(message.payload)
                self._tell(Happened(message.tick, message.name, data))
            case messages.NextHappened():
                if message.number > self._told:
                    self._tell(EventsDropped(message.number - self._told))
                self._told = message.number
            case messages.Shared():
                self.shared = message.values
            case messages.Bye():
                left = Left(message.code, advised(message.code, message.reason), message.wait)
                if self.state in ("playing", "away") and (message.wait >= 0 or message.code in COME_AGAIN):
                    self._cut_off(left, now)
                else:
                    self._end(left)
            case _:
                raise ProtocolError(f"{type(message).__name__} from a server")

    def _welcome(self, welcome: messages.Welcome, now: float) -> None:
        if self._filled:
            raise ProtocolError("a second Welcome")
        self._plain_for_now = self._compiled is None and not kernels.ready()
        compiled = False if self._plain_for_now else self._compiled
        world = Replica(welcome, self.clock, now, neighbours=self._neighbours, compiled=compiled)
        self.stats.kernel = "plain for now" if self._plain_for_now else world.known.world.kernel.form
        if self.scene is not None and world.scene.digests != self.scene.digests:
            raise ProtocolError("Welcome.scene: not the scene that was asked for")
        self.scene, self._resume = world.scene, welcome.resume
        self.comeback.spread = welcome.entity
        if self._play and welcome.entity == self.entity:
            self._out += self._orders.again()
        elif self._play:
            for answered in self._orders.give_up():
                self._events.append(answered)
            self._release()
            self._told = 0
        self._filled = world

    def _speed_up(self) -> None:
        """Goes on with the chosen kernel, which is there now."""
        self._plain_for_now = False
        kernel = kernels.get()
        if self._filled is not None:
            self._filled.use(kernel)
        if self._play is not None and self._play.world is not self._filled:
            self._play.world.use(kernel)
        self.stats.kernel = kernel.form

    def _welcomed(self, message: messages.Message) -> Replica:
        if self._filled is None:
            raise ProtocolError(f"{type(message).__name__} before Welcome")
        return self._filled

    def _snapshot(self, snapshot: messages.Snapshot, now: float) -> None:
        world, play, stats = self._welcomed(snapshot), self._play, self.stats
        stats.snapshots_skipped += world.skipped(snapshot)
        stats.snapshots += 1
        if play:
            play.learn(snapshot, now)
        for answered in self._orders.answer(snapshot.verdicts):
            if play:
                play.world.prediction.settle(answered.number, answered.done)
            self._events.append(answered)
        world.apply(snapshot)
        self._stepped(world.clock.seen(snapshot.tick, now), now)

    def _stepped(self, ticks: float, now: float) -> None:
        """Follows a step of the time by which the server's messages go; 0: there was none."""
        if not ticks:
            return
        self._pings.clear()  # their answers are about the time before
        play = self._play
        if play and play.world.clock is self._told_clock:
            play.stepped(ticks, now)

    def _begin(self, world: Replica, now: float) -> None:
        """As much is known of the world as it takes to play in it: for the first time, or again."""
        old = self._play
        same = old is not None and world.take_over(old.world)
        if old is None or old.world.clock is not world.clock:
            play = self._play = Play(world, self.stats, self._events, now)
        else:
            play = old
            play.world = world
        world.prediction.ahead = self._delay
        play.restart(now, RECONNECTED)
        self.state = "playing"
        self.stats.reconnects += old is not None
        tick, away_s = world.prediction.predicted.tick, self.comeback.away_s(now)
        self._events.append(Resumed(tick, away_s) if same else Joined(self.entity, world.scene, tick))
        self._release()
        self.comeback.back()
        for inputs in play.unheard() if same else ():
            self._send(inputs)

    def _tell(self, event: Event) -> None:
        """Hands out what the game tells, behind the `Joined` or `Resumed` that is still to come after a welcome."""
        (self._held if self._filled and self.state != "playing" else self._events).append(event)

    def _release(self) -> None:
        for event in self._held.take():
            self._events.append(event)

    def _cut_off(self, left: Left, now: float) -> None:
        """The connection is gone, and there may be another one."""
        self._open, self._filled = False, None
        self._out.clear()
        wait = max(left.wait_s, 0.0)
        if not self._resume or not self.comeback.lost(now, wait):
            self._end(left)
            return
        self.state = "away"
        self._events.append(Disconnected(left.reason, self.comeback.retry_at - now))

    def _joined(self, what: str) -> Play:
        if self._play is None or self.state == "closed":
            raise RuntimeError(f"{what}: the client has not joined")
        return self._play

    def _order(self, command: messages.Command) -> int:
        """Sends it, now or with the next connection; its number."""
        message = self._orders.file(command)
        if self._open:
            self._out.append(message)
        return command.number

    def _send(self, message: messages.Message) -> None:
        self._out.append(encode(message))

    def _fail(self, code: int, reason: str) -> None:
        self.close_request = (code, reason[:100])
        self._end(Left(code, reason))

    def _end(self, left: Left) -> None:
        if self.state != "closed":
            self.state = "closed"
            self._open = False
            if self._play:
                self._release()
            self._events.append(left)
