"""The events that wait until the program takes them: in order and bounded; dropped ones are counted."""

from client_sdk.events import (
    Announced,
    Disconnected,
    Event,
    EventsDropped,
    HandedOver,
    Happened,
    Joined,
    Left,
    Matched,
    Moved,
    Resumed,
)
from shared import messages, payloads

EVENTS_MAX = 10_000
"""Limit of the waiting game events, and separately of the waiting other events that may be dropped."""
NEVER, GAME, OTHER = range(3)
"""Kinds of events: never dropped, game events, and other events of the SDK."""
KINDS = {
    Happened: GAME, Announced: GAME, EventsDropped: GAME,
    Joined: NEVER, Matched: NEVER, Moved: NEVER, HandedOver: NEVER,
    Disconnected: NEVER, Resumed: NEVER, Left: NEVER,
}  # fmt: skip
"""Kind of an event by its class; all others are OTHER."""


class PendingEvents(list[Event]):
    """The waiting events. If too many of one kind wait, the oldest is dropped, and an `EventsDropped` there counts it.

    Use `append`, `take` and `next` only.
    """

    def __init__(self) -> None:
        super().__init__()
        self._counts = [0, 0, 0]

    def append(self, event: Event) -> None:
        """Adds an event at the end, and drops the oldest of its kind if there are too many."""
        super().append(event)
        self._counts[_kind(event)] += 1
        for kind in (OTHER, GAME):
            if self._counts[kind] > EVENTS_MAX:
                self._drop(kind)

    def take(self) -> list[Event]:
        """Takes all events, oldest first."""
        events = list(self)
        self.clear()
        self._counts = [0, 0, 0]
        return events

    def next(self) -> Event:
        """Takes the oldest event.

        Raises:
            IndexError: there is none.
        """
        event = self.pop(0)
        self._counts[_kind(event)] -= 1
        return event

    def _drop(self, kind: int) -> None:
        """Drops the oldest event of a kind, which the `EventsDropped` in front of it counts.

        If there is none in front, a new `EventsDropped` takes the place of the two oldest events of this kind.
        """
        oldest = (at for at, event in enumerate(self) if _kind(event) == kind)
        last = next(oldest)
        first = last - 1
        if last == 0 or not isinstance(self[first], EventsDropped):
            first, last = last, next(oldest)
            self._counts[kind] -= 1
            self._counts[GAME] += 1
        self[first] = EventsDropped(_weight(self[first]) + _weight(self[last]))
        del self[last]
        self._counts[kind] -= 1


class GameEvents:
    """The events that the rules of the game have sent to this player: counted, and in order with the SDK's own events.

    Args:
        events: receives the events.
    """

    def __init__(self, events: PendingEvents) -> None:
        self._events = events
        self._held = PendingEvents()
        """Events that arrived before `Joined` or `Resumed`, and follow it."""
        self.apart = False
        """Whether announcements have no numbers (`shared.messages.Edges`)."""
        self._announces = False
        """Whether there was an announcement without a number."""
        self._count = 0
        """Number of events that have arrived, or are known to be lost."""

    def happened(self, message: messages.Happened | messages.Announce, *, hold: bool, announced: bool = False) -> None:
        """Takes one event.

        Args:
            message: the event.
            hold: whether to hold it back until `release`.
            announced: whether the program has got it already, ahead of the server; then it is only counted.

        Raises:
            ProtocolError: its payload is malformed.
        """
        if self.apart and isinstance(message, messages.Announce):
            self._announces = True
        else:
            self._count += 1
        if announced:
            return
        data = payloads.unpack_value(message.payload)
        if isinstance(message, messages.Announce):
            self._file(Announced(message.tick, message.entity, message.name, data), hold=hold)
        else:
            self._file(Happened(message.tick, message.name, data), hold=hold)

    def next(self, number: int, *, hold: bool, sure: bool = False) -> None:
        """Takes the number of the server's next event. If events before it are missing, files an `EventsDropped`.

        Args:
            number: the number.
            hold: whether to hold it back until `release`.
            sure: whether no announcement can be missing.
        """
        if number > self._count or (self._announces and not sure):
            self._file(EventsDropped(max(number - self._count, 0)), hold=hold)
        self._count = number

    def release(self) -> None:
        """Files the events that were held back."""
        for event in self._held.take():
            self._events.append(event)

    def restart(self) -> None:
        """Releases the events, and counts from 0 again, because the player is a new one to the server."""
        self.release()
        self._count, self.apart, self._announces = 0, False, False

    def _file(self, event: Event, *, hold: bool) -> None:
        (self._held if hold else self._events).append(event)


def _weight(event: Event) -> int:
    """Returns the number of events that an event stands for."""
    return event.count if isinstance(event, EventsDropped) else 1


def _kind(event: Event) -> int:
    return KINDS.get(type(event), OTHER)
