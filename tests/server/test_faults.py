"""Exceptions in our own code: each costs one client, command or segment, is counted, and the ticks go on."""

import logging
from typing import Any

import pytest

from server.config.limits import Limits
from server.observability.errors import FaultReporter
from server.replication import change_log
from server.replication.flow_control import SAMPLE_S
from shared import edits, messages
from shared.checks import Cell
from shared.messages import Bye, Inputs, Ping, Pong, Snapshot
from shared.snapshot import join_part
from tests.tables import HELLO, FakeLink, Table, order


class BrokenLink(FakeLink):
    """A link that works until it is broken."""

    def __init__(self, table: Table) -> None:
        super().__init__(table)
        self.broken: set[str] = set()

    def send(self, message: bytes) -> None:
        if "send" in self.broken:
            raise RuntimeError("no such socket")
        super().send(message)

    def outstanding(self) -> int | None:
        if "outstanding" in self.broken:
            raise RuntimeError("no such socket")
        return super().outstanding()

    def close(self, code: int, reason: str) -> None:
        if "close" in self.broken:
            raise RuntimeError("no such socket")
        super().close(code, reason)


@pytest.fixture
def table() -> Table:
    return Table()


def connect(table: Table) -> BrokenLink:
    link = BrokenLink(table)
    link.session = table.game.open(link, table.now)
    link.say(HELLO)
    return link


@pytest.mark.parametrize("broken", [{"send"}, {"outstanding"}, {"send", "close"}, {"outstanding", "close"}])
def test_a_client_that_cannot_be_served_is_closed_and_the_others_notice_nothing(
    table: Table, broken: set[str], caplog: pytest.LogCaptureFixture
) -> None:
    links = [connect(table) for _ in range(3)]
    table.tick(2)
    bad = links[1]
    bad.broken = broken
    seen = [len(link.got(Snapshot)) for link in links]
    table.tick(20)
    before, broke, after = (len(link.got(Snapshot)) - n for link, n in zip(links, seen, strict=True))
    assert (before, after) == (20, 20)
    assert broke <= (SAMPLE_S / table.tick_s if "outstanding" in broken else 0), "`outstanding` is asked once per tick"
    assert bad.session not in table.game.sessions
    assert bad.closings == ([] if "close" in broken else [(messages.INTERNAL, "internal error")])
    assert len(table.game.world) == 2, "its entity stays, like that of any lost connection"
    assert table.game.faults.total == len(broken)
    assert len([record for record in caplog.records if record.exc_info]) == len(broken)
    bad.broken = set()
    table.game.lost(bad.session, table.now)  # the gateway reports the loss, too
    table.tick()
    assert table.game.counters.left == 1


def test_a_welcome_that_cannot_be_sent_ends_that_join_only(table: Table) -> None:
    bad, good = connect(table), connect(table)
    bad.broken = {"send"}
    table.tick(2)
    assert bad.closings == [(messages.INTERNAL, "internal error")]
    assert good.got(Snapshot)
    assert (len(table.game.sessions), len(table.game.world)) == (1, 1)


@pytest.mark.parametrize("broken", [{"send"}, {"close"}])
def test_a_client_whose_bye_fails_is_closed_all_the_same(broken: set[str]) -> None:
    table = Table(Limits(silence_s=1.0))
    bad, good = connect(table), connect(table)
    table.tick(1)
    bad.broken = broken
    for _ in range(3 * 32):
        good.say(Ping(1.0))
        table.tick()
    assert table.game.sessions == [good.session]
    assert len(table.game.world) == 1


def test_the_end_reaches_the_others(table: Table) -> None:
    bad, good = connect(table), connect(table)
    table.tick()
    bad.broken = {"send", "close"}
    table.game.shut_down("the end", 3.0)
    assert good.sent[-1] == Bye(messages.GOING_AWAY, "the end", 3.0)
    assert good.closings == [(messages.GOING_AWAY, "the end")]
    assert bad.session not in table.game.sessions


