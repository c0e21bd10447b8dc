"""A hand-over: the client changes to another server of the same world without a pause.

Theory of operation. A server asks for it by `HandOver`. The client opens a second connection beside the first. Its
messages fill a second replica, while the client plays on over the first connection. Once the replica is complete, the
client sends its inputs over both, and learns from both how early they have to be. The server takes them from the second
as soon as they arrive there in time, and reports input statuses over it from that tick on. The first such snapshot ends
the hand-over: the client goes on in the second replica, and closes the first connection. Messages of the second
connection that are for the program wait until then.
"""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

from client_sdk.replica import Replica
from client_sdk.worlds import Worlds
from shared import messages
from shared.messages import Beside, HandOver, Held, Inputs, Message, ProtocolError, Snapshot, Terrain, Welcome, encode

HANDOVER_S = 15.0
"""Time after which a client gives up a hand-over, in seconds."""


class Handover:
    """The second connection of a client.

    Args:
        worlds: the worlds of the client, which plays.
        asked: the server's message.
        first: the first message over the second connection.
        now: local time in seconds.
    """

    def __init__(self, worlds: Worlds, asked: HandOver, first: Beside, now: float) -> None:
        self._worlds = worlds
        self._out: list[bytes] = [encode(first)]
        self.address, self.reason = asked
        self.until = now + HANDOVER_S
        """Local time at which the client gives up, in seconds."""
        self.replica: Replica | None = None
        """The replica that the second connection fills."""
        self._copies = False
        """Whether inputs and commands are sent over the second connection, too."""
        self.failed = False
        """Whether the second connection is of no use."""
        self.waiting: list[Message] = []
        """Messages for the program, in order, and the snapshot that ends the hand-over."""
        self.got: Counter[Message] = Counter()
        """Game events that have come over the first connection meanwhile; they come over the second one, too."""
        self.alone = False
        """Whether the server has ended the first connection."""
        self.complete = False
        """Whether the hand-over is complete: the program goes on in `replica`."""

    def receive(self, message: Message, now: float) -> None:
        """Takes one message of the second connection.

        Raises:
            ProtocolError: the message is malformed or unexpected.
            BehaviourError: the scene needs behaviours that this program does not have.
        """
        match message:
            case Welcome() if self.replica is None:
                replica = self._worlds.replica(message, now)
                play = self._worlds.play
                same = play is not None and play.world.prediction.entity == message.entity
                self.failed = not same or replica.clock is not self._worlds.clock
                self.replica = replica
            case Snapshot() if self.replica is not None:
                if message.statuses and self.replica.complete:
                    self.complete = True
                    self.waiting.append(message)
                else:
                    self.replica.skipped(message)
                    self.replica.apply(message)
                    if self._worlds.play is not None:
                        self._worlds.play.prepare(message, now)
            case Terrain() if self.replica is not None:
                self.replica.terrain(message)
            case messages.Bye():
                self.failed = True
            case Welcome() | Snapshot() | Terrain():
                raise ProtocolError(f"unexpected {type(message).__name__} message over a second connection")
            case _:
                self.waiting.append(message)

    def copy(self, message: Any, acked: int, commands: Callable[[], list[bytes]]) -> None:
        """Sends a message of the input loop over the second connection, too, once its replica is complete.

        It goes on even if the terrain of another segment is missing for a while: the server expects every tick.

        Args:
            message: the message.
            acked: tick of the newest snapshot over the first connection.
            commands: returns the commands without a result, which are sent ahead of the first message.
        """
        if self.replica is None:
            return
        if not self._copies:
            if not self.replica.complete:
                return
            self._copies = True
            self._out += commands()
            if not isinstance(message, Inputs) and self._worlds.play is not None:
                self._worlds.play.begin_copies()
            if isinstance(message, Held):
                return  # the input that it means has not come over this connection
        if isinstance(message, Inputs):
            message = message._replace(acked=self.replica.confirmed.world.tick)
        elif isinstance(message, Held):
            message = message._replace(behind=max(message.behind + acked - self.replica.confirmed.world.tick, 0))
        self._out.append(encode(message))

    def copy_command(self, message: bytes) -> None:
        """Sends a command over the second connection, too: a command that comes late there is carried out late."""
        if self._copies:
            self._out.append(message)

    def outgoing(self) -> list[bytes]:
        """Returns the messages to send over the second connection, and forgets them."""
        out, self._out = self._out, []
        return out


class Changes(Protocol):
    """The side of a core that a second connection talks to."""

    handover: Handover | None

    @property
    def appetite(self) -> int:
        """The number of bytes that the transport should read at once."""
        ...

    def receive(self, data: bytes, now: float) -> None:
        """Takes one message of the connection."""

    def lost(self, code: int, reason: str, now: float) -> None:
        """Takes the loss of the connection."""

    def outgoing(self) -> list[bytes]:
        """Returns the messages to send, and forgets them."""
        ...

    def receive_beside(self, data: bytes, now: float) -> None:
        """Takes one message of the second connection."""

    def lost_beside(self, now: float) -> None:
        """Takes the end of the second connection."""


class SecondPort:
    """The port of a second connection. Once it has taken the place of the first, it passes all on to the core.

    Args:
        core: the core.
        handover: the hand-over.
    """

    connected = False
    """Whether there was a connection before the port began."""
    state = "playing"
    """State for a simulated link."""

    def __init__(self, core: Changes, handover: Handover) -> None:
        self._core, self._handover = core, handover

    @property
    def appetite(self) -> int:
        return self._core.appetite

    def open(self, now: float) -> None:
        pass

    def receive(self, data: bytes, now: float) -> None:
        if self._handover.complete:
            self._core.receive(data, now)
        elif self._core.handover is self._handover:
            self._core.receive_beside(data, now)

    def lost(self, code: int, reason: str, now: float) -> None:
        if self._handover.complete:
            self._core.lost(code, reason, now)
        elif self._core.handover is self._handover:
            self._core.lost_beside(now)

    def update(self, now: float) -> None:
        pass

    def next_update(self, now: float) -> float:
        return math.inf

    def outgoing(self) -> list[bytes]:
        return self._core.outgoing() if self._handover.complete else self._handover.outgoing()

    def outstanding(self) -> int:
        return 0
