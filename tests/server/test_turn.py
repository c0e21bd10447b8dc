"""Rules that would do nothing are named. Calls that change a game happen within a tick or are refused."""

import asyncio
import functools
import random
import threading
from collections.abc import Callable
from typing import Any

import pytest

from server.game import Game
from server.game_api.hooks import SOON_MAX
from server.game_api.turn import OutOfTurnError
from server.players.player import Player
from server.rules import HOOKS, Rules, RulesError, check_rules, load_rules, prepared
from shared.checks import SceneError
from shared.scene import Scene, load_scene
from sovereign_netcode.playtest import Match
from tests.client_sdk.test_wrong_values import Playing
from tests.patience import until
from tests.server.test_persisted_state import Stored
from tests.server.test_wrong_values import RUNNER, Played, marks
from tests.tables import Table, order

FLAT = load_scene("flat")


def made(**methods: Any) -> Rules:
    """Returns rules with some methods."""
    rules: Rules = type("Mine", (Rules,), methods)()
    return rules


def everywhere(rules: Rules) -> list[Callable[[], Any]]:
    """Returns all ways to start a game with rules."""
    return [
        lambda: Match(FLAT, 1, rules=rules),
        lambda: Game(FLAT, rules=rules),
        lambda: prepared(rules, FLAT),
        lambda: check_rules(rules),
    ]


async def waits(self: Rules, *arguments: Any) -> None: ...


async def yields_and_waits(self: Rules, *arguments: Any) -> Any:
    yield 1


def yields(self: Rules, *arguments: Any) -> Any:
    yield 1


@pytest.mark.parametrize("hook", HOOKS)
@pytest.mark.parametrize(
    ("method", "why"),
    [
        (waits, "must not be async"), (yields_and_waits, "must not be async"), (yields, "must not contain `yield`"),
        (functools.partial(waits), "must not be async"), (None, "must be a function"), (5, "must be a function"),
    ],
)  # fmt: skip
def test_a_hook_that_would_do_nothing_is_named(hook: str, method: Any, why: str) -> None:
    for enter in everywhere(made(**{hook: method})):
        with pytest.raises(RulesError, match=rf"^Mine\.{hook}.*{why}"):
            enter()


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("on_tik", "on_tick"), ("on_joined", "on_join"), ("on_leaves", "on_leave"), ("can_edits", "can_edit"),
        ("onTick", "on_tick"), ("OnJoin", "on_join"), ("ontick", "on_tick"), ("on_Tick", "on_tick"),
        ("canEdit", "can_edit"), ("Prepare", "prepare"), ("on__tick", "on_tick"), ("on_zzzz", ""), ("can_fly", ""),
    ],
)  # fmt: skip
def test_a_misspelt_hook_is_named_everywhere(name: str, meant: str) -> None:
    hint = rf" \(did you mean {meant}\?\)" if meant else ""
    said = rf"^Mine\.{name} is no hook, and nothing calls it{hint}; the hooks are prepare, on_"
    for enter in everywhere(made(**{name: lambda self: None})):
        with pytest.raises(RulesError, match=said):
            enter()


def test_names_that_only_look_like_hooks_are_left_alone() -> None:
    check_rules(made(_on_tick=1, tick=2, once=3, join=4, canned=5, edit=6, one_tick=7, preparations=8))


@pytest.mark.parametrize("returned", [None, "flat", 5, FLAT.to_table(), Scene])
def test_prepare_must_return_a_scene(returned: Any) -> None:
    rules = made(prepare=lambda self, scene: returned)
    for enter in (lambda: Match(FLAT, 1, rules=rules), lambda: prepared(rules, FLAT)):
        with pytest.raises(RulesError, match=r"^Mine\.prepare returned .*: it must return the scene to play in"):
            enter()


