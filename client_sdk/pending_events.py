"""The events that wait until the program takes them: in order, bounded, and counted where some were dropped."""

from client_sdk.events import Disconnected, Event, EventsDropped, Happened, Joined, Left, Resumed

EVENTS_MAX = 10_000
"""Limit of the game events that wait, and of the SDK's own events except those that it never drops."""
NEVER, GAME, OTHER = range(3)
"""Kinds of events: never dropped, game events, and other events of the SDK."""
KINDS = {
    Happened: GAME, EventsDropped: GAME, Joined: NEVER, Disconnected: NEVER, Resumed: NEVER, Left: NEVER,
}  # fmt: skip


class PendingEvents(list[Event]):
    """Waiting events. Of too many of one kind the oldest are dropped; an `EventsDropped` in their place counts them.

    Use `append`, `take` and `next` only.
    """

    def __init__(self) -> None:
        super().__init__()
        self._counts = [0, 0, 0]

    def append(self, event: Event) -> None:
        """Adds an event behind the others."""
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
        """Drops the oldest event of a kind, or two: an `EventsDropped` before it, or in their place, counts them."""
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


def _weight(event: Event) -> int:
    """Returns the number of events that one stands for."""
    return event.count if isinstance(event, EventsDropped) else 1


def _kind(event: Event) -> int:
    return KINDS.get(type(event), OTHER)
