"""Values of players: those that only their clients get, and those that outlive them."""

import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from server.game_api import values_api
from server.players.player import Player
from server.rules import Rules
from shared import messages
from shared.checks import SceneError
from shared.messages import Hello, Inputs, Private, Welcome
from sovereign_netcode.playtest import Link, Match
from sovereign_netcode.playtest.match import wander
from tests.server.test_persisted_state import Stored
from tests.tables import FakeLink, Table
from tests.worlds import scene


class Spies(Rules):
    """Rules that give each player a secret, and count the joins of a person."""

    def on_join(self, player: Player) -> None:
        self.game.share_with(player, "role", "spy" if player.name == "Ann" else "guard")
        if player.subject:
            self.game.remember(player, "joins", self.game.recall(player, "joins", 0) + 1)


def joined(table: Table, name: str, token: str = "", resume: bytes = b"") -> FakeLink:
    link = table.connect(Hello(messages.VERSION, {}, name, token=token, resume=resume))
    table.tick(2)
    return link


def player_of(table: Table, link: FakeLink) -> Player:
    return table.game.players[link.session.entity]


def test_only_the_own_player_gets_a_value_and_only_when_it_changes() -> None:
    table = Table(rules=Spies())
    ann, bob = joined(table, "Ann"), joined(table, "Bob")
    table.tick(5)
    assert (ann.got(Private), bob.got(Private)) == ([Private({"role": "spy"})], [Private({"role": "guard"})])
    game, player = table.game.api, player_of(table, ann)
    game.share_with(player, "role", "spy")
    table.tick()
    assert len(ann.got(Private)) == 1
    game.share_with(player, "clues", [1, 2])
    table.tick()
    game.share_with(player, "role", None)
    table.tick()
    assert ann.got(Private)[1:] == [Private({"role": "spy", "clues": [1, 2]}), Private({"clues": [1, 2]})]
    assert dict(game.shared_with(player)) == {"clues": [1, 2]}
    assert len(bob.got(Private)) == 1


def test_without_values_nothing_is_sent() -> None:
    table = Table()
    link = joined(table, "Ann")
    table.tick(5)
    assert link.got(Private) == []


def test_values_come_again_after_a_reconnect_also_when_none_is_left() -> None:
    table = Table(rules=Spies(), resume_s=5.0)
    link = joined(table, "Ann")
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)))
    table.tick()
    table.lose(link)
    again = joined(table, "Ann", resume=link.got(Welcome)[-1].resume)
    assert again.got(Private) == [Private({"role": "spy"})]
    again.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)))
    table.lose(again)
    table.game.api.share_with(player_of(table, again), "role", None)
    third = joined(table, "Ann", resume=again.got(Welcome)[-1].resume)
    assert third.got(Private) == [Private({})]


def test_values_end_with_their_player() -> None:
    table = Table(rules=Spies())
    link = joined(table, "Ann")
    table.lose(link)
    table.tick(2)
    assert table.game.api.kept.tables["private"] == {}
    other = joined(table, "Bob")
    table.game.world.remove(other.session.entity)  # as a behaviour does
    table.lose(other)
    table.tick(2)
    assert (table.game.players, table.game.api.kept.tables["private"]) == ({}, {})


def test_values_survive_a_restart(tmp_path: Path) -> None:
    first = Stored(tmp_path, Spies())
    first.game.joining.authenticate = lambda token: token
    link, gone = joined(first, "Ann", "ann@x"), joined(first, "Bob", "bob@x")
    link.say(Inputs(first.tick_number + 1, first.tick_number, bytes(3)))
    first.game.api.share_with(player_of(first, link), "clues", [1])
    first.game.connections.leave(gone.session)
    first.tick(2)
    first.stop()
    for round_ in range(2):
        second = Stored(tmp_path, Spies())
        second.game.joining.authenticate = lambda token: token
        link = joined(second, "", "ann@x", resume=link.got(Welcome)[-1].resume)
        assert link.got(Private) == [Private({"role": "spy", "clues": [1]})]
        assert second.game.api.recall("bob@x", "joins") == 1 + round_
        joined(second, "Bob", "bob@x")
        assert second.game.api.recall("bob@x", "joins") == 2 + round_
        link.say(Inputs(second.tick_number + 1, second.tick_number, bytes(3)))
        second.tick()
        second.stop()


