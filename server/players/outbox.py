"""The game events for one player: sent in order, behind the snapshot that has what they speak of, or counted.

Theory of operation. An event is queued in the tick in which the rules send it. It goes once the player's client has
been sent all that was in its sight at the end of that tick, so an entity that the event names is known by then. The
queue belongs to the player and outlasts a connection: events of the time without a connection go after the return. It
is bounded; beyond that the oldest events are dropped. Both sides count the events from the player's first on, and
`NextHappened` has the number of the next one. It is sent wherever the client may expect another number: after a drop,
and after a lost connection, with which events on their way may be lost. The client computes from it how many it missed.
"""

from collections import deque

from shared.messages import NextHappened, encode


class Outbox:
    """The events that wait to be sent to one player."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._next = 0
        """The number of the first event that waits."""
        self._unsure = False
        """Whether the client may expect another number than the next one."""

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def due(self) -> bool:
        """Whether there is anything to send, or will be."""
        return self._unsure or bool(self._waiting)

    def add(self, tick: int, message: bytes, most: int) -> bool:
        """Queues an event.

        Args:
            tick: in which the rules sent it.
            message: encoded already.
            most: events that may wait; of more, the oldest one is dropped.

        Returns:
            Whether one was dropped.
        """
        self._waiting.append((tick, message))
        full = len(self._waiting) > most
        if full:
            self._waiting.popleft()
            self._next += 1
            self._unsure = True
        return full

    def reconnect(self) -> None:
        """Notes that the player goes on over another connection: what was on its way may be lost."""
        self._unsure = True

    def take(self, known: int, room: int) -> list[bytes]:
        """Takes the messages that are to be sent now.

        Args:
            known: the client has been sent all that was in its sight up to this tick.
            room: bytes of events to send, about; one event always goes.
        """
        messages = []
        if self._unsure:
            self._unsure = False
            messages.append(encode(NextHappened(self._next)))
        while self._waiting and self._waiting[0][0] <= known:
            messages.append(self._waiting.popleft()[1])
            self._next += 1
            room -= len(messages[-1])
            if room <= 0:
                break
        return messages
