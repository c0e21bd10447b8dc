"""Players from the rules' side: refused joins, kicks that last, and names."""

import math
from pathlib import Path
from typing import Any

import pytest

from client_sdk.events import Disconnected, Left
from server.game.names import named
from server.game_api import players_api
from server.players.player import Player
from server.rules import Rules, RulesError, check_rules
from shared import messages
from shared.checks import SceneError
from shared.messages import Hello, Inputs, Welcome
from sovereign_netcode.playtest import Link, Match
from sovereign_netcode.playtest.match import wander
from tests.server.test_persisted_state import Stored
from tests.tables import FakeLink, Table
from tests.worlds import scene


class Club(Rules):
    """Rules with a guest list, which record joins and leaves."""

    def __init__(self, answer: Any = True) -> None:
        self.answer = answer
        self.asked: list[tuple[str, str]] = []
        self.calls: list[tuple[str, str]] = []

    def can_join(self, name: str, subject: str) -> Any:
        self.asked.append((name, subject))
        return self.answer

    def on_join(self, player: Player) -> None:
        self.calls.append(("join", player.name))

    def on_leave(self, player: Player) -> None:
        self.calls.append(("leave", player.name))


def hello(name: str, resume: bytes = b"") -> Hello:
    return Hello(messages.VERSION, {}, name, resume=resume)


def only(table: Table) -> Player:
    (player,) = table.game.players.values()
    return player


def kick(table: Table, player: Player, *arguments: Any) -> None:
    """Kicks a player within the next tick."""
    table.game.api.soon(table.game.api.kick, player, *arguments)
    table.tick()


def comes(table: Table, name: str) -> FakeLink:
    link = table.connect(hello(name))
    table.tick()
    return link


DEFAULT = "the game does not let this player join"


@pytest.mark.parametrize(
    ("answer", "reason"), [(False, DEFAULT), ("", DEFAULT), ("closed today", "closed today"), (None, DEFAULT)]
)
def test_the_rules_refuse_a_join(answer: Any, reason: str) -> None:
    rules = Club(answer)
    table = Table(rules=rules)
    link = comes(table, "Ann")
    assert link.refusal() == (messages.NOT_ADMITTED, reason)
    assert (rules.asked, rules.calls, table.game.players, len(table.game.world)) == ([("Ann", "")], [], {}, 0)
    assert table.game.counters.rules_failed == (answer is None)


def test_the_rules_are_asked_once_and_not_about_a_reconnect() -> None:
    rules = Club()
    table = Table(rules=rules, resume_s=5.0)
    link = comes(table, "Ann")
    table.tick(4)
    table.lose(link)
    again = table.connect(hello("Ann", link.got(Welcome)[-1].resume))
    table.tick()
    assert again.session.entity == link.session.entity
    assert (rules.asked, rules.calls) == ([("Ann", "")], [("join", "Ann")])


def test_a_kicked_player_leaves_in_the_next_tick_and_may_join_again() -> None:
    rules = Club()
    table = Table(rules=rules, resume_s=5.0)
    link = comes(table, "Ann")
    token = link.got(Welcome)[-1].resume
    kick(table, only(table), "be nice")
    assert link.refusal() == (messages.KICKED, "be nice")
    assert rules.calls == [("join", "Ann")]
    table.tick()
    assert rules.calls == [("join", "Ann"), ("leave", "Ann")]
    assert (len(table.game.world), table.game.counters.kicked) == (0, 1)
    again = table.connect(hello("Ann", token))
    table.tick()
    assert again.session.entity
    assert rules.calls[2:] == [("join", "Ann")]


def test_a_player_without_a_connection_can_be_kicked() -> None:
    rules = Club()
    table = Table(rules=rules, resume_s=5.0)
    link = comes(table, "Ann")
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)))
    table.lose(link)
    kick(table, only(table))
    table.tick()
    assert rules.calls == [("join", "Ann"), ("leave", "Ann")]


def test_a_player_may_be_kicked_in_its_join_and_twice() -> None:
    class Bouncer(Rules):
        def on_join(self, player: Player) -> None:
            self.game.kick(player, "full of noise")
            self.game.kick(player, "again")

    table = Table(rules=Bouncer())
    link = comes(table, "Ann")
    assert link.refusal() == (messages.KICKED, "full of noise")
    table.tick()
    assert (table.game.players, len(table.game.world), table.game.counters.rules_failed) == ({}, 0, 0)


def test_a_kick_lasts_as_long_as_asked_by_name() -> None:
    table = Table(rules=Club())
    rate = table.game.scene.tick_rate
    comes(table, "Ann")
    kick(table, only(table), "spam", 2.0)
    refused = comes(table, "ANN")
    assert refused.refusal() == (messages.NOT_ADMITTED, "kicked: spam; come back in 2 s")
    assert comes(table, "Bob").session.entity
    table.tick(2 * rate)
    assert comes(table, "Ann").session.entity


