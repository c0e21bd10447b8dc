"""A client without its socket: bytes and times in, bytes, events and a picture out.

    joining   hello and pings are out; the welcome, the terrain around the player and the server's time come in
    playing   every tick: step the predicted world with the wish, send the wish; every snapshot: reconcile
    away      the connection is lost: prediction goes on for a while; once there is another one, the world is fetched
              anew beside it, what was not acknowledged is sent again, and the new world takes the place of the old
    closed    it is over

`now` is always float seconds of any one monotonic clock.
"""

import copy
import math
import struct
from collections import deque
from typing import Any

import numpy as np

from client_sdk.advice import advised
from client_sdk.clock import LeadController, PricedLead, ServerClock, Timeline
from client_sdk.comeback import Comeback
from client_sdk.events import (
    Disconnected,
    Diverged,
    Event,
    Happened,
    Joined,
    Left,
    Resumed,
    Resynchronised,
    SegmentLoaded,
)
from client_sdk.orders import Orders
from client_sdk.picture import NOTHING, Picture, View
from client_sdk.prediction import NONDETERMINISM, Prediction, check_scene
from client_sdk.replica import Replica
from client_sdk.stats import Stats
from shared import edits, messages
from shared.inputs import NEUTRAL, Input, clamp
from shared.messages import (
    IDLE,
    MARGIN_ONE,
    MARGIN_REFUSED,
    NEUTRALISED,
    REPEATED,
    Bye,
    Command,
    Hello,
    Inputs,
    Ping,
    Pong,
    ProtocolError,
    Resync,
    Snapshot,
    Terrain,
    Welcome,
    decode_from_server,
    encode,
)
from shared.ring import Ring
from shared.scene import Scene
from shared.snapshot import VERDICT

TICKS_PER_UPDATE_MAX = 16
"""A program that was away for longer does not catch up tick by tick: it begins anew. No message has more inputs."""
UNCONFIRMED_MAX = 96
"""So many ticks beyond the newest snapshot, prediction waits."""
INPUT_DELAY_MAX = 3
CLOCK_S = 1.0
"""A server whose time is this far from what it was believed to be is not the same one any more, or was away."""
COME_AGAIN = (messages.TOO_SLOW, messages.GOING_AWAY, messages.NO_HELLO)
"""The connection was at fault, not the player."""
EVENTS_MAX = 1000
READ_BYTES = 64 * 1024


