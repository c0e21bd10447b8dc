"""A stalled event loop and the log lines about it. Nothing here depends on the speed of the machine."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from server.runtime import watchdog as module
from server.runtime.watchdog import Watchdog
from tests.patience import PATIENCE_S

STALL_S = 0.02


class FakeLogger:
    """A logger that keeps the watchdog's lines, which come from its thread."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, dict[str, Any]]] = []
        self._changed = threading.Condition()

    def warning(self, event: str, **values: Any) -> None:
        with self._changed:
            self.lines.append((event, values))
            self._changed.notify_all()

    def wait_for(self, event: str) -> dict[str, Any]:
        """Waits until this line was logged. Returns its values."""
        with self._changed:
            assert self._changed.wait_for(lambda: self._found(event) is not None, PATIENCE_S), self.lines
            found = self._found(event)
        assert found is not None
        return found

    def _found(self, event: str) -> dict[str, Any] | None:
        return next((values for line, values in self.lines if line == event), None)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> FakeLogger:
    log = FakeLogger()
    monkeypatch.setattr(module, "logger", log)
    return log


@pytest.fixture
def watch(log: FakeLogger) -> Iterator[Callable[..., Watchdog]]:
    """A function that makes watchdogs, which end with the test. A thread without CPU time is not the subject here."""
    made: list[Watchdog] = []

    def make(**options: float) -> Watchdog:
        made.append(Watchdog(asyncio.get_running_loop(), **{"asleep_s": 60.0, **options}))
        return made[-1]

    yield make
    for watchdog in made:
        watchdog.stop()


Watch = Callable[..., Watchdog]


async def test_a_stalled_loop_is_logged_with_its_stack_and_so_is_its_end(log: FakeLogger, watch: Watch) -> None:
    watchdog = watch(stall_s=STALL_S, beat_s=STALL_S / 4)

    def this_holds_up_the_loop() -> dict[str, Any]:
        return log.wait_for("the event loop has stalled")

    values = this_holds_up_the_loop()
    assert "this_holds_up_the_loop" in values["stack"]
    assert values["for_s"] >= STALL_S
    values = await asyncio.to_thread(log.wait_for, "the event loop goes on")
    assert values["stalled_s"] > STALL_S
    assert watchdog.stalls >= 1


async def test_stacks_are_not_repeated_but_stalls_are_counted(log: FakeLogger, watch: Watch) -> None:
    watchdog = watch(stall_s=STALL_S, beat_s=STALL_S / 4)
    for n in range(3):
        pause = threading.Event()
        for _ in range(500):
            if watchdog.stalls > n:  # on a busy machine there may have been a stall before this one
                break
            pause.wait(STALL_S)  # without a turn for the loop
        assert watchdog.stalls > n
        latest = watchdog._latest
        while watchdog._latest == latest:  # noqa: ASYNC110 - the loop's turn
            await asyncio.sleep(0.001)
    assert [event for event, _ in log.lines].count("the event loop has stalled") == 1


async def test_a_loop_that_has_its_turns_is_left_alone(log: FakeLogger, watch: Watch) -> None:
    watchdog = watch(stall_s=60.0, beat_s=0.001)
    for _ in range(100):
        await asyncio.sleep(0.001)
    watchdog.stop()
    watchdog.stop()
    assert (log.lines, watchdog.stalls) == ([], 0)


@pytest.mark.parametrize(
    ("cpu_s", "line"),
    [
        (0.0, "the process was suspended, or got no CPU"),
        (2.9, "code that held the interpreter has stalled the event loop"),
    ],
)
async def test_cpu_time_distinguishes_a_held_interpreter_from_a_suspended_process(
    log: FakeLogger, watch: Watch, cpu_s: float, line: str
) -> None:
    watch(stall_s=60.0)._log_asleep(3.0, cpu_s)
    assert log.lines == [(line, {"for_s": 3.0})]
