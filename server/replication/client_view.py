"""The client view: the segments that one client sees, how much of them it has been sent, and what to send next.

Theory of operation. A snapshot has all changed segments if they fit into the room that flow control allows. Otherwise
the segment of the client's own entity comes first, then the others by urgency: the number of ticks whose changes wait,
divided by 1 + 3 x the distance in segments. At least one other segment is always sent, and waiting segments become more
urgent, so every segment is sent eventually. A segment that is new to the client is sent as a keyframe and waits in the
same order. Thus walking up to a crowd does not delay the update of the own position.
"""

from collections.abc import Iterable
from itertools import filterfalse

from server.replication import interest
from server.replication.change_log import ChangeLog
from shared.checks import Cell
from shared.snapshot import KEYFRAME


def fitting(deltas: Iterable[tuple[Cell, bytes]], room: int) -> tuple[dict[Cell, bytes], bool]:
    """Returns the first deltas that fit into the room in bytes, but at least two, and whether all fit.

    Empty deltas are left out. Those after the first one that does not fit are not asked for.
    """
    chosen: dict[Cell, bytes] = {}
    for segment, part in deltas:
        if part:
            room -= len(part)
            if len(chosen) > 1 and room < 0:
                break
            chosen[segment] = part
    return chosen, room >= 0


