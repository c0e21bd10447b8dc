"""One input per tick: the status and the margin of each are exact, whatever a client sends."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client_sdk.sent_inputs import SentInputs
from server.game.session import Session
from server.players.input_queue import InputQueue
from shared.bounds import bounds
from shared.fields import INPUT_ROWS_MAX, TICK_MAX
from shared.inputs import NEUTRAL, Input, clamp, row
from shared.messages import IDLE, MARGIN_REFUSED, NEUTRALISED, REPEATED, USED, Held, Inputs

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


# -- inputs that hold -------------------------------------------------------------------------------------------


def test_an_input_that_holds_is_used_without_rows_and_ends_as_one_that_is_repeated() -> None:
    rows, queue = filed(1, EAST, EAST), filed(1, EAST)
    queue.hold(Held(1, 0), 0, 1.0)
    taken = [queue.take(tick) for tick in range(1, 8 + REPEATS_MAX)]
    assert taken == [rows.take(tick) for tick in range(1, 8 + REPEATS_MAX)]
    assert taken == [EAST] * (2 + REPEATS_MAX) + [NEUTRAL] * 5
    assert list(queue.statuses) == [USED] * (2 + REPEATS_MAX) + [NEUTRALISED] * 5
    assert (queue.used, queue.substituted, queue.late) == (2 + REPEATS_MAX, 5, 0)


def test_a_row_replaces_an_input_that_holds_from_its_tick_on() -> None:
    queue = filed(1, EAST)
    queue.hold(Held(1, 0), 0, 1.0)
    queue.file(inputs(4, NORTH), 1, 1.0)
    assert [queue.take(tick) for tick in range(1, 7)] == [EAST] * 3 + [NORTH] * 3
    assert list(queue.statuses) == [USED] * 4 + [REPEATED] * 2, "the first input does not hold after the second"
    queue.hold(Held(1, 0), 6, 1.0)
    assert queue.late == 2


def test_a_late_row_is_what_holds_from_then_on() -> None:
    queue = filed(1, EAST)
    queue.hold(Held(1, 0), 0, 1.0)
    assert [queue.take(tick) for tick in range(1, 5)] == [EAST] * 4
    queue.file(inputs(3, NORTH), 4, 0.5)
    queue.hold(Held(1, 0), 4, 0.5)
    assert [queue.take(tick) for tick in range(5, 13)] == [NORTH] * 8
    assert list(queue.statuses)[:11] == [USED] * 11, "nothing was missing: the client knows by the margin"
    assert margins(queue)[3] == round(-1.5 * MARGIN_ONE)
    assert queue.late == 2, "the row of tick 3, and that it held in tick 4"


def test_a_late_message_about_ticks_in_which_the_input_held_anyway_is_not_a_late_input() -> None:
    queue = filed(1, EAST)
    queue.hold(Held(1, 0), 0, 1.0)
    for tick in range(1, 5):
        queue.take(tick)
    queue.hold(Held(2, 0), 4, 1.0)
    assert queue.late == 0
    assert queue.margins[-1] < 0, "the client steers by it all the same"
    end = 4 + REPEATS_MAX
    for tick in range(5, end + 4):
        queue.take(tick)
    queue.hold(Held(end - 3, 0), end + 3, 1.0)
    assert (queue.newest, queue.late, queue.substituted) == (end + 1, 3, 3)
    assert queue.take(end + 4) == EAST, "it holds again"


def test_ticks_without_a_message_get_no_margins_but_between_two() -> None:
    queue = filed(1, EAST)
    queue.hold(Held(1, 0), 0, 1.0)
    assert list(margins(queue)) == [1, 2]
    queue.take_feedback()
    queue.hold(Held(2, 0), 1, 1.0)
    assert list(margins(queue)) == [4]
    queue.hold(Held(2, 0), 2, 1.0)
    assert margins(queue)[5] == MARGIN_REFUSED
    assert margins(queue).keys() == {4, 5, 6}


def test_what_holds_goes_on_after_a_restart_until_a_row_replaces_it() -> None:
    queue = filed(1, EAST, NORTH, NORTH)
    queue.hold(Held(1, 0), 0, 1.0)
    queue.restart(2)
    assert [queue.take(tick) for tick in range(1, 5)] == [EAST] * 4
    queue.file(inputs(2, WEST, WEST, WEST, WEST), 4, 1.0)
    assert [queue.take(tick) for tick in range(5, 7)] == [WEST] * 2
    assert list(queue.statuses) == [USED] * 5 + [REPEATED]


def test_an_input_does_not_hold_from_too_far_ahead() -> None:
    queue = filed(1, EAST)
    for _ in range(AHEAD_MAX // 64 + 2):
        queue.hold(Held(64, 0), 0, 1.0)
    assert queue.margins[-1] == MARGIN_REFUSED
    assert queue.held_to <= AHEAD_MAX + REPEATS_MAX
    queue.newest = TICK_MAX
    queue.hold(Held(1, 0), 0, 1.0)
    assert queue.newest == TICK_MAX


def test_after_an_input_that_was_refused_nothing_holds_until_one_is_accepted() -> None:
    queue = filed(1, EAST)
    queue.file(inputs(2, *[NORTH] * AHEAD_MAX), 0, 1.0)
    refused = AHEAD_MAX + 1
    assert (queue.accepted, queue.newest, queue.refused) == (AHEAD_MAX, refused, 1)
    queue.file(inputs(refused, WEST), 0, 1.0)
    queue.hold(Held(1, 0), 60, 1.0)
    assert (queue.newest, queue.held_to, queue.refused) == (refused + 1, -1, 3), "the server has WEST from nowhere"
    assert queue.margins[-1] == MARGIN_REFUSED
    queue.hold(Held(1, 0), 61, 1.0)
    assert queue.margins[-1] == MARGIN_REFUSED
    queue.file(inputs(refused + 3, WEST), 62, 1.0)
    queue.hold(Held(1, 0), 62, 1.0)
    assert queue.margins[-1] > 0
    assert queue.held_to == refused + 4 + REPEATS_MAX


def test_nothing_holds_before_the_first_input() -> None:
    queue = InputQueue(LIMITS)
    queue.hold(Held(5, 0), 0, 1.0)
    assert (queue.held_to, queue.refused, margins(queue)) == (-1, 1, {4: MARGIN_REFUSED})
    assert [queue.take(tick) for tick in range(1, 4)] == [NEUTRAL] * 3
    queue.file(inputs(5, EAST), 3, 1.0)
    queue.hold(Held(1, 0), 3, 1.0)
    assert queue.held_to == 6 + REPEATS_MAX


@given(st.lists(st.sampled_from([EAST, NORTH, WEST]), min_size=1, max_size=60), st.integers(1, 240))
def test_inputs_that_are_left_out_are_the_same_for_the_server(wishes: list[Input], rate: int) -> None:
    every, some = InputQueue(bounds(rate)), InputQueue(bounds(rate))
    sent = SentInputs(rate, 3)
    for tick, wish in enumerate(wishes, 1):
        every.file(inputs(tick, wish), tick - 1, 1.0)
        for message in sent.send(tick, row(wish), [0.0], tick - 3):
            if isinstance(message, Held):
                assert some.newest + message.after - message.behind == tick - 3
                some.hold(message, tick - 1, 1.0)
            else:
                assert isinstance(message, Inputs)
                some.file(message, tick - 1, 1.0)
        assert some.coming(tick) == every.coming(tick) == some.take(tick) == every.take(tick) == wish
    assert some.statuses == every.statuses
    assert (some.used, some.late, some.substituted) == (every.used, every.late, every.substituted)
