"""A player's events: when they are sent, in what order, and that each is sent or counted."""

import random

import pytest

from server.players.outbox import Outbox
from shared.messages import Happened, NextHappened, decode_from_server, encode

ALL = 1 << 20


def happened(number: int, length: int = 0) -> bytes:
    return encode(Happened(number, "n", bytes(length)))


def taken(outbox: Outbox, complete: int, room: int = ALL) -> list[int | str]:
    """Returns the ticks of the taken events; a `NextHappened` is given as a text."""
    messages = map(decode_from_server, outbox.take(complete, room))
    told: list[int | str] = []
    for message in messages:
        if isinstance(message, NextHappened):
            told.append(f"{message.number}")
        else:
            assert isinstance(message, Happened)
            told.append(message.tick)
    return told


def filled(*ticks: int, most: int = 100) -> Outbox:
    outbox = Outbox()
    for tick in ticks:
        outbox.add(tick, happened(tick), most)
    return outbox


def test_an_event_is_sent_when_its_tick_is_known_and_in_order() -> None:
    outbox = filled(5, 5, 7, 9)
    assert taken(outbox, 4) == []
    assert taken(outbox, 6) == [5, 5]
    assert taken(outbox, 6) == []
    assert taken(outbox, 9) == [7, 9]
    assert not outbox.due


def test_the_bytes_of_events_are_limited_but_one_is_always_sent() -> None:
    outbox = filled(*range(10))
    size = len(happened(0))
    assert taken(outbox, 99, 2 * size) == [0, 1]
    assert taken(outbox, 99, 0) == [2]
    assert taken(outbox, 99, -5) == [3]
    assert taken(outbox, 99, 3 * size - 1) == [4, 5, 6]


def test_the_oldest_of_too_many_are_dropped_and_the_next_number_is_sent() -> None:
    outbox = filled(*range(10), most=4)
    assert len(outbox) == 4
    assert taken(outbox, 0) == ["6"], "at once, although no event may be sent yet"
    assert taken(outbox, 99) == [6, 7, 8, 9]
    assert outbox.add(10, happened(10), 4) is False


def test_after_a_reconnect_the_next_number_is_sent_once() -> None:
    outbox = filled(1, 2, 3)
    assert taken(outbox, 2) == [1, 2]
    outbox.reconnect()
    assert outbox.due
    assert taken(outbox, 2) == ["2"]
    assert taken(outbox, 3) == [3]


@pytest.mark.parametrize("seed", range(5))
def test_each_event_is_sent_once_or_counted_once(seed: int) -> None:
    rng, outbox = random.Random(seed), Outbox()
    expected = missed = sent = 0
    for tick in range(1000):
        for _ in range(rng.randrange(4)):
            outbox.add(tick, happened(tick), 8)
            sent += 1
        if rng.random() < 0.3 or tick == 999:
            complete, room = tick - rng.randrange(5), rng.choice((0, 20, ALL))
            for message in map(decode_from_server, outbox.take(*((complete, room) if tick < 999 else (tick, ALL)))):
                if isinstance(message, NextHappened):
                    missed += message.number - expected
                    expected = message.number
                else:
                    expected += 1
    assert missed > 100
    assert expected == sent