class Core:
    """The client as a state machine.

    Args:
        name: shown to others.
        scene: the scene this program was built for, checked by the server; None: the server's is taken.
        token: proves who this is, where the server asks for it.
        patience_s: for so long it tries to come back after a lost connection; 0: that is the end.
        compiled: run the physics compiled by Numba; None: where it is installed.
        neighbours: predict blocking others, too (see `Prediction`).
        lead: decides how far to live ahead of the server.
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
        lead: LeadController | None = None,
    ) -> None:
        self.name = name
        self.scene = scene
        self.entity = 0
        self.state = "joining"
        self.close_request: tuple[int, str] | None = None
        """The code and reason with which the connection should be closed now, if any."""
        self.stats = Stats()
        self.clock = ServerClock()
        self.prediction: Prediction | None = None
        self.timeline: Timeline | None = None
        self.comeback = Comeback(patience_s)
        self._token = token
        self._resume = b""
        self._filled: Replica | None = None
        """What the server's messages go into: after a return not yet what is played in."""
        self._orders = Orders()
        self._told = -1
        """The newest tick that the server has an input for."""
        self._compiled = compiled
        self._lead = lead or PricedLead()
        self._new_lead = copy.deepcopy(self._lead)
        self.wish = NEUTRAL
        self._out: list[bytes] = []
        self._events: deque[Event] = deque(maxlen=EVENTS_MAX)
        self._phases: Ring[float] = Ring(256)
        self._pings: deque[float] = deque(maxlen=16)
        self._seen = 0.0  # of the last view; of the last update, where nothing is drawn
        self._draws = False
        self._newest = -1
        self.picture: Picture | None = None
        self.shared: dict[str, Any] = {}
        """The values that the game shares with all clients."""
        self._neighbours = neighbours
        self._delay = 0
        self._late = False
        self._wrong = ""
        self._open = False

    @property
    def appetite(self) -> int:
        """So many bytes should be read of the connection at once."""
        return READ_BYTES

    # -- what comes in -------------------------------------------------------------------------------------

    def open(self, now: float) -> None:
        """The connection is there: says hello."""
        self._open = True
        self._out.clear()
        digests = self.scene.digests if self.scene else {}
        self._send(Hello(messages.VERSION, digests, self.name[: messages.NAME_MAX], self._token, self._resume))

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
        tick = self._joined("command").predicted.tick + self._delay + 1
        return self._order(self._orders.command(tick, self._seen, name, data))

    def edit(self, x: int, y: int, z: int, kind: int) -> int:
        """Places (kind 1 to 255) or removes (0) a block with the next tick; the number by which it is `Answered`.

        Raises:
            RuntimeError: the client has not joined.
        """
        prediction, edit = self._joined("edit"), edits.Edit(x, y, z, kind)
        number = self._orders.number()
        tick = prediction.edit(number, edit)
        return self._order(Command(number, tick, self._seen, edits.NAME, edits.pack(edit)))

    def close(self) -> None:
        """Says goodbye."""
        if self.state != "closed":
            if self._open:
                self._send(Bye(messages.GOING_AWAY, "", -1.0))
            self.close_request = (1000, "")
            self._end(Left(1000, "closed by this client"))

    def set_input(self, wish: Input) -> None:
        """What the player wishes from the next tick on, until told otherwise."""
        self.wish = clamp(wish)

    # -- time ----------------------------------------------------------------------------------------------

    def update(self, now: float) -> None:
        """Sends pings that are due, and predicts every tick whose time has come."""
        if self._open and self._told_clock.due(now):
            self._send(Ping(now, self.stats.corrections))
            self._pings.append(now)
        if self.state == "joining":
            self._try_to_join(now)
        elif self.state == "away" and self._filled:
            self._try_to_come_back(self._filled, now)
        if self.state not in ("playing", "away"):
            return
        assert self.timeline is not None
        assert self.picture is not None
        self.stats.measure(now)
        if self.state == "playing":
            self._reconcile(now)
            shown = self.picture.advance(self.clock, now)
            if not self._draws:
                self._seen = shown
        self._predict(math.floor(self.timeline.tick(now)), now)
        if self.prediction is not None:
            self.stats.snapshot_age_s = (
                max(self.clock.tick(now) - self.prediction.confirmed.tick, 0.0) / self.clock.rate
            )
        # Steered only now: a tick that was due, and for which the program woke up, is not put off by a moment.
        if self.state == "playing" and self.timeline.steer(self._lead, self.clock, now):
            self._restart(now)

    def next_update(self, now: float) -> float:
        """The local time at which `update` has something to do."""
        due = self._told_clock.next_ping if self._open else self.comeback.retry_at
        prediction = self.prediction
        if self.timeline and prediction and self._newest < prediction.confirmed.tick + UNCONFIRMED_MAX:
            due = min(due, self.timeline.when(self._newest + 1))
        return max(due, now)  # inf: only once something has come in

    # -- what goes out -------------------------------------------------------------------------------------

    def outgoing(self) -> list[bytes]:
        """The messages to send since the last call."""
        out, self._out = self._out, []
        self.stats.bytes_up += sum(map(len, out))
        return out

    def events(self) -> list[Event]:
        """What has happened since the last call."""
        events = list(self._events)
        self._events.clear()
        return events

    def view(self, now: float) -> View:
        """What to draw now: the own entity predicted, the others as they were a moment ago."""
        if self.picture is None or self.timeline is None:
            return NOTHING
        view = self.picture.view(self.timeline, self.clock, now)
        self._draws, self._seen = True, view.seen
        return view

    # -- inside --------------------------------------------------------------------------------------------

    @property
    def _told_clock(self) -> ServerClock:
        """That of the server whose messages come now; after a return not yet the one that is played by."""
        return self._filled.clock if self._filled else self.clock

    def _take(self, message: messages.Message, now: float) -> None:
        match message:
            case Snapshot():
                self._snapshot(message, now)
            case Pong():
                if message.sent in self._pings:  # anything else is no answer to a ping of ours
                    self._pings.remove(message.sent)
                    self._told_clock.answered(message.sent, message.tick, now)
            case Terrain():
                self._terrain(message)
            case Welcome():
                self._welcome(message, now)
            case messages.Happened():
                data = messages.unpack_value(message.payload)
                self._events.append(Happened(message.tick, message.name, data))
            case messages.Shared():
                self.shared = message.values
            case Bye():
                left = Left(message.code, advised(message.code, message.reason), message.wait)
                if self.state in ("playing", "away") and (message.wait >= 0 or message.code in COME_AGAIN):
                    self._cut_off(left, now)
                else:
                    self._end(left)
            case _:
                raise ProtocolError(f"{type(message).__name__} from a server")

    def _welcome(self, welcome: Welcome, now: float) -> None:
        if self._filled or (self.entity and self.state != "away"):
            raise ProtocolError("a second Welcome")
        scene = check_scene(welcome.scene)
        if self.scene is not None and scene.digests != self.scene.digests:
            raise ProtocolError("Welcome.scene: not the scene that was asked for")
        self.scene, self._resume, self._told = scene, welcome.resume, -1
        self.comeback.spread = welcome.entity
        clock = self.clock
        if clock.rate == 0 or abs(clock.tick(now) - welcome.tick) > CLOCK_S * scene.tick_rate:
            clock = ServerClock()
            clock.rate = float(scene.tick_rate)
        prediction = Prediction(scene, welcome.entity, neighbours=self._neighbours, compiled=self._compiled)
        self._filled = Replica(scene, prediction, clock)
        if self.state == "joining":
            self._play_in(self._filled)
        elif welcome.entity == self.entity:
            self._out += self._orders.again()
        else:
            self._events += self._orders.give_up()

    def _play_in(self, filled: Replica) -> None:
        self.prediction, self.picture, self.clock = filled.prediction, filled.picture, filled.clock
        self.entity = filled.prediction.entity

    def _terrain(self, terrain: Terrain) -> None:
        if self._filled is None:
            raise ProtocolError("Terrain before Welcome")
        segment = self._filled.terrain(terrain)
        if segment is not None:
            self._events.append(SegmentLoaded(segment))

    def _snapshot(self, snapshot: Snapshot, now: float) -> None:
        if self._filled is None:
            raise ProtocolError("Snapshot before Welcome")
        self.stats.snapshots_skipped += self._filled.skipped(snapshot)
        self.stats.snapshots += 1
        self._told = max(self._told, snapshot.newest)
        self._late |= self._fates(snapshot, now)
        for number, verdict in np.frombuffer(snapshot.verdicts, VERDICT).tolist() if snapshot.verdicts else ():
            answered = self._orders.answer(number, verdict)
            if answered is not None:
                if self.prediction is not None:
                    self.prediction.settle(number, answered.done)
                self._events.append(answered)
        self._wrong = self._filled.apply(snapshot) or self._wrong

    def _reconcile(self, now: float) -> None:
        """Compares the prediction with the newest snapshot: once per update, however many have come."""
        prediction, picture = self.prediction, self.picture
        assert prediction is not None
        assert picture is not None
        done = prediction.reconcile(self._late)
        self._late = False
        self.stats.replayed_ticks += done.replayed
        self.stats.repredictions += done.repredicted
        picture.smooth(done, now)
        if done.correction:
            self.stats.corrected(done.correction)
            self._events.append(done.correction)
            if done.correction.cause == NONDETERMINISM:
                self._wrong = f"own {', '.join(done.correction.fields)}"
        if self._wrong:
            self.stats.divergences += 1
            self._events.append(Diverged(prediction.confirmed.tick, self._wrong))
            self._wrong = ""
            self._send(Resync())

    def _fates(self, snapshot: Snapshot, now: float) -> bool:
        """How the inputs up to `newest` fared: feeds the lead; whether any of the told ticks lacked its input."""
        margins = struct.unpack(f"<{len(snapshot.margins) // 2}h", snapshot.margins)
        for tick, margin in enumerate(margins, snapshot.newest + 1 - len(margins)):
            phase = self._phases.get(tick)
            if phase is None:
                continue  # a tick that was left out
            self.stats.inputs_refused += margin == MARGIN_REFUSED
            self.stats.inputs_late += MARGIN_REFUSED < margin < 0
            if margin != MARGIN_REFUSED:
                self._lead.observe(tick, margin / MARGIN_ONE, phase, now)
        neutralised = snapshot.fates.count(NEUTRALISED)
        missing = snapshot.fates.count(REPEATED) + neutralised
        if IDLE in snapshot.fates:  # the very first ones came late: until then nothing stood in for them
            ticks = enumerate(snapshot.fates, snapshot.first)
            missing += sum(fate == IDLE and self._phases.get(tick) is not None for tick, fate in ticks)
        self.stats.inputs_substituted += missing
        self.stats.inputs_neutralised += neutralised
        return missing > 0

    def _try_to_join(self, now: float) -> None:
        """Begins to play once enough is known."""
        filled = self._filled
        if filled is None or not filled.complete:
            return
        assert self.scene is not None
        clock = self.clock
        self.timeline = Timeline(clock.rate, self._lead.start(clock, now), now)
        self._restart(now)
        self.state = "playing"
        self._events.append(Joined(self.entity, self.scene, filled.prediction.predicted.tick))

    def _try_to_come_back(self, filled: Replica, now: float) -> None:
        """Goes on in the new copy of the world once as much is known of it as for joining."""
        if not filled.complete:
            return
        prediction, clock = filled.prediction, filled.clock
        assert self.scene is not None
        assert self.prediction is not None
        same = prediction.entity == self.entity
        if same:
            prediction.adopt(self.prediction)
        if self.timeline is None or clock is not self.clock:
            self._newest = -1
            self._phases = Ring(256)
            self._lead = copy.deepcopy(self._new_lead)
            self.timeline = Timeline(clock.rate, self._lead.start(clock, now), now)
        self._play_in(filled)
        self._restart(now)
        self.state = "playing"
        self.stats.reconnects += 1
        tick = prediction.predicted.tick
        back = Resumed(tick, self.comeback.away_s(now)) if same else Joined(self.entity, self.scene, tick)
        self._events.append(back)
        self.comeback.back()
        since = max(self._told, prediction.confirmed.tick, self._newest - messages.INPUT_ROWS_MAX)
        for first in range(since, self._newest if same else since, TICKS_PER_UPDATE_MAX):
            rows = prediction.rows_since(first, min(first + TICKS_PER_UPDATE_MAX, self._newest))
            self._send(Inputs(first + 1, prediction.confirmed.tick, rows))

    def _cut_off(self, left: Left, now: float) -> None:
        """The connection is gone, and there may be another one."""
        self._open, self._filled = False, None
        self._out.clear()
        wait = max(left.wait, 0.0)
        if not self._resume or not self.comeback.lost(now, wait):
            self._end(left)
            return
        self.state = "away"
        self._events.append(Disconnected(left.reason, self.comeback.retry_at - now))

    def _joined(self, what: str) -> Prediction:
        if self.state not in ("playing", "away"):
            raise RuntimeError(f"{what}: the client has not joined")
        assert self.prediction is not None
        return self.prediction

    def _order(self, command: Command) -> int:
        """Sends it, now or with the next connection; its number."""
        message = self._orders.file(command)
        if self._open:
            self._out.append(message)
        return command.number

    def set_input_delay(self, ticks: int) -> None:
        """Shows the effect of inputs so many ticks (0 to 3) later than they are sent: fewer and shorter replays.

        Raises:
            ValueError: not 0 to 3.
        """
        if not 0 <= ticks <= INPUT_DELAY_MAX:
            raise ValueError(f"ticks = {ticks!r}: must be 0 to {INPUT_DELAY_MAX}")
        self._delay = ticks
        if self.prediction is not None:
            self.prediction.ahead = ticks

    def _restart(self, now: float) -> None:
        """Begins the prediction at the timeline's tick."""
        assert self.timeline is not None
        assert self.prediction is not None
        tick = max(math.floor(self.timeline.tick(now)), self.prediction.confirmed.tick, self._newest)
        if self.prediction.begun:
            self.stats.resyncs += 1
            self._events.append(Resynchronised(tick, tick - self._newest))
        self._newest = tick
        self.prediction.ahead = self._delay
        self.prediction.begin(max(tick - self._delay, self.prediction.confirmed.tick))

    def _predict(self, to: int, now: float) -> None:
        """Files and sends the wish for every tick up to `to`, and predicts up to there but for the input delay."""
        prediction, timeline = self.prediction, self.timeline
        assert prediction is not None
        assert timeline is not None
        if to - self._newest > TICKS_PER_UPDATE_MAX:
            if to - prediction.confirmed.tick <= UNCONFIRMED_MAX:
                self._restart(now)
            return
        to = min(to, prediction.confirmed.tick + UNCONFIRMED_MAX)
        self._newest = max(self._newest, prediction.confirmed.tick)  # an input for the past would only be late
        if to > self._newest:
            first = self._newest + 1
            for tick in range(first, to + 1):
                prediction.file(tick, self.wish)
                self._phases.put(tick, timeline.phase)
            self._newest = to
            self.stats.inputs_sent += to + 1 - first
            self.stats.rtt_s = self.clock.rtt_s
            self.stats.lead_ticks = timeline.phase - self.clock.phase
            self.stats.lead_s = self.stats.lead_ticks / self.clock.rate
            row = bytes(part & 0xFF for part in self.wish)
            if self.state == "playing":
                self._send(Inputs(first, prediction.confirmed.tick, row * (to + 1 - first)))
        while prediction.predicted.tick < self._newest - self._delay:
            prediction.step()

    def _send(self, message: messages.Message) -> None:
        self._out.append(encode(message))

    def _fail(self, code: int, reason: str) -> None:
        self.close_request = (code, reason[:100])
        self._end(Left(code, reason))

    def _end(self, left: Left) -> None:
        if self.state != "closed":
            self.state = "closed"
            self._events.append(left)
