"""The side of a core that changes to another server of its world (`client_sdk.handover`)."""

import math
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, cast

from client_sdk.events import HandedOver, Left
from client_sdk.handover import Handover, SecondPort
from client_sdk.pending_events import GameEvents
from client_sdk.port import Port
from client_sdk.program_side import ProgramSide
from client_sdk.travel import Travel
from shared import messages
from shared.behaviours import Behaviour, BehaviourError
from shared.messages import Beside, HandOver, Message, ProtocolError, decode_from_server
from shared.scene import Scene

if TYPE_CHECKING:
    from client_sdk.core import Core
    from client_sdk.netsim.linked import LinkedPort

TAKEN_OVER_S = 5.0
"""Seconds after the loss of a second connection in which "taken over" means that it had taken over, and not another
program."""


class Changing(ProgramSide):
    """A part of `client_sdk.core.Core`, which explains the arguments."""

    _token: str
    _resume: bytes

    def __init__(
        self,
        scene: Scene | None,
        behaviours: Iterable[type[Behaviour]],
        *,
        compiled: bool | None,
        neighbours: bool,
    ) -> None:
        super().__init__(scene, behaviours, compiled=compiled, neighbours=neighbours)
        self.port: Port = self  # type: ignore[assignment]
        """The object that a transport talks to; `client_sdk.netsim.linked` puts a simulated link in front."""
        self.travel = Travel()
        self.handover: Handover | None = None
        """The hand-over, while the client changes to another server of the world; None: it does not."""
        self.second: Port | None = None
        """The port of the second connection, while there is a hand-over. The transport opens the connection to
        `handover.address`. When this is None again, the hand-over is over: if it is `complete`, the second connection
        has taken the place of the first, which the transport closes without a word; if not, it closes the second."""
        self._twice: Counter[Message] = Counter()
        """Game events that have come over the connection before a hand-over, and may come over this one, too."""
        self._beside_lost = -math.inf
        """Local time at which the latest second connection was lost, in seconds."""
        self._game_events = GameEvents(self._events)

    def receive_beside(self, data: bytes, now: float) -> None:
        """Takes one message of the second connection. A malformed message ends the hand-over."""
        handover = self.handover
        if handover is None:
            return
        self.stats.bytes_down += len(data)
        try:
            handover.receive(decode_from_server(data), now)
        except (ProtocolError, BehaviourError):
            handover.failed = True
        if handover.failed:
            self.lost_beside(now)
        elif handover.complete:
            self._change_over(handover, now)

    def lost_beside(self, now: float) -> None:
        """Takes the end of the second connection. The client goes on over the first, if there is one."""
        handover, self.handover, self.second = self.handover, None, None
        self._beside_lost = now
        if handover is not None and handover.alone:
            self._cut_off(Left(messages.TAKEN_OVER, "the second connection was lost", 0.0), now)

    def _begin_handover(self, asked: HandOver, now: float) -> None:
        """Begins a change to another server, unless the client does not play or is changing already."""
        if self.state != "playing" or self.handover is not None:
            return
        first = Beside(messages.VERSION, self._token, self._resume)
        self.handover = Handover(self._worlds, asked, first, now)
        self.second = SecondPort(cast("Core", self), self.handover)
        if self.port is not cast("Core", self):
            self.second = cast("LinkedPort", self.port).beside(self.second)

    def _update_second(self, now: float) -> None:
        """Does what is due over the second connection."""
        if self.second is not None:
            self.second.update(now)
        if self.handover is not None and now > self.handover.until:
            self.lost_beside(now)

    def _copy(self, message: Message) -> None:
        """Sends a message of the input loop over the second connection, too."""
        if self.handover is not None:
            play = self._worlds.play
            acked = -1 if play is None else play.world.prediction.confirmed.tick
            self.handover.copy(message, acked, self._commands.again)

    def _order(self, command: messages.Command) -> int:
        number = super()._order(command)
        if self.handover is not None:
            self.handover.copy_command(self._commands.file(command))
        return number

    def _change_over(self, handover: Handover, now: float) -> None:
        """Goes on over the second connection."""
        assert handover.replica is not None
        if self.port is not cast("Core", self):
            self.port = cast("LinkedPort", self.second).taken_by(cast("Core", self))
        self.handover = self.second = None
        self.travel.server = handover.address
        self._worlds.change_over(handover.replica)
        self._out[:] = self._commands.again()
        self._twice = handover.got
        self._events.append(HandedOver(handover.address, handover.reason))
        for message in handover.waiting:
            if isinstance(message, messages.NextHappened):
                self._game_events.next(message.number, hold=False, sure=True)
            else:
                self._take(message, now)

    def _happened(self, message: messages.Happened | messages.Announce, *, announced: bool) -> None:
        """Takes a game event. One that came over the connection before a hand-over, too, is only counted."""
        if self.handover is not None:
            self.handover.got[message] += 1
        if self._twice[message]:
            self._twice[message] -= 1
            announced = True
        self._game_events.happened(message, hold=self._joins, announced=announced)

    @property
    def _joins(self) -> bool:
        """Whether the client waits for `Joined` or `Resumed` after a welcome."""
        return self._worlds.filled is not None and self.state != "playing"

    def _take(self, message: Message, now: float) -> None:
        raise NotImplementedError

    def _cut_off(self, left: Left, now: float) -> None:
        raise NotImplementedError
