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
        self._shift = round(SHIFT_S * rate)
        self.pending: list[Pending] = []
        """Announcements that are not final yet."""
        self._before: list[Pending] | None = None
        """Announcements of the prediction that a replay replaces; None: there is no replay."""
        self._count = 0
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
            self.events.append(Withdrawn(each.number, each.event.name))
        self._before = None

    def add(self, tick: int, event: Announcement) -> None:
        """Takes an announcement of the tick that was just predicted or replayed."""
        number = self._known(tick, event)
        if not number:
            self._count += 1
            number = self._count
            data = unpack_value(event.payload)
            self.events.append(Announced(tick, event.entity, event.name, data, number))
        self.pending.append(Pending(tick, number, event))

    def take(self) -> list[Announced | Withdrawn]:
        """Returns the events since the last call."""
        events, self.events = self.events, []
        return events

    def _known(self, tick: int, event: Announcement) -> int:
        """Returns the number of an event that was announced before the replay, and takes it; 0: there is none."""
        found = [
            (abs(each.tick - tick), each.number, each)
            for each in self._before or ()
            if (each.event.entity, each.event.name) == (event.entity, event.name)
            and abs(each.tick - tick) <= self._shift
        ]
        if not found or self._before is None:
            return 0
        _, number, nearest = min(found)
        self._before.remove(nearest)
        return number