def test_everything_that_lasts_survives_a_crash(tmp_path: Path) -> None:
    first = Stored(tmp_path / "a", Spies())
    first.game.joining.authenticate = lambda token: token
    link, bob = joined(first, "Ann", "ann@x"), joined(first, "Bob", "bob@x")
    game = first.game.api
    game.soon(game.kick, player_of(first, bob), "spam", math.inf)
    game.share_with(player_of(first, link), "clues", [1])
    game.add_zone("here", (1, 2, 3), (4, 5, 6))
    number = game.after(60, "on_tick")
    cancelled = game.after(60, "on_tick")
    first.tick()
    game.cancel(cancelled)
    first.tick(2)
    expected = [{name: dict(table) for name, table in game.kept.tables.items()}]
    shutil.copytree(tmp_path / "a", tmp_path / "b")  # what a kill -9 leaves: no checkpoint but the first one
    first.stop()
    second = Stored(tmp_path / "b", Spies())
    tables = second.game.api.kept.tables
    assert [tables] == expected
    assert list(tables["timers"]) == [number]
    assert tables["subjects"] == {"ann@x": {"joins": 1}, "bob@x": {"joins": 1}}
    assert tables["private"] == {link.session.entity: {"role": "spy", "clues": [1]}}
    assert list(tables["bans"]) == ["subject bob@x"]
    second.stop()


def test_remembered_values_are_of_the_subject() -> None:
    table = Table(rules=Spies())
    table.game.joining.authenticate = lambda token: token
    game = table.game.api
    link = joined(table, "Ann", "ann@x")
    table.lose(link)
    table.tick(2)
    assert (game.recall("ann@x", "joins"), game.recall("bob@x", "joins", 7)) == (1, 7)
    game.remember("ann@x", "items", ["bow"])
    game.recall("ann@x", "items").append("sword")
    assert game.recall("ann@x", "items") == ["bow"]
    joined(table, "Anna", "ann@x")
    assert game.recall("ann@x", "joins") == 2
    for name in ("items", "joins"):
        game.remember("ann@x", name, None)
    assert game.kept.tables["subjects"] == {}


def test_a_player_without_a_subject_has_no_remembered_values() -> None:
    table = Table(rules=Spies())
    player = player_of(table, joined(table, "Ann"))
    assert table.game.api.recall(player, "joins", "none") == "none"
    with pytest.raises(SceneError, match="has no subject; the server must ask for tokens"):
        table.game.api.remember(player, "joins", 1)
    assert table.game.counters.rules_failed == 0


@pytest.mark.parametrize(("name", "value"), [("", 1), ("x" * 33, 1), ("a", object()), ("a", "x" * 300), (1, 1)])
def test_wrong_values_are_refused(name: Any, value: Any) -> None:
    table = Table(rules=Spies())
    player = player_of(table, joined(table, "Ann"))
    with pytest.raises(SceneError):
        table.game.api.share_with(player, name, value)
    with pytest.raises(SceneError):
        table.game.api.remember("x", name, value)
    with pytest.raises(SceneError, match="must be a `Player` of this game"):
        table.game.api.share_with(Player(99), "a", 1)
    with pytest.raises(SceneError, match="who = 7"):
        table.game.api.recall(7, "a")  # type: ignore[arg-type]
    assert dict(table.game.api.shared_with(player)) == {"role": "spy"}


def test_values_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(values_api, "SUBJECTS_MAX", 2)
    table = Table()
    game, player = table.game.api, player_of(table, joined(table, "Ann"))
    for number in range(32):
        game.share_with(player, f"{number}", number)
        game.remember("a", f"{number}", number)
    with pytest.raises(SceneError, match="more than 32 values"):
        game.share_with(player, "more", 1)
    with pytest.raises(SceneError, match="more than 32 values"):
        game.remember("a", "more", 1)
    game.remember("b", "x", 1)
    with pytest.raises(SceneError, match="more than 2 subjects"):
        game.remember("c", "x", 1)
    game.remember("b", "y", 1)


def test_the_client_has_the_values_of_its_player() -> None:
    match = Match(scene([[0, 0, 0, 32, 32, 1, 1]], origin=(0, 0, 0), size=(1, 1, 1)), seed=1, rules=Spies())
    ann, other = match.join(wander, Link(0.05)), match.join(wander)
    match.run(2)
    api = match.game.api
    assert (ann.core.private, other.core.private) == ({"role": "guard"}, {"role": "guard"})
    api.share_with(api.players[ann.core.entity], "clue", 1)
    match.run(1)
    assert (ann.core.private, other.core.private) == ({"role": "guard", "clue": 1}, {"role": "guard"})
    assert ann.core.shared == {}