def test_an_exception_in_prepare_is_reported_with_its_name() -> None:
    def prepare(self: Rules, scene: Scene) -> Scene:
        self.game.spawn("player", (0, 0, 0))
        return scene

    with pytest.raises(RulesError, match=r"^Mine\.prepare failed \(AttributeError: self.game is not available"):
        prepared(made(prepare=prepare), FLAT)
    with pytest.raises(SceneError, match="like = 'no such'"):
        prepared(made(prepare=lambda self, scene: scene.with_template("a", like="no such")), FLAT)
    with pytest.raises(AttributeError, match="'Mine' object has no attribute 'gane'"):
        made().gane  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize(
    ("hook", "method", "why"),
    [
        ("on_join", lambda self: None, r"Mine\.on_join\(\): is called with \(player\): too many positional arguments"),
        (
            "on_tick",
            lambda self, dt: None,
            r"Mine\.on_tick\(dt\): is called with \(\): missing a",
        ),
        ("on_contact", lambda self, pair: None, r"on_contact\(pair\): is called with \(a, b\)"),
        ("can_edit", lambda self, player, *, x, y, z, kind: True, r"is called with \(player, x, y, z, kind\)"),
        ("prepare", lambda: None, r"prepare.*is called with \(scene\)"),
    ],
)
def test_a_hook_that_does_not_take_its_arguments_is_refused_before_it_is_called(
    hook: str, method: Callable[..., Any], why: str
) -> None:
    with pytest.raises(RulesError, match=why):
        Table(rules=made(**{hook: method}))


@pytest.mark.parametrize(
    "method", [lambda self, *_: None, lambda self, a, b=0, c=0: None, lambda self, player=None: None]
)
def test_a_hook_may_take_more_than_it_gets(method: Callable[..., Any]) -> None:
    Table(rules=made(on_join=method)).tick()


class TooEarly(Rules):
    def __init__(self) -> None:
        self.game.share("score", 0)


class Silent(Rules):
    async def on_tick(self) -> None:  # type: ignore[override]
        """Does nothing, because nothing awaits it."""


@pytest.mark.parametrize(
    ("name", "why"), [("TooEarly", "AttributeError: self.game is not available"), ("Silent", "Silent.on_tick: .*async")]
)
def test_rules_that_are_loaded_by_name_are_checked(name: str, why: str) -> None:
    with pytest.raises(RulesError, match=rf"^game = '{__name__}:{name}': .*{why}"):
        load_rules(f"{__name__}:{name}")


def behind(decorated: Callable[..., Any]) -> Callable[..., Any]:
    """Hides the kind of a method, as a decorator may."""

    def wrapper(*arguments: Any) -> Any:
        return decorated(*arguments)

    return wrapper


@pytest.mark.parametrize("method", [waits, yields, yields_and_waits])
def test_a_hook_that_returns_a_coroutine_or_generator_has_failed(method: Any, caplog: pytest.LogCaptureFixture) -> None:
    table = Table(rules=made(on_tick=behind(method)))
    table.tick(3)
    assert table.game.counters.rules_failed == 3
    assert "which nothing runs: it must be a plain function" in caplog.text


