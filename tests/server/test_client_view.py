"""The parts of a client's snapshot where not everything fits."""

from itertools import groupby

import pytest

from server.replication.client_view import ClientView
from shared.bounds import bounds
from shared.checks import Cell
from shared.snapshot import KEYFRAME

OWN, NEAR, FAR = (0, 0, 0), (1, 0, 0), (2, 0, 0)
ROW = [OWN, NEAR, FAR]

HISTORY = bounds(32).history


class Log:
    """A stand-in for the change log: every segment changes in every tick, and the length of each part is given."""

    history = HISTORY

    def __init__(self, sizes: dict[Cell, int]) -> None:
        self.sizes = sizes
        self.asked: list[tuple[Cell, int]] = []

    def since(self, since: int) -> "Parts":
        return Parts(self, since)


class Parts:
    def __init__(self, log: Log, since: int) -> None:
        self.log, self.since, self.changed = log, since, ROW

    def __getitem__(self, segment: Cell) -> bytes:
        self.log.asked.append((segment, self.since))
        return bytes([ROW.index(segment)]) * self.log.sizes[segment]

    def together(self, segments: tuple[Cell, ...]) -> tuple[int, bytes]:
        parts = [self[segment] for segment in segments]
        return len(parts), b"".join(parts)


def seeing(see: int = 2) -> ClientView:
    view = ClientView()
    view.move(tuple(ROW), see)
    return view


def take(view: ClientView, log: Log, tick: int, room: int) -> list[Cell]:
    log.asked.clear()
    n, parts = view.take(log, tick, room)  # type: ignore[arg-type]
    taken = [ROW[first] for first, _ in groupby(parts)]
    assert len(taken) == n
    return taken


def test_the_complete_tick_is_that_up_to_which_every_seen_segment_has_been_sent() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    assert view.complete_tick == -2
    assert take(view, log, 5, 20) == [OWN, NEAR]
    assert view.complete_tick == -2, "nothing is known of one segment"
    assert take(view, log, 6, 100) == [FAR, OWN, NEAR] or view.complete
    assert view.complete_tick == 6
    log.sizes[FAR] = 1000
    assert FAR not in take(view, log, 7, 20)
    assert view.complete_tick == 6
    assert FAR in take(view, log, 9, 2000)
    assert view.complete_tick == 9


def test_a_segment_that_comes_into_view_limits_the_complete_tick_from_then_on() -> None:
    view, log = ClientView(), Log(dict.fromkeys(ROW, 10))
    view.move((OWN,), 2, 4)
    take(view, log, 5, 100)
    assert view.complete_tick == 5
    view.move(tuple(ROW), 2, 8)
    assert FAR not in take(view, log, 8, 20)
    assert view.complete_tick == 7
    assert FAR in take(view, log, 9, 2000)
    assert view.complete_tick == 9
    view.forget()
    assert view.complete_tick == -2


def test_everything_goes_where_it_fits_first_whole_and_then_its_changes() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    assert sorted(take(view, log, 5, 100)) == ROW
    assert set(log.asked) == {(segment, KEYFRAME) for segment in ROW}
    assert sorted(take(view, log, 6, 100)) == ROW
    assert set(log.asked) == {(segment, 5) for segment in ROW}


def test_the_own_segment_always_goes_and_one_more_however_little_room_there_is() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 1000))
    others = set()
    for tick in range(1, 200):
        own, other = take(view, log, tick, 10)
        assert own == OWN
        others.add(other)
        assert view.waits(tick) < 8
    assert others == {NEAR, FAR}


def test_a_waiting_segment_is_sent_since_its_last_tick_and_none_starves() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    take(view, log, 1, 100)
    latest = dict.fromkeys(ROW, 1)
    longest = dict.fromkeys(ROW, 0)
    for tick in range(2, 300):
        for segment in take(view, log, tick, 20):
            longest[segment] = max(longest[segment], tick - latest[segment])
            latest[segment] = tick
        assert not view.lost_track(tick + 1, HISTORY)
    assert longest[OWN] == 1
    assert longest[OWN] <= longest[NEAR] <= longest[FAR] < 8


def test_a_part_is_asked_for_since_the_tick_it_was_sent_last() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    take(view, log, 1, 100)
    sent = dict.fromkeys(ROW, 1)
    for tick in range(2, 50):
        chosen = take(view, log, tick, 20)
        assert dict(log.asked) == sent
        sent |= dict.fromkeys(chosen, tick)


@pytest.mark.parametrize("ticks", [HISTORY, HISTORY + 1])
def test_a_client_that_is_too_far_behind_has_lost_track(ticks: int) -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    take(view, log, 1, 100)
    assert view.lost_track(1 + ticks, HISTORY) == (ticks > HISTORY)
    view.forget()
    assert not view.lost_track(1 + ticks, HISTORY)
    take(view, log, 1 + ticks, 100)
    assert {since for _, since in log.asked} == {KEYFRAME}


def test_only_sent_segments_that_are_no_longer_seen_are_dropped() -> None:
    view, log = seeing(), Log(dict.fromkeys(ROW, 10))
    take(view, log, 1, 10)  # the client knows its own segment and one more
    view.move(((20, 0, 0),), 2)
    assert view.drops == [OWN, NEAR]
    assert view.sees == {(20, 0, 0)}
