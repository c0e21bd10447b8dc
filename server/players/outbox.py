"""The outbox: the game events that wait to be sent to one player, in order.

Theory of operation. An event is queued in the tick in which the rules send it. It is sent once the client has been sent
everything that was in its view at the end of that tick. So the client knows an entity that the event names. The queue
belongs to the player and outlasts a connection: events from the time without a connection are sent after the reconnect.
It is bounded; if it is full, the oldest events are dropped. Both sides count the events from the player's first on, and
`NextHappened` has the number of the next event. It is sent whenever the client may expect another number: after a drop,
and after a lost connection, which may lose events on their way. From it the client computes how many events it missed.
"""

from shared.messages import NextHappened, encode


class Outbox:
    """The events that wait to be sent to one player."""

    def __init__(self) -> None:
        # A list, because an empty deque takes 0.6 KB, and there is one of these per player.
        self._waiting: list[tuple[int, bytes, bool]] = []
        self._next = 0
        """Number of the first event that waits."""
        self._unsure = False
        """Whether the client may expect another number than the next one."""

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def due(self) -> bool:
        """Whether there is anything to send, or will be."""
        return self._unsure or bool(self._waiting)

    def add(self, tick: int, message: bytes, most: int, counts: bool = True) -> bool:
        """Queues an event.

        Args:
            tick: the tick in which the rules sent it.
            message: the encoded event.
            most: number of events that may wait; if there are more, the oldest is dropped.
            counts: whether the event has a number. An edge cannot number announcements, because other edges have sent
                others (`server.scale`).

        Returns:
            Whether an event was dropped.
        """
        self._waiting.append((tick, message, counts))
        full = len(self._waiting) > most
        if full:
            self._next += self._waiting.pop(0)[2]
            self._unsure = True
        return full

    def reconnect(self) -> None:
        """Notes that the player has reconnected, so events on their way may be lost."""
        self._unsure = True

    def begin(self, number: int) -> None:
        """Drops all events, because another process has sent them. The next one has a number."""
        self._waiting.clear()
        self._next, self._unsure = number, True

    def take(self, complete_tick: int, room: int) -> list[bytes]:
        """Takes the messages to send now, and returns them.

        Args:
            complete_tick: tick up to which the client has been sent everything in its view.
            room: bytes of events to send, about; at least one event is taken.
        """
        messages = []
        if self._unsure:
            self._unsure = False
            messages.append(encode(NextHappened(self._next)))
        while self._waiting and self._waiting[0][0] <= complete_tick:
            _, message, counts = self._waiting.pop(0)
            messages.append(message)
            self._next += counts
            room -= len(messages[-1])
            if room <= 0:
                break
        return messages