def test_a_kick_counts_for_the_subject_of_the_token() -> None:
    table = Table(rules=Club())
    table.game.joining.authenticate = lambda token: token
    first = table.connect(Hello(messages.VERSION, {}, "Ann", token="ann@x"))
    table.tick()
    kick(table, only(table), "", math.inf)
    table.tick()
    assert first.closings == [(messages.KICKED, "kicked by the game")]
    other = table.connect(Hello(messages.VERSION, {}, "Zoe", token="ann@x"))
    innocent = table.connect(Hello(messages.VERSION, {}, "Ann", token="bob@x"))
    table.tick()
    assert other.refusal() == (messages.NOT_ADMITTED, "kicked")
    assert innocent.session.entity
    assert table.game.api.pardon("ann@x")
    assert not table.game.api.pardon("ann@x")
    assert not table.game.api.pardon("bob@x")


def test_a_kick_of_a_player_without_a_name_keeps_no_others_out() -> None:
    table = Table(rules=Club())
    comes(table, "")
    kick(table, only(table), "spam", math.inf)
    table.tick()
    assert table.game.players == {}
    assert comes(table, "").session.entity


def test_a_kick_survives_a_restart(tmp_path: Path) -> None:
    first = Stored(tmp_path)
    comes(first, "Ann")
    kick(first, only(first), "spam", math.inf)
    first.stop()
    second = Stored(tmp_path)
    assert comes(second, "ann").refusal() == (messages.NOT_ADMITTED, "kicked: spam")
    second.game.api.pardon("Ann")
    second.tick()
    second.stop()
    third = Stored(tmp_path)
    assert comes(third, "Ann").session.entity
    third.stop()


def test_kicks_that_last_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(players_api, "BANS_MAX", 20)
    api = Table().game.api
    for number in range(23):
        api._ban(f"name {number}", 1000 + number, "")
    assert len(api.kept.tables["bans"]) == 20
    assert "name 2" not in api.kept.tables["bans"]
    assert "name 3" in api.kept.tables["bans"]


@pytest.mark.parametrize("arguments", [("x" * 501,), (7,), ("", -1.0), ("", math.nan), ("", "soon")])
def test_wrong_values_are_refused(arguments: tuple[Any, ...]) -> None:
    table = Table()
    comes(table, "Ann")
    player = only(table)
    with pytest.raises(SceneError):
        table.game.api.kick(player, *arguments)
    for other in (player.entity, "Ann", Player(9), None):
        with pytest.raises(SceneError, match="player = "):
            table.game.api.kick(other)  # type: ignore[arg-type]
    assert table.game.api.kicked == []


CLEAN = [
    ("Ann", "Ann"), ("", "Player"), (" \t\n", "Player"),
    ("  A \u00a0 n\u3000n ", "A n n"), ("\u202eevil\u200b", "evil"),
    ("\ufeff\u2800\u3164", "Player"), ("a\u0301", "\u00e1"), ("z" + "\u0336" * 30, "z\u0336\u0336"),
    ("\ufb03" * 32, ("ffi" * 32)[:32]), ("\uff21nn", "Ann"),
    ("A\x00\x1bB\U000e0041", "AB"), ("\U0001f600", "\U0001f600"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "expected"), CLEAN)
def test_a_clean_name(given: str, expected: str) -> None:
    assert named(given, "clean", (), 32) == expected
    assert named(expected, "clean", (), 32) == expected
    assert named(given, "any", (given,), 32) == given


def test_unique_names() -> None:
    assert named("Ann", "unique", ("Bob",), 32) == "Ann"
    assert named("ann", "unique", ("Ann",), 32) == "ann 2"
    assert named("Ann", "unique", ("ANN", "ann 2"), 32) == "Ann 3"
    assert named("x" * 32, "unique", ("x" * 32,), 32) == "x" * 30 + " 2"
    assert named("stra\u00dfe", "unique", ("STRASSE",), 32) == "stra\u00dfe 2"


def test_names_by_the_setting_of_the_rules() -> None:
    class Tidy(Club):
        names = "unique"

    rules = Tidy()
    table = Table(rules=rules)
    for name in ("Ann", " ann\u200b", ""):
        comes(table, name)
    assert [player.name for player in table.game.players.values()] == ["Ann", "ann 2", "Player"]
    assert [table.game.api.get(entity, "name") for entity in table.game.players] == ["Ann", "ann 2", "Player"]
    assert rules.asked == [("Ann", ""), ("ann 2", ""), ("Player", "")]


def test_a_wrong_setting_of_names_is_refused() -> None:
    class Wrong(Rules):
        names = "uniqe"

    with pytest.raises(RulesError, match=r"Wrong\.names = 'uniqe': must be one of any, clean, unique"):
        check_rules(Wrong())


def test_the_client_of_a_kicked_player_gets_the_reason_and_stays_away() -> None:
    match = Match(scene([[0, 0, 0, 32, 32, 1, 1]], origin=(0, 0, 0), size=(1, 1, 1)), seed=1, rules=Club())
    player = match.join(wander, Link(0.03))
    match.run_until(lambda: player.core.state == "playing", 5)
    api = match.game.api
    api.soon(api.kick, api.players[player.core.entity], "be nice")
    match.run(3)
    assert player.core.state == "closed"
    assert [event for event in player.events if isinstance(event, Left)] == [Left(messages.KICKED, "be nice", -1.0)]
    assert not [event for event in player.events if isinstance(event, Disconnected)]
    assert not match.game.players