@pytest.mark.parametrize(
    ("answer", "allowed"), [(None, False), (0, False), (False, False), (True, True), (1, True), ("no", False)]
)
def test_an_edit_is_allowed_by_any_true_value_but_a_text(
    answer: Any, allowed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    table = Table(rules=made(can_edit=lambda self, *_: answer))
    link = table.join()
    table.tick(64)
    link.say(order(1, 0, 18, 16, 1, 5))
    table.tick()
    assert (table.game.world.blocks.get(18, 16, 1) == 5) is allowed
    assert table.game.counters.rules_failed == (answer is None)
    assert ("can_edit returned None: it must return True, False or a reason" in caplog.text) is (answer is None)


# -- who may change a game, and when ---------------------------------------------------------------------------

ACTS: dict[str, Callable[[Played], Any]] = {
    "spawn": lambda t: t.api.spawn("stone", (8, 8, 1)),
    "remove": lambda t: t.api.remove(RUNNER),
    "place": lambda t: t.api.place(RUNNER, (8, 8, 1)),
    "throw": lambda t: t.api.throw(RUNNER, (0, 0, 1)),
    "push": lambda t: t.api.push(RUNNER, (0, 0, 1)),
    "change": lambda t: t.api.change(RUNNER, "cube"),
    "steer": lambda t: t.api.steer(RUNNER, 1, 0),
    "set_block": lambda t: t.api.set_block(8, 8, 5, 1),
    "set": lambda t: t.api.set(RUNNER, "mood", "cross"),
    "share": lambda t: t.api.share("score", 2),
    "send": lambda t: t.api.send("boom"),
    "random": lambda t: t.api.random.random(),
}


def caught(act: Callable[[], Any]) -> Callable[[], str]:
    """Returns a function that calls `act` and returns the text of its `OutOfTurnError`; empty if there is none."""

    def done() -> str:
        try:
            act()
        except OutOfTurnError as error:
            return str(error)
        return ""

    return done


def in_a_thread(act: Callable[[], Any]) -> str:
    """Returns the error of a call in another thread."""
    errors: list[str] = []
    thread = threading.Thread(target=lambda: errors.append(caught(act)()), name="worker")
    thread.start()
    thread.join()
    return errors[0]


def in_a_callback(act: Callable[[], Any]) -> str:
    """Returns the error of a call in a callback of an event loop."""

    async def run() -> str:
        error: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        asyncio.get_running_loop().call_later(0, lambda: error.set_result(caught(act)()))
        return await error

    return asyncio.run(run())


@pytest.mark.parametrize("name", ACTS)
@pytest.mark.parametrize(
    ("elsewhere", "where"),
    [(in_a_thread, "from thread 'worker'"), (in_a_callback, "from a callback of the event loop, between two ticks")],
)
def test_a_change_from_elsewhere_is_refused(name: str, elsewhere: Callable[[Any], str], where: str) -> None:
    table = Played()
    before = marks(table)
    error = elsewhere(lambda: ACTS[name](table))
    assert error.startswith(f"{name}: called {where}")
    assert f"game.soon(game.{name}, ...)" in error
    assert marks(table) == before
    ACTS[name](table)  # in the thread that ticks, without an event loop, a change is allowed


def test_the_thread_that_ticks_may_change_the_game_and_it_may_be_another_one_later() -> None:
    table = Played()

    def tick_and_share() -> None:
        table.tick()
        table.api.share("score", 2)

    assert in_a_thread(tick_and_share) == ""
    assert "from thread 'MainThread'" in caught(lambda: table.api.share("score", 3))()
    table.tick()
    table.api.share("score", 3)
    assert table.api.shared == {"score": 3}


class Awaits(Rules):
    """Rules whose hooks act within a tick, whatever runs around it."""

    def on_tick(self) -> None:
        self.game.share("tick", self.game.tick)


async def test_hooks_may_change_the_game_within_an_event_loop() -> None:
    table = Table(rules=Awaits())
    table.tick(3)
    assert table.game.api.shared == {"tick": 3}
    assert table.game.counters.rules_failed == 0


@pytest.mark.parametrize("name", ACTS)
@pytest.mark.parametrize("elsewhere", [in_a_thread, in_a_callback, lambda act: act() and ""])
def test_a_call_by_soon_happens_in_the_next_tick(name: str, elsewhere: Callable[[Any], str]) -> None:
    made_elsewhere, made_here = Played(), Played()
    elsewhere(lambda: made_elsewhere.api.soon(ACTS[name], made_elsewhere))
    before = marks(made_elsewhere)
    ACTS[name](made_here)
    assert made_elsewhere.game.world.tick == made_here.game.world.tick
    assert before[:6] == marks(Played())[:6]
    for table in (made_elsewhere, made_here):
        table.tick()
    assert marks(made_elsewhere) == marks(made_here)
    assert made_elsewhere.game.counters.rules_failed == 0


def test_soon_keeps_the_order_takes_arguments_and_defers_calls_added_meanwhile() -> None:
    table = Table()
    stage, calls = table.game.api, []

    def note(*what: Any) -> None:
        calls.append((stage.tick, *what))
        if what == (1,):
            stage.soon(note, "later")

    stage.soon(note, 1)
    stage.soon(note, 2, "b")
    stage.soon(functools.partial(note, 3))
    assert calls == []
    table.tick(3)
    assert calls == [(1, 1), (1, 2, "b"), (1, 3), (2, "later")]


class Ordered(Rules):
    def __init__(self) -> None:
        self.calls: list[str] = []

    def on_start(self) -> None:
        self.calls.append("start")

    def on_join(self, player: Player) -> None:
        self.calls.append("join")

    def on_tick(self) -> None:
        self.calls.append("tick")


def test_soon_comes_after_the_start_and_ahead_of_the_other_hooks() -> None:
    rules = Ordered()
    table = Table(rules=rules)
    table.game.api.soon(rules.calls.append, "soon")
    table.join()
    assert rules.calls == ["start", "soon", "join", "tick"]


def test_a_failing_call_by_soon_is_counted_and_stops_nothing(caplog: pytest.LogCaptureFixture) -> None:
    table = Table()

    def fails() -> None:
        raise RuntimeError("on purpose")

    table.game.api.soon(fails)
    table.game.api.soon(functools.partial(fails))
    table.game.api.soon(table.game.api.share, "score", 1)
    table.tick()
    assert (table.game.counters.rules_failed, table.game.api.shared) == (2, {"score": 1})
    assert "on purpose" in caplog.text


@pytest.mark.parametrize("bad", [None, 5, "f", waits, yields, functools.partial(waits)])
def test_a_value_that_cannot_be_called_is_refused_by_soon_at_once(bad: Any) -> None:
    table = Table()
    with pytest.raises(RulesError, match=r"^soon: act"):
        table.game.api.soon(bad)
    table.tick()
    assert table.game.counters.rules_failed == 0


def test_a_game_that_does_not_tick_takes_only_so_much() -> None:
    table = Table()
    for _ in range(SOON_MAX):
        table.game.api.soon(int)
    with pytest.raises(OutOfTurnError, match="10000 functions wait already"):
        table.game.api.soon(int)
    table.tick()
    table.game.api.soon(int)


def test_many_threads_at_once_lose_nothing() -> None:
    table = Table()
    stage = table.game.api
    seen: list[tuple[int, int]] = []

    def work(number: int) -> None:
        for turn in range(200):
            stage.soon(seen.append, (number, turn))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        table.tick()
    table.tick()
    assert sorted(seen) == [(number, turn) for number in range(4) for turn in range(200)]
    for number in range(4):
        assert [turn for one, turn in seen if one == number] == list(range(200))


def test_calls_by_soon_are_saved_like_all_others(tmp_path: Any) -> None:
    table = Stored(tmp_path)
    stage = table.game.api
    in_a_thread(lambda: stage.soon(stage.spawn, "stone", (8, 8, 1)))
    table.tick()
    until(lambda: table.store.durable_tick == 1)
    hashed = table.game.world.state_hash()
    assert len(table.game.world) == 1
    table.stop()
    again = Stored(tmp_path)
    assert again.game.world.state_hash() == hashed
    again.stop()


def test_a_seeded_match_with_soon_is_the_same_again() -> None:
    def play() -> bytes:
        match = Match(FLAT, 3)
        stage, dice = match.game.api, random.Random(4)
        for _ in range(20):
            x, y = dice.uniform(8, 56), dice.uniform(8, 56)
            stage.soon(lambda x=x, y=y: stage.spawn("player", (x + stage.random.random(), y, 8)))
            match.run(0.1)
        return match.game.world.state_hash()

    assert play() == play()


def test_a_loopback_in_an_event_loop_plays() -> None:
    async def run() -> bool:
        playing = Playing()
        playing.play(10)
        return playing.client.playing

    assert asyncio.run(run())
