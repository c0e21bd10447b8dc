"""Commands of clients: carried out in their tick, bounded, answered."""

import random
from collections.abc import Sequence
from typing import Any

import pytest

from server.config.limits import Limits
from shared import edits, messages
from shared.messages import Command, Inputs, Snapshot, Welcome
from tests.tables import FakeLink, Table, order


@pytest.fixture
def table() -> Table:
    return Table()


# -- commands ------------------------------------------------------------------------------------------------


def builder(table: Table) -> FakeLink:
    """Returns a client that has been connected long enough to be allowed some edits."""
    link = table.join()
    table.tick(64)
    return link


def verdicts(link: FakeLink) -> dict[int, int]:
    told: dict[int, int] = {}
    for snapshot in link.got(Snapshot):
        for at in range(0, len(snapshot.verdicts), 5):
            number = int.from_bytes(snapshot.verdicts[at : at + 4], "little")
            assert number not in told
            told[number] = snapshot.verdicts[at + 4]
    return told


def test_an_edit_is_carried_out_in_its_tick_and_answered(table: Table) -> None:
    link = builder(table)
    tick = table.tick_number
    link.say(order(1, tick + 2, 18, 16, 1, 5), order(2, tick, 14, 16, 1, 6))
    table.tick()
    assert table.game.world.blocks.get(18, 16, 1) == 0
    table.tick()
    assert [table.game.world.blocks.get(*at) for at in ((18, 16, 1), (14, 16, 1))] == [5, 6]
    assert verdicts(link) == {1: messages.DONE, 2: messages.DONE}


def test_each_edit_that_cannot_be_done_says_why(table: Table) -> None:
    link = builder(table)
    link.say(
        order(1, 0, 16, 16, 1, 5),
        order(2, 0, 30, 16, 1, 5),
        order(3, 0, 16, 16, -3, 5),
        Command(4, 0, 0.0, edits.NAME, b"\xff"),
        Command(5, 0, 0.0, "fly", b""),
        order(6, table.tick_number + 200, 18, 16, 1, 5),
    )
    table.tick(2)
    told = verdicts(link)
    assert told[1] in (messages.OVERLAPS, messages.DONE)
    assert told[2] == messages.OUT_OF_REACH
    assert {told[number] for number in (3, 4, 5)} == {messages.INVALID}
    assert told[6] == messages.TOO_MANY


def test_a_command_counts_once(table: Table) -> None:
    link = builder(table)
    link.say(order(5, 0, 18, 16, 1, 5), order(5, 0, 18, 16, 1, 0), order(4, 0, 18, 16, 1, 0))
    table.tick(2)
    assert (verdicts(link), table.game.world.blocks.get(18, 16, 1)) == ({5: messages.DONE}, 5)


def test_commands_are_bounded_in_number_and_rate() -> None:
    table = Table(Limits(commands_waiting_max=4, edits_per_s=1.0))
    link = table.join()
    table.tick(128)
    tick = table.tick_number
    link.say(*[order(n, tick + 2, 18, 16, 1 + n, 5) for n in range(1, 9)])
    assert link.session.player
    assert len(link.session.player.commands) == 4
    table.tick(3)
    assert sorted(verdicts(link)) == list(range(1, 9))
    assert [verdicts(link)[n] for n in range(5, 9)] == [messages.TOO_MANY] * 4
    assert sum(verdict == messages.DONE for verdict in verdicts(link).values()) == 2  # two seconds of edits at once


@pytest.mark.parametrize("edits_per_s", [0.5, 7.0, 10.0, 31.0])
def test_the_rate_of_edits_is_the_same_whether_they_come_in_every_tick_or_seldom(edits_per_s: float) -> None:
    table, rng = Table(Limits(edits_per_s=edits_per_s), resume_s=60.0), random.Random(5)
    link, number, left = table.join(), 0, 0.0
    expected: dict[int, bool] = {}
    per_tick, most = edits_per_s * table.tick_s, 2 * edits_per_s
    left = min(left + per_tick, most)  # of the tick in which it joined
    for tick in range(400):
        left = min(left + per_tick, most)
        for _ in range(rng.choice((0, 0, 0, 1, 2, 5)) if tick % 100 < 50 else rng.random() < 0.02):
            number += 1
            link.say(order(number, 0, 18, 16, 1, 5 * (number % 2)))
            expected[number] = left < 1
            left -= left >= 1
        table.tick()
    assert number > 50
    assert {n: verdict == messages.TOO_MANY for n, verdict in verdicts(link).items()} == expected
    assert 0 < sum(expected.values()) < number


