"""The messages of a client for inputs that change, and for those that stay the same."""

from itertools import pairwise

import pytest

from client_sdk.sent_inputs import SentInputs
from shared.bounds import bounds
from shared.inputs import Input, row
from shared.messages import MARGIN_REFUSED, REPEATED, USED, Held, Inputs, Snapshot, encode

EAST, NORTH = row(Input(127)), row(Input(0, 127))
ONE = round(bounds(32).margin_one)


def snapshot(first: int, statuses: list[int], newest: int, *margins: int) -> Snapshot:
    packed = b"".join(margin.to_bytes(2, "little", signed=True) for margin in margins)
    return Snapshot(first + len(statuses) - 1, newest, packed, first, bytes(statuses), b"", b"", ())


def played(
    rows: str, sent: SentInputs | None = None, first: int = 1, received: int | None = None
) -> dict[int, list[Inputs | Held]]:
    """Returns what is sent in each tick for inputs by letter; `received`: newest tick that has arrived (None: all)."""
    sent = sent or SentInputs(32, 3)
    kinds, told = {"e": EAST, "n": NORTH}, {}
    for tick, letter in enumerate(rows, first):
        sent.arrived(snapshot(tick, [], tick - 1 if received is None else received))
        told[tick] = sent.send(tick, kinds[letter], [0.0], 0)
    return told  # type: ignore[return-value]


def test_an_input_that_stays_the_same_is_sent_every_second_tick_in_4_bytes() -> None:
    told = played("eeeeeen")
    assert told == {
        1: [Inputs(1, 0, EAST)],
        2: [Held(1, 2)],
        3: [],
        4: [Held(2, 4)],
        5: [],
        6: [Held(2, 6)],
        7: [Inputs(7, 0, NORTH)],
    }
    assert len(encode(Held(2, 40))) == 4


def test_an_input_that_the_server_may_lack_holds_by_a_message_in_every_tick() -> None:
    sent = SentInputs(32, 3)
    played("ee", sent)
    told = played("nnnn", sent, 3, received=2) | played("nnnn", sent, 7, received=3)
    assert told == {
        3: [Inputs(3, 0, NORTH)],
        **{tick: [Held(1, tick)] for tick in (4, 5, 6, 7)},
        8: [],
        9: [Held(2, 9)],
        10: [],
    }


def test_what_arrives_over_a_second_connection_may_be_missing_over_the_first() -> None:
    sent = SentInputs(32, 3)
    sent.send(1, EAST, [0.0], 0)
    sent.arrived(snapshot(1, [], 1), 1)
    assert played("eee", sent, 2, received=0) == {tick: [Held(1, tick)] for tick in (2, 3, 4)}


def test_inputs_that_change_in_every_tick_are_sent_as_before() -> None:
    assert played("enene") == {at: [Inputs(at, 0, EAST if at % 2 else NORTH)] for at in range(1, 6)}


@pytest.mark.parametrize("rate", [1, 8, 20, 23, 30, 32, 60, 120, 240])
def test_at_most_16_messages_a_second_and_each_holds_until_the_next(rate: int) -> None:
    sent, holds = SentInputs(rate, 3), bounds(rate).repeats
    told = list[int]()
    for tick in range(1, 10 * rate + 1):
        told += [tick] * len(sent.send(tick, EAST, [0.0], 0))
        sent.arrived(snapshot(tick, [], tick))
    assert len(told) <= max(16 * 10, 1) + 2
    assert all(later - one <= holds for one, later in pairwise(told))


def test_a_slow_program_says_for_several_ticks_at_once_that_an_input_holds() -> None:
    sent = SentInputs(32, 3)
    assert sent.send(1, EAST * 5, [0.0] * 5, 0) == [Inputs(1, 0, EAST * 5)]
    sent.arrived(snapshot(1, [], 5))
    assert sent.send(6, EAST * 5, [0.0] * 5, 0) == [Held(1, 6)]
    assert sent.send(11, EAST * 5, [0.0] * 5, 0) == [Held(5, 11)]
    assert sent.send(16, EAST * 40, [0.0] * 40, 0) == [
        Inputs(16, 0, EAST * 16),
        Inputs(32, 0, EAST * 16),
        Inputs(48, 0, EAST * 8),
    ], "that is longer than an input holds"


def test_after_a_restart_the_input_is_sent_itself() -> None:
    sent = SentInputs(32, 3)
    played("eee", sent)
    sent.restart()
    assert played("ee", sent, 4) == {4: [Inputs(4, 0, EAST)], 5: [Held(1, 5)]}


def test_a_client_behind_the_server_sends_its_inputs_themselves() -> None:
    sent = SentInputs(32, 3)
    sent.send(1, EAST, [0.0], 5)
    assert sent.send(2, EAST, [0.0], 5) == [Inputs(2, 5, EAST)]


