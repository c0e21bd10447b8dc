"""A hand-over: the client changes to another process of the same world without a pause.

Theory of operation. The client opens a second connection beside the first. Its messages fill a second replica, while
the client plays on over the first connection. Once the replica is complete, the client sends its inputs over both, and
learns from both how early they have to be. The server takes them from the second as soon as they arrive there in time,
and reports input statuses over it from that tick on. The first such snapshot ends the hand-over: the client goes on in
the second replica, and closes the first connection. Messages of the second connection that are for the program wait
until then.
"""

from collections import Counter
from typing import Any

from client_sdk.replica import Replica
from client_sdk.worlds import Worlds
from shared import messages
from shared.messages import Inputs, Message, ProtocolError, Snapshot, Terrain, Welcome, encode


class Handover:
    """The second connection of a client.

    Args:
        worlds: the worlds of the client, which plays.
        hello: the first message over the second connection.
    """

    def __init__(self, worlds: Worlds, hello: messages.Hello) -> None:
        self._worlds = worlds
        self._out: list[bytes] = [encode(hello)]
        self.replica: Replica | None = None
        """The replica that the second connection fills."""
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

    def copy(self, message: Any) -> None:
        """Sends a message of the input loop over the second connection, too, if its replica is complete."""
        if self.replica is None or not self.replica.complete:
            return
        if isinstance(message, Inputs):
            message = message._replace(acked=self.replica.confirmed.world.tick)
        self._out.append(encode(message))

    def outgoing(self) -> list[bytes]:
        """Returns the messages to send over the second connection, and forgets them."""
        out, self._out = self._out, []
        return out