class Disk:
    """A stand-in for the store that saves a world."""

    def __init__(self) -> None:
        self.kept: Any = None
        self.notes: Sequence[tuple[int, Any]] = ()
        self.trouble = ""
        self.durable_tick = 1 << 30


def test_a_verdict_is_sent_when_its_tick_is_on_disk() -> None:
    disk = Disk()
    table = Table(saves=disk)
    link = builder(table)
    link.say(order(1, 0, 18, 16, 1, 5), order(2, 0, 30, 16, 1, 5))
    disk.durable_tick = table.tick_number
    table.tick(3)
    assert table.game.world.blocks.get(18, 16, 1) == 5
    link.say(order(1, 0, 18, 16, 1, 5))  # sent again
    table.tick()
    assert verdicts(link) == {}
    told = [note[1:] for note in table.game.keep() if note[0] == "answered"]  # a checkpoint made now would hold them
    assert told == [[link.session.entity, 1, messages.DONE], [link.session.entity, 2, messages.OUT_OF_REACH]]
    disk.durable_tick += 1
    table.tick()
    assert verdicts(link) == {1: messages.DONE, 2: messages.OUT_OF_REACH}


def test_a_client_is_welcomed_when_its_token_is_on_disk_or_nothing_can_be_saved() -> None:
    disk = Disk()
    table = Table(Limits(stalled_s=0.1), saves=disk)
    disk.durable_tick = table.tick_number
    first = table.join()
    table.tick(10)
    assert first.sent == []
    assert first.closings == [], "the client has not stalled"
    disk.durable_tick = 1
    table.tick()
    assert [type(message) for message in first.sent[:2]] == [Welcome, Snapshot]
    disk.trouble = "no room"
    second = table.join()
    assert [type(message) for message in second.sent[:2]] == [Welcome, Snapshot]


def test_while_nothing_can_be_saved_commands_are_refused_and_players_move_on() -> None:
    disk = Disk()
    table = Table(saves=disk)
    link = builder(table)
    link.say(order(1, 0, 18, 16, 1, 5))
    disk.durable_tick = table.tick_number
    table.tick()
    disk.trouble = "no room"
    at = table.game.world.position(link.session.entity)
    tick = table.tick_number
    link.say(order(2, 0, 18, 16, 2, 5), Inputs(tick + 1, tick, bytes((127, 0, 0)) * 8))
    table.tick(8)
    assert verdicts(link) == {2: messages.UNSAVED}
    assert table.game.world.blocks.get(18, 16, 2) == 0
    assert table.game.world.position(link.session.entity)[0] > at[0]
    disk.trouble, disk.durable_tick = "", table.tick_number
    link.say(order(3, 0, 18, 16, 2, 5))
    table.tick()
    assert verdicts(link) == {2: messages.UNSAVED, 1: messages.DONE}
    disk.durable_tick = table.tick_number
    table.tick()
    assert verdicts(link)[3] == messages.DONE


def test_commands_of_a_closed_client_are_not_carried_out(table: Table) -> None:
    link = table.join()
    link.say(order(1, table.tick_number + 1, 18, 16, 1, 5), b"\xff")
    table.tick(2)
    assert table.game.world.blocks.get(18, 16, 1) == 0


@pytest.mark.parametrize(
    ("reach", "verdict"), [(1.0, messages.OUT_OF_REACH), (6.0, messages.DONE), (0.0, messages.OUT_OF_REACH)]
)
def test_the_scene_says_how_far_a_player_reaches(reach: float, verdict: int) -> None:
    table = Table(reach=reach)
    link = builder(table)
    link.say(order(1, 0, 18, 16, 1, 5))
    table.tick()
    assert verdicts(link) == {1: verdict}


def test_more_inputs_in_a_message_than_the_limit_end_it() -> None:
    table = Table(Limits(input_rows_max=16))
    link = table.join()
    link.say(Inputs(table.tick_number + 1, -1, bytes(3 * 16)))
    assert link.closings == []
    link.say(Inputs(table.tick_number + 17, -1, bytes(3 * 17)))
    assert link.refusal() == (messages.MALFORMED, "more than 16 inputs in a message")