def replaced(sent: SentInputs, told: Snapshot) -> int:
    """Returns what `SentInputs.replaced` counts after the margins of the snapshot were noted."""
    sent.arrived(told)
    return sent.replaced(told)


def test_a_change_that_has_not_arrived_was_not_used() -> None:
    sent = SentInputs(32, 3)
    played("eeenn", sent)
    assert replaced(sent, snapshot(3, [USED], 2)) == 0, "it holds"
    assert replaced(sent, snapshot(4, [USED], 2)) == 1
    assert replaced(sent, snapshot(3, [USED, USED, USED], 2)) == 2
    assert replaced(sent, snapshot(4, [REPEATED], 2)) == 0, "the status says it"
    assert replaced(sent, snapshot(4, [USED], 4, 100)) == 0


LATE = -3 * ONE // 2
"""Margin of an input that arrives one and a half ticks late: it is used two ticks later."""


def test_a_change_that_arrived_late_was_used_from_the_next_tick_on() -> None:
    sent = SentInputs(32, 3)
    played("eeennnnn", sent)
    assert replaced(sent, snapshot(3, [USED] * 5, 5, LATE, LATE + ONE)) == 2, "in the ticks 4 and 5"
    refused = SentInputs(32, 3)
    played("eeennnnn", refused)
    assert replaced(refused, snapshot(3, [USED] * 5, 5, MARGIN_REFUSED, LATE)) == 0


def test_the_margin_of_a_late_change_may_come_before_the_status_or_after_it() -> None:
    edge = SentInputs(32, 3)
    played("eeennnnnee", edge)
    assert replaced(edge, snapshot(2, [USED], 5, LATE, LATE + ONE)) == 0
    assert [replaced(edge, snapshot(tick, [USED], 8)) for tick in range(3, 9)] == [0, 1, 1, 0, 0, 0]
    one = SentInputs(32, 3)
    played("eeennnnnee", one)
    assert [replaced(one, snapshot(tick, [USED], 3)) for tick in range(3, 6)] == [0, 1, 1]
    assert replaced(one, snapshot(6, [USED] * 3, 8, LATE, 9, 9, 9, 9)) == 0


def test_inputs_that_are_sent_again_are_known_although_they_were_forgotten() -> None:
    sent = SentInputs(32, 3)
    played("eeennn", sent)
    sent.forget()
    played("n", sent, 7)
    sent.again(3, 7)
    assert [sent.has(tick) for tick in range(2, 9)] == [False, False, True, True, True, True, False]
    assert [arrival.tick for arrival in sent.arrived(snapshot(5, [], 7, 9, 9, 9))] == [7], "no time is known of others"
    assert replaced(sent, snapshot(5, [USED, USED], 5, 9)) == 1


def test_a_second_connection_has_margins_of_its_own() -> None:
    sent = SentInputs(32, 3)
    played("eeennnnn", sent)
    sent.arrived(snapshot(2, [], 5, LATE, LATE + ONE), 1)
    assert replaced(sent, snapshot(3, [USED] * 5, 5, 9)) == 0, "over the first, it was in time"
    sent.change_over()
    assert replaced(sent, snapshot(3, [USED] * 5, 5)) == 2
    sent.change_over()
    assert replaced(sent, snapshot(3, [USED] * 5, 5)) == 0


def test_ticks_without_a_message_get_needs_between_those_around_them() -> None:
    sent = SentInputs(32, 3)
    played("eeeeee", sent)
    assert list(sent.filled([(1, 5.0), (2, 6.0)], -1, 0.0, 3.0)) == [(1, 5.0), (2, 6.0)]
    assert list(sent.filled([(4, 7.0)], 2, 6.0, 3.0)) == [(3, 6.5), (4, 7.0)]
    assert list(sent.filled([(6, 7.0)], 2, 6.0, 3.0)) == [(6, 7.0)], "it is not known what became of tick 4"


def test_a_stall_is_as_long_as_with_a_message_per_tick() -> None:
    sent = SentInputs(32, 3)
    played("eeeeeeee", sent)
    # Ticks 4, 6 and 8 arrive together: that of tick 6 has revealed the loss of tick 4, a round trip before.
    # A message for tick 5 would have ended the stall a tick earlier.
    told = list(sent.filled([(4, 9.0), (6, 7.0), (8, 5.0)], 2, 1.0, 2.0))
    assert told == [(3, 4.5), (4, 8.0), (5, 7.0), (6, 6.0), (7, 5.5), (8, 5.0)]


def test_an_outage_is_as_long_as_the_messages_in_it_say() -> None:
    sent = SentInputs(32, 3)
    played("eeeeeeee", sent)
    # A round trip takes less than tick 6 was late by, so tick 6 was lost, too. That of tick 8 has revealed both.
    told = list(sent.filled([(4, 9.0), (6, 7.0), (8, 5.0)], 2, 1.0, 0.5))
    assert told == [(3, 5.0), (4, 9.0), (5, 8.0), (6, 7.0), (7, 6.0), (8, 5.0)]
