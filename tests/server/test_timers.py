"""Timers: methods of the rules at a later tick, in order, also after a restart."""

from pathlib import Path
from typing import Any

import pytest

from server.game_api import timers
from server.rules import Rules, RulesError
from shared.checks import SceneError
from tests.server.test_persisted_state import Stored
from tests.tables import Table


class Alarm(Rules):
    """Rules that record the calls of timers with their tick."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def ring(self, *arguments: Any) -> None:
        self.calls.append((self.game.tick, *arguments))

    def fail(self) -> None:
        raise RuntimeError("the alarm is broken")

    def again(self, left: int) -> None:
        self.ring(left)
        if left:
            self.game.after(0, "again", left - 1)

    async def late(self) -> None:
        pass


def test_a_timer_calls_a_method_once_after_its_time() -> None:
    rules = Alarm()
    table = Table(rules=rules)
    table.tick(3)
    first = table.game.api.tick
    table.game.api.after(0.5, "ring", 1, [2, {"a": None}], "x")
    table.tick(100)
    assert rules.calls == [(first + 32, 1, [2, {"a": None}], "x")]


def test_timers_of_one_tick_are_called_in_the_order_of_their_starts() -> None:
    rules = Alarm()
    table = Table(rules=rules)
    table.tick()
    game = table.game.api
    now = game.tick
    for seconds, name in ((0.25, "b"), (0.125, "a"), (0.25, "c"), (0, "now"), (0.25, "d")):
        game.after(seconds, "ring", name)
    table.tick(40)
    assert rules.calls == [(now + 1, "now"), (now + 8, "a"), *((now + 16, name) for name in "bcd")]


def test_a_timer_may_start_the_next_one_which_waits_at_least_a_tick() -> None:
    rules = Alarm()
    table = Table(rules=rules)
    table.tick()
    now = table.game.api.tick
    table.game.api.after(0, "again", 3)
    table.tick(10)
    assert rules.calls == [(now + 1, 3), (now + 2, 2), (now + 3, 1), (now + 4, 0)]


def test_a_cancelled_timer_is_not_called() -> None:
    rules = Alarm()
    table = Table(rules=rules)
    table.tick()
    game = table.game.api
    one, two = game.after(0.1, "ring", 1), game.after(0.1, "ring", 2)
    assert one != two
    assert (game.cancel(one), game.cancel(one), game.cancel(12345)) == (True, False, False)
    table.tick(20)
    assert [name for _, name in rules.calls] == [2]
    assert not game.cancel(two)


def test_a_timer_that_raises_is_counted_and_over(caplog: pytest.LogCaptureFixture) -> None:
    rules = Alarm()
    table = Table(rules=rules)
    table.tick()
    table.game.api.after(0, "fail")
    table.game.api.after(0, "ring", "next")
    table.tick(5)
    assert (table.game.counters.rules_failed, [name for _, name in rules.calls]) == (1, ["next"])
    assert "Alarm.fail" in caplog.text


def test_timers_survive_restarts(tmp_path: Path) -> None:
    rules = Alarm()
    first = Stored(tmp_path, rules)
    first.tick(2)
    start = first.game.api.tick
    used, kept, dropped, lost = (
        first.game.api.after(0.25, "ring", name) for name in ("used", "kept", "dropped", "lost")
    )
    first.game.api.after(0.03125, "ring", "early")
    first.tick(3)
    assert rules.calls == [(start + 2, "early")]
    first.game.api.cancel(dropped)
    first.tick()
    first.stop()
    for round_ in range(2):
        again = Alarm()
        second = Stored(tmp_path, again)
        second.tick(2)
        assert again.calls == []
        if round_ == 0:
            second.game.api.cancel(lost)
            new = second.game.api.after(10, "ring", "far")
            assert new not in (used, kept, dropped, lost)
            second.tick()
        else:
            second.tick(16)
            assert again.calls == [(start + 16, "used"), (start + 16, "kept")]
        second.stop()


def test_a_method_that_the_restarted_rules_lack_is_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = Stored(tmp_path, Alarm())
    first.game.api.after(0.1, "ring", 1)
    first.tick()
    first.stop()
    second = Stored(tmp_path, Rules())
    second.tick(10)
    assert second.game.counters.rules_failed == 1
    assert "Rules.ring: a timer calls it, but there is no such method" in caplog.text
    second.stop()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ((1, "rings"), RulesError), ((1, "late"), RulesError), ((1, "calls"), RulesError), ((1, ""), SceneError),
        ((-1, "ring"), SceneError), (("soon", "ring"), SceneError), ((float("nan"), "ring"), SceneError),
        ((1, "ring", object()), SceneError), ((1, "ring", "x" * 1100), SceneError), ((1, 7), SceneError),
    ],
)  # fmt: skip
def test_wrong_timers_are_refused(arguments: tuple[Any, ...], error: type[Exception]) -> None:
    table = Table(rules=Alarm())
    with pytest.raises(error):
        table.game.api.after(*arguments)
    assert table.game.api.kept.tables["timers"] == {}


def test_timers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timers, "TIMERS_MAX", 3)
    game = Table(rules=Alarm()).game.api
    for _ in range(3):
        game.after(1, "ring")
    with pytest.raises(SceneError, match="3 timers wait already"):
        game.after(1, "ring")
