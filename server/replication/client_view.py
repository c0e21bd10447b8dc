"""What one client sees and has been sent of it: which segments' changes go into its next snapshot.

Theory of operation. Everything that changed goes, as long as it fits into what may be on the way to the client.
Where it does not, the own segment goes, then the others by urgency: how many ticks of changes wait, over how far away
they are. One of them always goes, and what waits grows more urgent: nobody is starved. A segment that is new to
the client is sent whole (a keyframe) and waits its turn in the same order, so that walking up to a crowd does not put
a wall of bytes in front of the own position.
"""

from server.replication import interest
from server.replication.change_log import ChangeLog
from shared.checks import Cell
from shared.snapshot import KEYFRAME


class Sight:
    """The segments that a client sees."""

    def __init__(self) -> None:
        self.sees: set[Cell] = set()
        self.near: tuple[Cell, ...] = ()
        """Of them those around the entity, its own first; the rest it has come away from."""
        self.drops: list[Cell] = []
        """What the client knows and does not see any more: to be told with the next snapshot."""
        self._rest: tuple[Cell, ...] = ()
        self._knows: set[Cell] = set()
        self._fresh: dict[Cell, int] = {}  # no keyframe sent yet; in sight, and unknown, since this tick
        self._behind: dict[Cell, int] = {}  # sent last with this tick, which is before `_tick`
        self._tick = -1

    def move(self, near: tuple[Cell, ...], keep: int, tick: int = -1) -> tuple[list[Cell], list[Cell]]:
        """The entity is in another segment as of `tick`: what is seen from then on, nearest first, and is let go."""
        added, dropped = interest.update(self.sees, near, keep)
        self.near = near
        self._fresh.update(dict.fromkeys(added, tick if self.sees else -1))  # the first ones: as far back as can be
        self.sees.difference_update(dropped)
        for segment in dropped:
            self._fresh.pop(segment, None)
            self._behind.pop(segment, None)
        self.sees.update(added)
        self._rest = tuple(self.sees.difference(near))
        self.drops = sorted(self._knows - self.sees)
        return added, dropped

    def forget(self) -> None:
        """Everything is to be sent anew."""
        self._fresh = dict.fromkeys(self.sees, -1)
        self._behind.clear()
        self._tick = -1

    def lost_track(self, tick: int, history: int) -> bool:
        """Whether something waits for longer than its changes are kept: `history` ticks."""
        return self._tick >= 0 and self.waits(tick) > history

    def lose(self, tick: int, history: int) -> list[Cell]:
        """Gives up on what waits for longer than its changes are kept: it is to be sent whole. Returns the segments."""
        if tick - self._tick > history:
            self.forget()
            return list(self.sees)
        lost = {segment: since for segment, since in self._behind.items() if tick - since > history}
        for segment, since in lost.items():
            del self._behind[segment]
            self._fresh[segment] = since + 1
        return list(lost)

    def begun(self, segment: Cell) -> bool:
        """Whether a segment that is seen has been sent whole."""
        return segment not in self._fresh

    @property
    def complete(self) -> bool:
        """Whether the latest snapshot had all there was."""
        return not (self._behind or self._fresh)

    @property
    def known(self) -> int:
        """The newest tick of which the client has been sent all that was in its sight at the end of it."""
        return min((self._tick, *self._behind.values(), *(since - 1 for since in self._fresh.values())))

    def waits(self, tick: int) -> int:
        """For how many ticks the segment that was sent longest ago, of those known, has not been sent."""
        return tick - (min(self._behind.values()) if self._behind else self._tick)

    def take(self, log: ChangeLog, tick: int, room: int) -> tuple[int, bytes]:
        """How many parts a snapshot for `tick` has, and their bytes, some `room`; they count as sent, as do `drops`."""
        known = log.since(self._tick)
        if not (self._behind or self._fresh or self.drops):  # as nearly always
            n, plain = known.together(self.near)
            for segment in self._rest:
                if segment in known.changed and (part := known[segment]):
                    n += 1
                    plain += part
            if len(plain) <= room:
                self._tick = tick
                return n, plain
        special = self._behind | dict.fromkeys(self._fresh, KEYFRAME)
        due = special | {segment: self._tick for segment in self.sees - special.keys() if known[segment]}
        parts = {segment: part for segment, since in due.items() if (part := log.since(since)[segment])}
        if sum(map(len, parts.values())) > room:
            parts = self._urgent(parts, due, tick, log.history, room)
        if self._fresh or self.drops:
            self._knows = self._knows.difference(self.drops) | (self._fresh.keys() & parts.keys())
            self._fresh = {segment: since for segment, since in self._fresh.items() if segment not in parts}
            self.drops = []
        self._behind = (
            {segment: since for segment, since in due.items() if segment not in parts and since != KEYFRAME}
            if len(parts) < len(due)
            else {}
        )
        self._tick = tick
        return len(parts), b"".join(parts.values())

    def _urgent(
        self, parts: dict[Cell, bytes], due: dict[Cell, int], tick: int, history: int, room: int
    ) -> dict[Cell, bytes]:
        """The parts that fit, in the order of urgency; at least the own segment and one more."""
        centre = self.near[0]

        def urgency(segment: Cell) -> float:
            waits = tick - due[segment] if due[segment] != KEYFRAME else history
            return waits / (1 + 3 * interest.distance(segment, centre))

        order = sorted(parts, key=lambda segment: (segment != centre, -urgency(segment)))
        chosen: dict[Cell, bytes] = {}
        for segment in order:
            room -= len(parts[segment])
            if len(chosen) > 1 and room < 0:
                break
            chosen[segment] = parts[segment]
        return chosen
