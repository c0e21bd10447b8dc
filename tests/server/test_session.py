"""One input per tick: the status and the margin of each are exact, whatever a client sends."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.game.session import Session
from server.players.input_queue import InputQueue
from shared.bounds import bounds
from shared.fields import INPUT_ROWS_MAX, TICK_MAX
from shared.inputs import NEUTRAL, Input, clamp, row
from shared.messages import IDLE, MARGIN_REFUSED, NEUTRALISED, REPEATED, USED, Inputs

LIMITS = bounds(32)
AHEAD_MAX, REPEATS_MAX, STATUSES_MAX, MARGIN_ONE = LIMITS.ahead, LIMITS.repeats, LIMITS.statuses, LIMITS.margin_one
EAST, NORTH, WEST = Input(127, 0, 0), Input(0, 127, 1), Input(-127, 0, 255)


def inputs(first: int, *wishes: Input) -> Inputs:
    return Inputs(first, -1, b"".join(map(row, wishes)))


def filed(first: int, *wishes: Input, tick: int = 0, ahead: float = 1.0) -> InputQueue:
    queue = InputQueue()
    queue.file(inputs(first, *wishes), tick, ahead)
    return queue


def margins(queue: InputQueue) -> dict[int, int]:
    """Returns the margins by tick, counted back from the newest as a client does."""
    return {queue.newest - len(queue.margins) + 1 + i: margin for i, margin in enumerate(queue.margins)}


# -- statuses ---------------------------------------------------------------------------------------------------


def test_before_the_first_input_the_player_stands_and_is_idle() -> None:
    queue = InputQueue()
    assert [queue.take(tick) for tick in range(1, 4)] == [NEUTRAL] * 3
    queue.file(inputs(6, EAST), 3, 1.0)
    assert [queue.take(tick) for tick in range(4, 7)] == [NEUTRAL, NEUTRAL, EAST]
    assert list(queue.statuses) == [IDLE] * 5 + [USED]
    assert (queue.used, queue.substituted) == (1, 0)


def test_each_input_is_used_in_its_tick_and_once() -> None:
    queue = filed(1, EAST, NORTH, WEST)
    assert [queue.take(tick) for tick in (1, 2, 3)] == [EAST, NORTH, WEST]
    assert list(queue.statuses) == [USED] * 3
    assert queue.used == 3


def test_a_missing_input_repeats_the_last_one_ten_times_and_then_is_neutral() -> None:
    queue = filed(1, EAST)
    taken = [queue.take(tick) for tick in range(1, 15)]
    assert taken == [EAST] * (1 + REPEATS_MAX) + [NEUTRAL] * 3
    assert list(queue.statuses) == [USED] + [REPEATED] * 10 + [NEUTRALISED] * 3
    assert (queue.used, queue.substituted) == (1, 13)


def test_an_input_after_a_silence_starts_the_count_of_repeats_anew() -> None:
    queue = filed(1, EAST)
    for tick in range(1, 16):
        queue.take(tick)
    queue.file(inputs(16, NORTH), 15, 1.0)
    assert [queue.take(tick) for tick in range(16, 28)] == [NORTH] * 11 + [NEUTRAL]
    assert list(queue.statuses)[15:] == [USED] + [REPEATED] * 10 + [NEUTRALISED]


def test_a_late_input_is_not_used_but_is_what_is_repeated_from_then_on() -> None:
    queue = filed(1, EAST)
    assert [queue.take(1), queue.take(2)] == [EAST, EAST]
    queue.file(inputs(2, NORTH), 2, 0.5)
    assert queue.take(3) == NORTH
    assert (queue.late, list(queue.statuses)) == (1, [USED, REPEATED, REPEATED])


def test_a_late_input_does_not_replace_the_one_of_the_tick() -> None:
    queue = filed(1, EAST)
    queue.take(1)
    queue.take(2)
    queue.file(inputs(2, NORTH, WEST), 2, 1.0)
    assert queue.take(3) == WEST


def test_a_first_input_that_is_late_ends_idleness() -> None:
    queue = filed(5, EAST, tick=9)
    assert queue.take(10) == EAST
    assert (list(queue.statuses), queue.late) == ([REPEATED], 1)


# -- what is refused -----------------------------------------------------------------------------------------


def test_the_first_input_for_a_tick_counts() -> None:
    queue = filed(1, EAST, EAST)
    queue.file(inputs(1, NORTH, NORTH, WEST), 0, 1.0)
    assert [queue.take(tick) for tick in (1, 2, 3)] == [EAST, EAST, WEST]
    assert queue.refused == 2


def test_a_tick_that_was_left_out_cannot_be_given_later() -> None:
    queue = filed(3, EAST)
    queue.file(inputs(1, NORTH, NORTH), 0, 1.0)
    assert [queue.take(tick) for tick in (1, 2, 3)] == [NEUTRAL, NEUTRAL, EAST]
    assert (queue.refused, queue.first) == (2, 3)


def test_the_far_future_is_refused_from_its_first_tick_on() -> None:
    queue = filed(100 + AHEAD_MAX, EAST, NORTH, WEST, tick=100)
    assert (queue.refused, queue.newest, queue.first) == (2, 102 + AHEAD_MAX, 100 + AHEAD_MAX)
    for tick in range(101, 100 + AHEAD_MAX):
        assert queue.take(tick) == NEUTRAL
    assert [queue.take(100 + AHEAD_MAX + i) for i in range(3)] == [EAST] * 3
    assert list(queue.statuses)[-3:] == [USED, REPEATED, REPEATED]


def test_all_that_may_be_ahead_fits_without_loss() -> None:
    wishes = [Input(i, -i, i) for i in range(AHEAD_MAX)]
    queue = filed(8, *wishes, tick=7)
    assert [queue.take(8 + i) for i in range(AHEAD_MAX)] == wishes


def test_a_direction_that_is_too_long_is_shortened_by_the_rule_of_both_sides() -> None:
    for input_ in (Input(127, 127, 1), Input(-128, 0, 0), Input(-128, -128, 255), Input(100, -100, 2)):
        queue = filed(1, input_)
        assert queue.take(1) == clamp(input_) != input_


def test_a_message_without_rows_changes_nothing() -> None:
    queue = filed(TICK_MAX)
    assert (queue.first, queue.newest, queue.refused, len(queue.margins)) == (-1, -1, 0, 0)


# -- inputs that are withdrawn -------------------------------------------------------------------------------


def test_inputs_that_have_not_been_used_can_be_withdrawn_and_sent_anew() -> None:
    queue = filed(1, EAST, EAST, EAST, EAST)
    assert queue.take(1) == EAST
    queue.restart(3)
    assert (queue.newest, list(margins(queue))) == (2, [1, 2])
    queue.file(inputs(3, NORTH, NORTH, NORTH), 1, 1.0)
    assert [queue.take(tick) for tick in (2, 3, 4, 5)] == [EAST, NORTH, NORTH, NORTH]
    assert (queue.refused, queue.used, queue.late) == (0, 5, 0)
    assert list(margins(queue)) == [1, 2, 3, 4, 5]


def test_used_inputs_stay_used() -> None:
    queue = filed(1, EAST, EAST, EAST)
    assert [queue.take(tick) for tick in (1, 2)] == [EAST, EAST]
    queue.restart(1)
    assert queue.take(3) == EAST, "withdrawn, so the newest one is repeated"
    assert list(queue.statuses) == [USED, USED, REPEATED]
    queue.file(inputs(1, NORTH, NORTH, NORTH), 3, 1.0)
    assert (queue.late, queue.take(4)) == (3, NORTH)


def test_nothing_is_withdrawn_where_there_is_nothing() -> None:
    queue = InputQueue()
    queue.restart(0)
    assert (queue.first, queue.newest) == (-1, -1)
    queue = filed(1, EAST, EAST)
    queue.restart(3)
    assert (queue.newest, [queue.take(tick) for tick in (1, 2)]) == (2, [EAST, EAST])


def test_margins_that_were_sent_are_not_counted_off_again() -> None:
    queue = filed(1, EAST, EAST, EAST, EAST)
    queue.take_feedback()
    queue.file(inputs(5, EAST), 0, 1.0)
    queue.restart(3)
    assert (queue.newest, list(queue.margins)) == (2, [])
    queue.file(inputs(3, NORTH), 0, 1.0)
    assert margins(queue) == {3: 3 * MARGIN_ONE}


@pytest.mark.parametrize("rate", [4, 20, 32, 60, 128, 240])
def test_a_margin_holds_four_seconds_at_every_rate(rate: int) -> None:
    limits = bounds(rate)
    queue = InputQueue(limits)
    queue.file(inputs(limits.ahead, EAST), 0, 1.0)
    (margin,) = queue.margins
    assert margin / limits.margin_one == pytest.approx(limits.ahead, abs=1 / limits.margin_one)
    late = InputQueue(limits)
    late.file(inputs(1, EAST), 1 + 3 * rate, 0.0)
    assert late.margins[0] / limits.margin_one == pytest.approx(-3 * rate - 1, abs=1.0)


# -- margins -------------------------------------------------------------------------------------------------


def test_a_margin_is_the_time_to_the_deadline_of_the_inputs_own_tick() -> None:
    queue = filed(11, EAST, EAST, EAST, tick=10, ahead=0.25)
    assert margins(queue) == {11: 64, 12: 64 + MARGIN_ONE, 13: 64 + 2 * MARGIN_ONE}


def test_a_late_input_has_a_negative_margin_however_little_it_is_late() -> None:
    assert margins(filed(10, EAST, tick=10, ahead=0.5)) == {10: -128}
    assert margins(filed(10, EAST, tick=10, ahead=1.0)) == {10: -1}
    assert margins(filed(10, EAST, tick=10, ahead=0.999)) == {10: -1}
    assert margins(filed(1, EAST, tick=500, ahead=0.0)) == {1: MARGIN_REFUSED + 1}


def test_an_input_that_a_late_tick_still_takes_may_have_a_negative_margin() -> None:
    queue = filed(11, EAST, tick=10, ahead=-0.5)
    assert (margins(queue), queue.late, queue.take(11)) == ({11: -128}, 0, EAST)


def test_margins_count_off_across_gaps_and_refusals() -> None:
    queue = filed(3, EAST)
    queue.file(inputs(6, EAST), 0, 1.0)
    queue.file(inputs(AHEAD_MAX + 2, EAST, EAST), 0, 1.0)
    told = margins(queue)
    assert told[3] == 3 * MARGIN_ONE
    assert [told[tick] for tick in (4, 5)] == [MARGIN_REFUSED] * 2
    assert told[6] == 6 * MARGIN_ONE
    assert {told[tick] for tick in range(7, AHEAD_MAX + 4)} == {MARGIN_REFUSED}
    assert max(told) == queue.newest == AHEAD_MAX + 3


def test_feedback_is_sent_once_and_counting_goes_on() -> None:
    queue = filed(1, EAST)
    queue.take(1)
    queue.take_feedback()
    assert (list(queue.margins), list(queue.statuses)) == ([], [])
    queue.file(inputs(4, EAST), 1, 1.0)
    assert list(margins(queue)) == [2, 3, 4]
    assert queue.take(2) == EAST
    assert list(queue.statuses) == [REPEATED]


# -- any client ----------------------------------------------------------------------------------------------

MESSAGES = st.tuples(
    st.one_of(st.integers(0, 200), st.sampled_from([TICK_MAX - 64, 1 << 40])), st.integers(0, INPUT_ROWS_MAX)
)


@given(st.lists(st.tuples(st.lists(MESSAGES, max_size=3), st.booleans()), max_size=80))
def test_every_input_of_any_client_has_one_status_and_memory_is_bounded(
    ticks: list[tuple[list[tuple[int, int]], bool]],
) -> None:
    queue, sent, told = InputQueue(), 0, 0
    for tick, (messages, snapshot) in enumerate(ticks, 1):
        for first, rows in messages:
            queue.file(inputs(first, *[EAST] * rows), tick - 1, 0.5)
            sent += rows
            assert sent >= queue.refused + queue.late + queue.used
        coming = queue.coming(tick)
        assert queue.coming(tick) is coming, "it changes nothing"
        assert queue.take(tick) is coming
        assert coming in (EAST, NEUTRAL)
        assert len(queue.margins) <= STATUSES_MAX
        assert len(queue.statuses) == tick - told
        if snapshot:
            queue.take_feedback()
            told = tick
    assert set(queue.waiting) <= set(range(len(ticks) + 1, len(ticks) + AHEAD_MAX + 1))
    assert sent == queue.used + queue.late + queue.refused + len(queue.waiting)


def test_a_flood_into_the_future_holds_no_more_than_the_window() -> None:
    queue = InputQueue()
    for first in range(0, 1 << 20, 1 << 10):
        queue.file(inputs(first, *[EAST] * INPUT_ROWS_MAX), 0, 1.0)
    assert len(queue.waiting) <= AHEAD_MAX
    assert len(queue.margins) == STATUSES_MAX
    assert queue.refused == 64 * 1024 - (INPUT_ROWS_MAX - 1) - 1


# -- a session -----------------------------------------------------------------------------------------------


class Closings:
    """A link that records how it is closed."""

    def __init__(self) -> None:
        self.closings: list[tuple[int, str]] = []

    def send(self, message: bytes) -> None: ...

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        self.closings.append((code, reason))


def test_a_session_closes_its_link_once() -> None:
    link = Closings()
    session = Session(link, 0.0)
    session.close(4003, "first")
    session.close(4005, "second")
    assert (session.closed, link.closings) == (True, [(4003, "first")])
