"""The writer of a log: the records of one sequencer that the log has not acknowledged yet.

Theory of operation. Each record names the one that it follows, and the log refuses it if its newest record is another
one. So a record of a deposed sequencer is never accepted, and neither is one whose predecessor was lost on the way. A
refusal names the newest record of the log, which tells the two cases apart. Only the answer to the oldest
unacknowledged record counts: after a refusal of it, or if there is no answer, all unacknowledged records are sent
again. The log recognises one that it has by its id. At most `UNACKNOWLEDGED_MAX` records are on their way; beyond
that, time stands still.
"""

from collections import deque
from typing import NamedTuple

UNACKNOWLEDGED_MAX = 8
"""Maximum number of records without an acknowledgement. Beyond it, the sequencer computes no tick."""
EMPTY = ""
"""Id that the first record of an empty log follows."""


class DeposedError(Exception):
    """Another sequencer writes the log. This one has to end."""


class LostError(Exception):
    """The log has lost a record that it had acknowledged."""


class Entry(NamedTuple):
    """A record on its way to the log: its id, the id of the record before it, and its bytes."""

    id: str
    after: str
    data: bytes


def id_of(epoch: int, tick: int, writer: str) -> str:
    """Returns the id of a record. With the writer's name, two that begin the same epoch have different ids."""
    return f"{epoch}:{tick}:{writer}"


class LogWriter:
    """The unacknowledged records of one sequencer.

    Args:
        name: name of the writer, which no other one has.
        last: id of the newest record of the log.
    """

    def __init__(self, name: str, last: str) -> None:
        self._name, self._acknowledged, self._newest = name, last, last
        self._waiting: deque[Entry] = deque()
        self.repeated = 0
        """Number of records that were sent again."""

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether no further record may be added."""
        return len(self._waiting) >= UNACKNOWLEDGED_MAX

    def add(self, epoch: int, tick: int, data: bytes) -> Entry:
        """Adds a record behind the newest one. Returns what to send."""
        entry = Entry(id_of(epoch, tick, self._name), self._newest, data)
        self._newest = entry.id
        self._waiting.append(entry)
        return entry

    def accepted(self, entry: Entry) -> None:
        """Takes the acknowledgement of a record, which is one of all records before it, too."""
        if entry in self._waiting:
            while self._waiting.popleft() != entry:
                pass
            self._acknowledged = entry.id

    def refused(self, entry: Entry, last: str) -> list[Entry]:
        """Takes a refusal. Returns the records to send again.

        Args:
            entry: the record that was refused.
            last: id of the newest record of the log.

        Raises:
            DeposedError: the newest record of the log is another sequencer's.
            LostError: the log does not have a record that it had acknowledged.
        """
        mine = last == self._acknowledged or any(each.id == last for each in self._waiting)
        if not mine and last != EMPTY and last.rpartition(":")[2] != self._name:
            raise DeposedError(f"the log is written by another sequencer: its newest record is {last}")
        if not self._waiting or entry != self._waiting[0]:
            return []
        if not mine:
            raise LostError(f"the log has lost records: its newest is {last or 'none'}, not {self._acknowledged}")
        if last != self._acknowledged:
            self.accepted(next(each for each in self._waiting if each.id == last))
        return self._again()

    def unanswered(self, entry: Entry) -> list[Entry]:
        """Returns the records to send again after no answer has come to one."""
        return self._again() if self._waiting and entry == self._waiting[0] else []

    def _again(self) -> list[Entry]:
        self.repeated += len(self._waiting)
        return list(self._waiting)
