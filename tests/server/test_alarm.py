"""The shared timer with a simulated timer and clock; all kinds of alarms once in real time."""

import asyncio
import time
from collections.abc import Callable

import pytest

from server.runtime.alarm import ROUND_S, Alarm, LoopAlarm, SharedTimer, TimerfdAlarm, best_alarm
from tests.patience import PATIENCE_S


class Timer:
    """A timer that rings when the test says so."""

    def __init__(self, ring: Callable[[], None]) -> None:
        self.ring = ring
        self.at: float | None = None
        self.closed = False

    def set(self, at: float) -> None:
        self.at = at

    def close(self) -> None:
        self.closed = True


class Bench:
    """A shared timer on simulated timers.

    Attributes:
        rung: names of the alarms that have rung, with the time.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self.timers: list[Timer] = []
        self.rung: list[tuple[str, float]] = []
        self.shared = SharedTimer(self._timer, lambda: self.now)

    def _timer(self, ring: Callable[[], None]) -> Timer:
        self.timers.append(Timer(ring))
        return self.timers[-1]

    def alarm(self, name: str, at: float, then: Callable[[], object] = lambda: None) -> Alarm:
        """Sets a new alarm, which calls `then` when it rings."""

        def ring() -> None:
            self.rung.append((name, self.now))
            then()

        alarm = self.shared.alarm(ring)
        alarm.set(at)
        return alarm

    def ring(self, at: float) -> list[str]:
        """Lets the timer ring at a time. Returns the names of the alarms that have rung then."""
        self.now, self.rung = at, []
        self.timers[-1].ring()
        return [name for name, _ in self.rung]


def test_the_timer_rings_for_the_earliest_alarm_and_all_that_are_due_ring_in_order() -> None:
    bench = Bench()
    for name, at in (("c", 3.0), ("a", 1.0), ("d", 4.0), ("b", 2.0)):
        bench.alarm(name, at)
    (timer,) = bench.timers
    assert timer.at == 1.0
    assert bench.ring(0.5) == []
    assert timer.at == 1.0
    assert bench.ring(3.0) == ["a", "b", "c"]
    assert timer.at == 4.0
    assert bench.ring(4.0) == ["d"]


def test_an_alarm_that_is_set_to_the_past_while_it_rings_lets_the_event_loop_go_on_first() -> None:
    bench = Bench()
    alarms: list[Alarm] = []
    alarms.append(bench.alarm("behind", 1.0, lambda: alarms[0].set(1.5)))
    alarms.append(bench.alarm("other", 2.0, lambda: alarms[1].set(3.0)))
    assert bench.ring(2.5) == ["behind", "other"]
    assert bench.timers[0].at == 1.5
    assert bench.ring(2.5) == ["behind"]


def test_after_some_time_of_ringing_the_event_loop_goes_on_and_the_earliest_alarms_ring_first() -> None:
    bench = Bench()

    def work(seconds: float) -> None:
        bench.now += seconds

    alarms = [bench.alarm(str(n), n / 1000, lambda: work(0.4 * ROUND_S)) for n in range(7)]
    assert bench.ring(1.0) == ["0", "1", "2"]
    alarms[0].set(0.0035)  # it is behind
    assert bench.timers[0].at == 0.003
    assert bench.ring(1.1) == ["3", "0", "4"]
    assert bench.ring(1.2) == ["5", "6"]


def test_the_latest_time_of_an_alarm_counts() -> None:
    bench = Bench()
    alarm = bench.alarm("a", 5.0)
    alarm.set(2.0)
    assert bench.timers[0].at == 2.0
    assert bench.ring(2.0) == ["a"]
    alarm.set(9.0)
    assert bench.ring(5.0) == []
    assert bench.ring(9.0) == ["a"]


def test_an_alarm_that_raises_delays_the_others_until_the_timer_rings_again_at_once() -> None:
    bench = Bench()

    def fail() -> None:
        raise ZeroDivisionError

    bench.alarm("a", 1.0)
    bench.alarm("fails", 2.0, fail)
    bench.alarm("b", 3.0)
    bench.alarm("c", 9.0)
    with pytest.raises(ZeroDivisionError):
        bench.ring(3.0)
    assert [name for name, _ in bench.rung] == ["a", "fails"]
    assert bench.timers[0].at == 3.0
    assert bench.ring(3.0) == ["b"]
    assert bench.timers[0].at == 9.0


def test_closed_alarms_do_not_ring_and_the_last_one_closes_the_timer() -> None:
    bench = Bench()
    last = bench.alarm("last", 2.0)
    bench.alarm("first", 1.0, last.close).close()
    bench.alarm("closing", 1.0, last.close)
    assert bench.ring(2.0) == ["closing"]
    assert not bench.timers[0].closed
    closing = bench.alarm("itself", 3.0, lambda: closing.close())
    bench.shared.alarm(lambda: None).close()
    assert bench.ring(3.0) == ["itself"]
    assert not bench.timers[0].closed  # "closing" is still open


def test_a_timer_is_made_again_for_the_first_alarm_after_all_were_closed() -> None:
    bench = Bench()
    for at in (1.0, 2.0):
        alarm = bench.alarm("a", at)
        assert bench.timers[-1].at == at
        alarm.close()
        alarm.close()
        assert bench.timers[-1].closed
    assert len(bench.timers) == 2


def shared_alarm(loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> Alarm:
    """Returns the only alarm of a shared timer."""
    return SharedTimer(lambda timer_ring: best_alarm(loop, timer_ring)).alarm(ring)


@pytest.mark.parametrize("make", [LoopAlarm, TimerfdAlarm, best_alarm, shared_alarm])
async def test_alarms_ring_once_never_early_and_not_after_close(
    make: Callable[[asyncio.AbstractEventLoop, Callable[[], None]], Alarm],
) -> None:
    loop, rang = asyncio.get_running_loop(), asyncio.Event()
    rings: list[float] = []

    def ring() -> None:
        rings.append(time.monotonic())
        rang.set()

    try:
        alarm = make(loop, ring)
    except OSError as error:
        pytest.skip(str(error))
    for delay_s in (0.01, 0.0, -1.0):
        at = time.monotonic() + delay_s
        rang.clear()
        alarm.set(at + 60)
        alarm.set(at)
        await asyncio.wait_for(rang.wait(), PATIENCE_S)
        assert rings[-1] >= at - 0.001  # asyncio's own timers may be early by their resolution
    alarm.set(time.monotonic())
    alarm.close()
    alarm.close()
    await asyncio.sleep(0.01)
    assert len(rings) == 3