def test_a_command_that_fails_is_answered_and_those_after_it_are_carried_out(
    table: Table, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = connect(table)
    table.tick(16)  # the edits of two seconds
    link.sent.clear()
    real = edits.apply

    def fails(world: Any, entity: int, edit: edits.Edit) -> int:
        if edit.kind == 9:
            raise ZeroDivisionError
        return real(world, entity, edit)

    monkeypatch.setattr(edits, "apply", fails)
    at = table.tick_number + 1
    link.say(order(1, at, 18, 16, 1, 9), order(2, at, 18, 17, 1, 1))
    table.tick()
    told = b"".join(snapshot.verdicts for snapshot in link.got(Snapshot))
    assert [(told[n], told[n + 4]) for n in range(0, len(told), 5)] == [(1, messages.FAILED), (2, messages.DONE)]
    assert table.game.faults.total == 1
    assert link.closings == []


def test_a_segment_that_cannot_be_encoded_is_left_out_and_comes_when_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(size=(2, 1, 1), spawns=((30.0, 16.0, 1.0), (34.0, 16.0, 1.0)))
    broken = True

    def fails(segment: Cell, *arguments: Any, **options: Any) -> bytes:
        if broken and segment == (1, 0, 0):
            raise ZeroDivisionError
        return join_part(segment, *arguments, **options)

    monkeypatch.setattr(change_log, "join_part", fails)
    links = [connect(table) for _ in range(2)]
    table.tick(5)
    assert all(link.closings == [] for link in links)
    for link in links:
        assert len(link.got(Snapshot)) == 5
        assert {tuple(part[:3]) for snapshot in link.got(Snapshot) for part in snapshot.segments} == {(0, 0, 0)}
    assert table.game.faults.total == 5, "one fault per tick, for any number of clients that see the segment"
    broken = False
    table.tick()
    for link in links:
        assert (1, 0, 0) in {tuple(part[:3]) for part in link.got(Snapshot)[-1].segments}
    assert table.game.faults.total == 5


def test_no_client_is_closed_for_a_pause_of_the_server() -> None:
    table = Table(Limits(silence_s=5.0, stalled_s=5.0, hello_s=5.0))
    link, late = table.join(), table.connect()
    table.now += 60.0
    table.game.tick(table.now - 60.0, table.now)  # as the ticker does after the process was suspended
    table.tick(32)
    assert link.closings == late.closings == []
    link.say(Ping(1.0))
    assert link.got(Pong)
    table.tick(6 * table.game.scene.tick_rate)
    assert link.refusal()[1] == "no message received for 5 s"
    assert late.refusal()[1] == "no hello within 5 s"


def test_messages_sent_during_a_pause_of_the_server_are_no_flood() -> None:
    for ticks_first in (True, False):
        table = Table()
        link = table.join()
        table.now += 20.0

        def say_all(table: Table = table, link: FakeLink = link, tick: int = table.tick_number) -> None:
            for n in range(20 * table.game.scene.tick_rate):  # messages that waited in the kernel
                link.say(Inputs(tick + 1 + n, tick, bytes(3)))

        if not ticks_first:
            say_all()
        table.game.tick(table.now - 20.0, table.now)
        if ticks_first:
            say_all()
        for _ in range(64):
            table.tick()
            link.say(Inputs(table.tick_number, table.tick_number, b""))
        assert link.closings == []


def test_the_time_to_reconnect_is_extended_by_a_pause_of_the_server() -> None:
    table = Table(resume_s=15.0)
    link = table.join()
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)))  # the client has got its welcome
    table.lose(link)
    rate = table.game.scene.tick_rate
    table.tick(5 * rate)
    table.now += 60.0
    table.game.tick(table.now - 60.0, table.now)
    table.tick(9 * rate)
    assert link.session.entity in table.game.players
    table.tick(2 * rate)
    assert not table.game.players


def test_the_1st_10th_and_100th_of_one_fault_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    faults = FaultReporter()

    def mistake() -> None:
        try:
            _ = 1 // 0
        except ZeroDivisionError:
            faults.report("a sum")

    for _ in range(1000):
        mistake()
    try:
        _ = [0][1]
    except IndexError:
        faults.report("a search")
    assert faults.total == 1001
    logged = [record for record in caplog.records if record.levelno == logging.ERROR and record.exc_info]
    assert [record.args for record in logged] == [
        ("internal error", *told) for told in [*(("a sum", 10**n) for n in range(4)), ("a search", 1)]
    ]
