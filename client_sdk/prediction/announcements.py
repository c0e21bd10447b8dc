"""The announcements of predicted turns: each reaches the program once, however often its tick is replayed.

Theory of operation. A prediction announces an event in the frame that predicts its tick. A replay announces the events
of its ticks again. One that was announced before, in the same tick or up to `SHIFT_S` seconds earlier or later, is the
same event, so the program does not get it twice. An event that the replay does not announce again is withdrawn. If the
prediction for a tick was right, its announcements are final: the state of an entity counts its announcements (`acts` in
`shared.extras`), so equal states have announced the same.
"""

from typing import NamedTuple

from client_sdk.events import Announced, Withdrawn
from shared.payloads import unpack_value
from shared.turns import Announcement

SHIFT_S = 0.25
"""Greatest distance in seconds of two announcements of one event, if a replay moves it to another tick."""


KEPT_S = 10
"""Time for which an event is kept that was either predicted or sent by the server, but not both, in seconds."""


class Pending(NamedTuple):
    """An announcement that is not final yet."""

    tick: int
    number: int
    event: Announcement


class Announcements:
    """The announcements of the own entity, and of what it has spawned.

    Args:
        rate: ticks per second.
    """

    def __init__(self, rate: int) -> None:
        self._rate, self._shift = rate, round(SHIFT_S * rate)
        self.pending: list[Pending] = []
        """Announcements that are not final yet."""
        self._before: list[Pending] | None = None
        """Announcements of the prediction that a replay replaces; None: there is no replay."""
        self._count = 0
        self._given: list[Pending] = []
        """Events that the program has got ahead of the server, whose message has not arrived."""
        self._certain: set[int] = set()
        """Numbers of events among `pending` whose message has arrived."""
        self._early: list[Pending] = []
        """Events whose message has arrived, and that were not predicted: a replay may announce them yet."""
        self.events: list[Announced | Withdrawn] = []
        """Events that the program has not got yet."""

    def confirm(self, tick: int) -> None:
        """Notes that the prediction up to a tick was right."""
        if self.pending:
            self.pending = [each for each in self.pending if each.tick > tick]

    def begin(self, tick: int, final: bool) -> None:
        """Begins a replay of the ticks after `tick`.

        Args:
            tick: the newest confirmed tick.
            final: whether the announcements up to that tick are final.
        """
        if final:
            self.confirm(tick)
        self._before, self.pending = self.pending, []

    def end(self) -> None:
        """Ends a replay: withdraws the events that it has not announced again."""
        for each in self._before or ():
            if each.number and each.number not in self._certain:
                self.events.append(Withdrawn(each.number, each.event.name))
                self._given = [given for given in self._given if given.number != each.number]
        self._before = None
        self._certain &= {each.number for each in self.pending}

    def add(self, tick: int, event: Announcement) -> None:
        """Takes an announcement of the tick that was just predicted or replayed."""
        earlier = self._taken(self._before, tick, event) or self._taken(self._early, tick, event)
        number = earlier.number if earlier is not None else self._count + 1
        if earlier is None:
            self._count = number
            data = unpack_value(event.payload)
            self.events.append(Announced(tick, event.entity, event.name, data, number))
            self._given.append(Pending(tick, number, event))
        self.pending.append(Pending(tick, number, event))

    def arrived(self, tick: int, event: Announcement) -> bool:
        """Takes an own announcement that the server has sent. Returns whether the program has got it already."""
        oldest = tick - KEPT_S * self._rate
        self._given = [each for each in self._given if each.tick > oldest]
        self._early = [each for each in self._early if each.tick > oldest]
        earlier = self._taken(self._given, tick, event)
        if earlier is None:
            self._early.append(Pending(tick, 0, event))
            return False
        self._certain.add(earlier.number)
        return True

    def take(self) -> list[Announced | Withdrawn]:
        """Returns the events since the last call."""
        events, self.events = self.events, []
        return events

    def _taken(self, events: list[Pending] | None, tick: int, event: Announcement) -> Pending | None:
        """Removes the event of a list that is the same as another one, and returns it; None: there is none."""
        found = [
            (abs(each.tick - tick), at)
            for at, each in enumerate(events or ())
            if (each.event.entity, each.event.name) == (event.entity, event.name)
            and abs(each.tick - tick) <= self._shift
        ]
        return events.pop(min(found)[1]) if events and found else None
