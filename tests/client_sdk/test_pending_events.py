"""Pending events are bounded, in order, and counted where they were dropped."""

import random

import pytest

from client_sdk import pending_events
from client_sdk.events import (
    Announced,
    Answered,
    Disconnected,
    Event,
    EventsDropped,
    Happened,
    Joined,
    Left,
    Resumed,
    SegmentLoaded,
)
from client_sdk.pending_events import GameEvents, PendingEvents
from shared import messages
from shared.scene import load_scene

FLAT = load_scene("flat")


@pytest.fixture(autouse=True)
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pending_events, "EVENTS_MAX", 3)


def game(*numbers: int) -> list[Event]:
    return [Happened(0, "n", number) for number in numbers]


def filled(*events: Event) -> PendingEvents:
    queue = PendingEvents()
    for event in events:
        queue.append(event)
    return queue


def test_events_come_in_order_and_once() -> None:
    events = [Joined(1, FLAT, 0), *game(1), Answered(1, True, "done"), *game(2)]
    queue = filled(*events)
    assert queue.take() == events
    assert queue.take() == []


def test_the_oldest_of_too_many_are_counted_in_their_place() -> None:
    answered = Answered(1, True, "done")
    queue = filled(Joined(1, FLAT, 0), *game(1), answered, *game(*range(2, 10)))
    assert queue.take() == [Joined(1, FLAT, 0), EventsDropped(7), answered, *game(8, 9)]
    for event in game(*range(4)):
        queue.append(event)
    assert queue.take() == [EventsDropped(2), *game(2, 3)], "events that were taken do not count any more"


def test_what_the_server_dropped_is_added_up_with_what_is_dropped_here() -> None:
    assert filled(EventsDropped(5), *game(*range(4))).take() == [EventsDropped(7), *game(2, 3)]
    assert filled(*game(1, 2), EventsDropped(5), *game(3)).take() == [EventsDropped(2), EventsDropped(5), *game(3)]


def test_events_of_the_game_push_none_of_the_sdk_out_and_the_other_way_round() -> None:
    loaded = [SegmentLoaded((number, 0, 0)) for number in range(9)]
    events = filled(*loaded, *game(1, 2)).take()
    assert events == [EventsDropped(6), *loaded[-3:], *game(1, 2)]
    events = filled(*game(1, 2, 3), *loaded).take()
    assert events == [EventsDropped(2), *game(3), EventsDropped(6), *loaded[-3:]]


def test_events_of_a_beginning_or_an_end_are_never_dropped() -> None:
    back: list[Event] = [Disconnected("gone", 1.0), Resumed(5, 2.0)]
    lasting: list[Event] = [Joined(1, FLAT, 0), *back * 20, Left(1000, "over")]
    queue = PendingEvents()
    for event in lasting:
        others: list[Event] = [*game(1, 2, 3), event, SegmentLoaded((0, 0, 0)), Answered(1, True, "done")]
        for other in others:
            queue.append(other)
    assert len(queue) <= len(lasting) + 2 * 3
    assert [event for event in queue.take() if type(event) in (Joined, Disconnected, Resumed, Left)] == lasting


@pytest.mark.parametrize("seed", range(5))
def test_one_by_one_or_all_at_once_nothing_is_missing_that_was_not_counted(seed: int) -> None:
    rng, queue = random.Random(seed), PendingEvents()
    sent = dropped = there = 0

    def look(event: Event) -> None:
        nonlocal dropped, there
        if isinstance(event, EventsDropped):
            dropped += event.count
        else:
            there += 1

    for _ in range(500):
        queue.append(rng.choice((Happened(0, "n", 1), SegmentLoaded((0, 0, 0)))))
        sent += 1
        if rng.random() < 0.1:
            look(queue.next())
        if rng.random() < 0.02:
            for event in queue.take():
                look(event)
    for event in queue.take():
        look(event)
    assert there + dropped == sent
    assert dropped > 0
    with pytest.raises(IndexError):
        queue.next()


def test_announcements_without_numbers_that_may_be_missing_are_reported() -> None:
    events = PendingEvents()
    game = GameEvents(events)
    announce, happened = messages.Announce(1, 7, "hit", b"\xc0"), messages.Happened(1, "did", b"\xc0")
    game.apart = True
    game.next(0, hold=False)
    game.happened(happened, hold=False)
    game.next(1, hold=False)
    assert not any(isinstance(event, EventsDropped) for event in events.take()), "there was no announcement yet"
    game.happened(announce, hold=False)
    game.next(1, hold=False, sure=True)
    assert [type(event) for event in events.take()] == [Announced], "a hand-over misses none"
    game.next(1, hold=False)
    game.next(4, hold=False)
    assert events.take() == [EventsDropped(0), EventsDropped(3)]
