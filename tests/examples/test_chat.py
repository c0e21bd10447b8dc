"""The chat example: played by clients in simulated time."""

from typing import Any

import pytest

from client_sdk.core import Core
from client_sdk.events import Answered, Happened, Left
from server.rules import check_rules, with_options
from shared import messages
from shared.inputs import NEUTRAL
from shared.scene import load_scene
from sovereign_netcode.examples.chat import LINE_MAX, LINES, WINDOW_S, Chat, tidy
from sovereign_netcode.playtest import Link, Match
from sovereign_netcode.playtest.match import Player


def stands(core: Core, rng: Any) -> Any:
    return NEUTRAL


def room(*names: str) -> tuple[Match, list[Player]]:
    """Returns a match of the chat with players, whose tokens are their names."""
    match = Match(load_scene("flat"), seed=1, rules=with_options(Chat, {"moderators": "ann,zoe"}))
    match.game.joining.authenticate = lambda token: token
    players = [match.join(stands, Link(0.02), Core(name, token=name.lower())) for name in names]
    match.run_until(lambda: all(player.core.state == "playing" for player in players), 10)
    return match, players


def happened(player: Player, name: str) -> list[Any]:
    return [event.data for event in player.events if isinstance(event, Happened) and event.name == name]


def answer(match: Match, player: Player, name: str, data: Any) -> str:
    """Sends a command and returns its verdict."""
    number = player.core.command(name, data)
    match.run(0.5)
    (found,) = (event for event in player.events if isinstance(event, Answered) and event.number == number)
    return found.verdict


def test_messages_reach_all_and_whispers_two() -> None:
    match, (ann, bob, cleo) = room("Ann", "Bob", "Cleo")
    assert answer(match, ann, "say", {"text": " hello\n\u202e all "}) == "done"
    assert answer(match, bob, "whisper", {"to": "ann", "text": "psst"}) == "done"
    assert answer(match, bob, "whisper", {"to": "zoe", "text": "psst"}) == "nobody here is called zoe"
    assert answer(match, cleo, "say", {"text": " \u200b "}) == "there is nothing to say"
    assert answer(match, cleo, "say", {"txt": "hello"}).startswith("say.'txt': no such field")
    assert answer(match, cleo, "say", {"text": "x" * 500}) == "done"
    said = [
        {"by": ann.core.entity, "text": "hello all"},
        {"by": cleo.core.entity, "text": "x" * LINE_MAX},
    ]
    assert [happened(player, "said") for player in (ann, bob, cleo)] == [said] * 3
    assert [len(happened(player, "whispered")) for player in (ann, bob, cleo)] == [1, 1, 0]
    assert match.game.counters.rules_failed == 0


def test_a_player_who_talks_too_much_has_to_wait() -> None:
    match, (ann,) = room("Ann")
    assert [answer(match, ann, "say", {"text": "a"}) for _ in range(LINES)] == ["done"] * LINES
    assert answer(match, ann, "say", {"text": "a"}) == "at most 4 messages in 8 s"
    match.run(WINDOW_S)
    assert answer(match, ann, "say", {"text": "a"}) == "done"


def test_only_moderators_remove_players() -> None:
    match, (ann, bob) = room("Ann", "Bob")
    assert answer(match, bob, "kick", {"who": "Ann"}) == "only moderators can do that"
    assert answer(match, ann, "kick", {"who": "bob"}) == "done"
    assert [event for event in bob.events if isinstance(event, Left)] == [Left(messages.KICKED, "removed by Ann")]
    again = match.join(stands, core=Core("Bobby", token="bob"))
    match.run(1)
    assert again.core.state == "closed"
    assert happened(ann, "went") == [{"who": "Bob"}]


@pytest.mark.parametrize(
    ("given", "expected"), [("a\tb\r\nc", "a b c"), ("\u2066x", "x"), ("  ", ""), ("ü 😀", "ü 😀")]
)
def test_a_tidy_message(given: str, expected: str) -> None:
    assert tidy(given) == expected


def test_the_rules_are_valid() -> None:
    check_rules(Chat())
