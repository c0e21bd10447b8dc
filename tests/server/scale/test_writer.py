"""Tests of the writer of a log, against a log that loses messages and answers."""

import random

import pytest

from server.scale.writer import EMPTY, UNACKNOWLEDGED_MAX, DeposedError, Entry, LogWriter, LostError


class Log:
    """A log that accepts a record behind its newest one only."""

    def __init__(self) -> None:
        self.ids: list[str] = []

    @property
    def last(self) -> str:
        return self.ids[-1] if self.ids else EMPTY

    def append(self, entry: Entry) -> bool:
        if entry.id not in self.ids:
            if entry.after != self.last:
                return False
            self.ids.append(entry.id)
        return True


@pytest.mark.parametrize("seed", range(20))
def test_no_record_is_lost_or_doubled_by_a_log_that_loses_messages(seed: int) -> None:
    rng, log, writer = random.Random(seed), Log(), LogWriter("a", EMPTY)
    tick, sent = 0, list[Entry]()
    while tick < 200 or len(writer):
        if tick < 200 and not writer.full and rng.random() < 0.5:
            sent.append(writer.add(1, tick, b""))
            tick += 1
        if sent and rng.random() < 0.8:
            entry = sent.pop(0)
            fate = rng.random()
            accepted = fate > 0.2 and log.append(entry)
            if fate < 0.3:  # the message or its answer was lost
                sent += writer.unanswered(entry)
            elif accepted:
                writer.accepted(entry)
            else:
                sent += writer.refused(entry, log.last)
    assert log.ids == [f"1:{each}:a" for each in range(200)]


def test_a_writer_has_a_maximum_of_unacknowledged_records() -> None:
    writer = LogWriter("a", EMPTY)
    entries = [writer.add(1, tick, b"") for tick in range(UNACKNOWLEDGED_MAX)]
    assert writer.full
    writer.accepted(entries[2])  # the log has those before it, too
    assert len(writer) == UNACKNOWLEDGED_MAX - 3


def test_a_refusal_by_the_record_of_another_writer_ends_a_writer() -> None:
    writer = LogWriter("a", "1:7:a")
    entry = writer.add(1, 8, b"")
    with pytest.raises(DeposedError, match="2:7:b"):
        writer.refused(entry, "2:7:b")


def test_two_writers_that_begin_an_epoch_have_other_ids() -> None:
    log, ids = Log(), [LogWriter(name, EMPTY).add(1, 0, b"") for name in "ab"]
    assert [log.append(entry) for entry in ids] == [True, False]


def test_a_log_that_has_lost_an_acknowledged_record_ends_a_writer() -> None:
    writer = LogWriter("a", EMPTY)
    for tick in (1, 2):
        writer.accepted(writer.add(1, tick, b""))
    entry = writer.add(1, 3, b"")
    with pytest.raises(LostError, match=r"1:1:a, not 1:2:a"):
        writer.refused(entry, "1:1:a")
