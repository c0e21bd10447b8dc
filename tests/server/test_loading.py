"""`load_player`: a game fetches a player's data before the join; the client waits, and the ticks go on."""

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from client_sdk.events import Joined, Left
from server.game.loading import Done
from server.players.player import Player
from server.rules import Rules, RulesError, check_rules
from server.runtime.tasks import Tasks
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander


class Bank(Rules):
    """Rules that load the gold of a player."""

    scene = "flat"
    joined: list[Any]

    def __init__(self) -> None:
        self.joined = []

    async def load_player(self, name: str, subject: str) -> Any:
        if name == "Mallory":
            raise ValueError("you are banned")
        if name == "Crash":
            raise LookupError("no table")
        return len(name)

    def on_join(self, player: Player) -> None:
        self.joined.append((player.name, player.loaded))


def started(names: list[str]) -> tuple[Match, Bank]:
    rules = Bank()
    match = Match(load_scene("flat"), 1, rules=rules)
    for name in names:
        player = match.join(wander)
        player.core.name = name
    return match, rules


def test_the_result_is_there_in_on_join_and_an_error_refuses_the_client() -> None:
    match, rules = started(["Ann", "Mallory", "Crash"])
    match.run(3)
    assert rules.joined == [("Ann", 3)]
    ends = [event.reason for player in match.players for event in player.events if isinstance(event, Left)]
    assert ends[0] == "you are banned"
    assert "could not load" in ends[1]
    assert match.game.faults.total == 1


def test_the_client_waits_and_the_ticks_go_on() -> None:
    match, rules = started(["Ann"])
    waiting: list[tuple[Coroutine[Any, Any, Any], Done]] = []
    match.game.joining.run = lambda coroutine, done: waiting.append((coroutine, done))
    match.run(20)
    (player,) = match.players
    assert rules.joined == []
    assert match.game.world.tick > 600
    assert not [event for event in player.events if isinstance(event, Joined | Left)]
    ((coroutine, done),) = waiting
    coroutine.close()
    done(7, None)
    match.run(5)
    assert rules.joined == [("Ann", 7)]
    assert [event for event in player.events if isinstance(event, Joined)]


def test_a_client_that_has_gone_meanwhile_does_not_join() -> None:
    match, rules = started(["Ann"])
    waiting: list[Done] = []

    def run(coroutine: Coroutine[Any, Any, Any], done: Done) -> None:
        coroutine.close()
        waiting.append(done)

    match.game.joining.run = run
    match.run(1)
    match.players[0].disconnect()
    match.run(0.1)
    waiting[0](1, None)
    match.run(1)
    assert rules.joined == []
    assert len(match.game.world) == 0


def test_a_reconnect_loads_nothing() -> None:
    match, rules = started(["Ann"])
    match.players[0].core.reconnect.patience_s = 30
    match.run(3)
    calls: list[object] = []
    run = match.game.joining.run

    def counted(coroutine: Coroutine[Any, Any, Any], done: Done) -> None:
        calls.append(coroutine)
        run(coroutine, done)

    match.game.joining.run = counted
    match.players[0].disconnect()
    match.run(5)
    assert match.players[0].core.state == "playing"
    assert (len(rules.joined), calls) == (1, [])


def test_without_an_event_loop_nothing_can_be_awaited() -> None:
    class Slow(Bank):
        async def load_player(self, name: str, subject: str) -> Any:
            await asyncio.sleep(0)

    match = Match(load_scene("flat"), 1, rules=Slow())
    player = match.join(wander)
    match.run(1)
    assert [event.reason for event in player.events if isinstance(event, Left)] == [
        "the game could not load the player's data"
    ]


def test_a_plain_function_is_refused_at_the_start() -> None:
    class Wrong(Rules):
        def load_player(self, name: str, subject: str) -> Any:
            return 1

    with pytest.raises(RulesError, match="load_player: must be async"):
        check_rules(Wrong())


async def test_an_event_loop_runs_them_and_cancels_those_that_take_too_long() -> None:
    tasks, found = Tasks(asyncio.get_running_loop(), 0.05), asyncio.Queue[tuple[Any, BaseException | None]]()

    async def fetch(result: int) -> int:
        await asyncio.sleep(0)
        return result

    tasks.run(fetch(5), lambda result, error: found.put_nowait((result, error)))
    assert await found.get() == (5, None)
    tasks.run(asyncio.Event().wait(), lambda result, error: found.put_nowait((result, error)))
    result, error = await found.get()
    assert result is None
    assert isinstance(error, TimeoutError)