class ClientView:
    """The segments that one client sees, with the tick of each that was sent last."""

    def __init__(self) -> None:
        self.sees: set[Cell] = set()
        self.near: tuple[Cell, ...] = ()
        """Segments around the client's entity, its own first. `sees` also has some that are further away."""
        self.drops: list[Cell] = []
        """Segments that the client knows and no longer sees. The next snapshot names them."""
        self._rest: tuple[Cell, ...] = ()  # the segments of `sees` that are not in `near`
        self._knows: tuple[Cell, ...] = ()  # segments of which a keyframe was sent; a set takes 800 bytes more
        self._fresh: dict[Cell, int] = {}  # segments that wait for their keyframe, with the tick of their entry
        self._behind: dict[Cell, int] = {}  # segments left out of the latest snapshot, with the tick sent last
        self.tick = -1
        """Tick of the latest snapshot."""

    def move(self, near: tuple[Cell, ...], keep: int, tick: int = -1) -> tuple[list[Cell], list[Cell]]:
        """Updates the view after the entity has come into another segment.

        Args:
            near: the segments around the entity, its own first.
            keep: distance in segments up to which segments stay in the view.
            tick: the tick in which this happened.

        Returns:
            The segments that are new in the view, nearest first, and those that were dropped from it.
        """
        self.near = near
        if not self.sees:
            self.sees.update(near)
            self._fresh = dict.fromkeys(near, -1)  # until these are sent, `complete_tick` precedes all
            self._rest, self.drops = (), sorted({*self._knows} - self.sees)
            return [*near], []
        added, dropped = interest.update(self.sees, near, keep)
        self._fresh.update(dict.fromkeys(added, tick))
        self.sees.difference_update(dropped)
        for segment in dropped:
            self._fresh.pop(segment, None)
            self._behind.pop(segment, None)
        self.sees.update(added)
        self._rest = tuple(self.sees.difference(near))
        self.drops = sorted({*self._knows} - self.sees)
        return added, dropped

    def forget(self) -> None:
        """Makes all segments be sent as keyframes again."""
        self._fresh = dict.fromkeys(self.sees, -1)
        self._behind.clear()
        self.tick = -1

    def lost_track(self, tick: int, history: int) -> bool:
        """Returns whether a segment has waited for more than `history` ticks, for which its changes are kept."""
        return self.tick >= 0 and self.waits(tick) > history

    def lose(self, tick: int, history: int) -> list[Cell]:
        """Makes segments that have waited for more than `history` ticks be sent as keyframes. Returns them."""
        if tick - self.tick > history:
            self.forget()
            return list(self.sees)
        lost = {segment: since for segment, since in self._behind.items() if tick - since > history}
        for segment, since in lost.items():
            del self._behind[segment]
            self._fresh[segment] = since + 1
        return list(lost)

    def begun(self, segments: Iterable[Cell]) -> Cell | None:
        """Returns the first of some segments of the view that has been sent as a keyframe; None: none has."""
        return next(filterfalse(self._fresh.__contains__, segments), None)

    @property
    def plain(self) -> tuple[Cell, ...] | None:
        """Segments of the view in the order in which their deltas are sent; None: the next snapshot needs `take`."""
        return None if self._behind or self._fresh or self.drops else self.near + self._rest

    @property
    def complete(self) -> bool:
        """Whether the latest snapshot left out nothing."""
        return not (self._behind or self._fresh)

    @property
    def complete_tick(self) -> int:
        """Newest tick of which the client has been sent everything that was in its view at the end of that tick."""
        return min((self.tick, *self._behind.values(), *(since - 1 for since in self._fresh.values())))

    def waits(self, tick: int) -> int:
        """Returns the number of ticks since the segment that has waited longest was sent."""
        return tick - (min(self._behind.values()) if self._behind else self.tick)

    def take(self, log: ChangeLog, tick: int, room: int) -> tuple[int, bytes]:
        """Chooses the segments of the next snapshot. They, and `drops`, count as sent afterwards.

        Args:
            log: the changes of the world.
            tick: the tick of the snapshot.
            room: bytes that the segment deltas should not exceed.

        Returns:
            The number of segment deltas, and their bytes.
        """
        deltas = log.since(self.tick)
        if not (self._behind or self._fresh or self.drops):  # the usual case
            n, plain = deltas.together(self.near)
            for segment in self._rest:
                if segment in deltas.changed and (part := deltas[segment]):
                    n += 1
                    plain += part
            if len(plain) <= room:
                self.tick = tick
                return n, plain
        due: dict[Cell, int] = {}
        if tuple(self._fresh) == self.near and len(self._fresh) == len(self.sees):
            keyframes = log.since(KEYFRAME)  # all wait for theirs, the nearest first
            parts, _ = fitting(((segment, keyframes[segment]) for segment in self._fresh), room)
        else:
            due = self._behind | dict.fromkeys(self._fresh, KEYFRAME)
            if len(due) < len(self.sees):
                due |= {segment: self.tick for segment in self.sees - due.keys() if deltas[segment]}
            parts = self._urgent(log, due, tick, room)
        if self._fresh or self.drops:
            self._knows = tuple({*self._knows}.difference(self.drops) | (self._fresh.keys() & parts.keys()))
            self._fresh = {segment: since for segment, since in self._fresh.items() if segment not in parts}
            self.drops = []
        self._behind = (
            {segment: since for segment, since in due.items() if since != KEYFRAME and segment not in parts}
            if len(parts) < len(due)
            else {}
        )
        self.tick = tick
        return len(parts), b"".join(parts.values())

    def _urgent(self, log: ChangeLog, due: dict[Cell, int], tick: int, room: int) -> dict[Cell, bytes]:
        """Returns the most urgent deltas that fit into the room, but at least the own segment and one more.

        A delta that does not fit is not encoded.

        Args:
            log: the changes of the world.
            due: the tick of each segment that was sent last, or `KEYFRAME`, which counts as waiting for longest.
            tick: the tick of the snapshot.
            room: the room in bytes.
        """
        centre, distance, history = self.near[0], interest.distance, log.history

        def rank(segment: Cell) -> tuple[bool, float]:
            waits = tick - due[segment] if due[segment] != KEYFRAME else history
            return segment != centre, -waits / (1 + 3 * distance(segment, centre))

        deltas = {since: log.since(since) for since in {*due.values()}}
        chosen, all_fit = fitting(((each, deltas[due[each]][each]) for each in sorted(due, key=rank)), room)
        return {segment: chosen[segment] for segment in due if segment in chosen} if all_fit else chosen
