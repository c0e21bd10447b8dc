"""Declared commands: their fields are checked before the hook gets them, and `describe` prints them."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server import describe, flag, number, one_of, whole_number, words
from server.declared import RefusedError, Value, checked
from server.players.player import Player
from server.rules import Rules, RulesError, check_rules
from shared.checks import SceneError
from shared.scene import load_scene

COMMANDS = {
    "buy": {"item": one_of("sword", "bow"), "count": whole_number(1, 99, default=1)},
    "say": {"text": words(5, 2), "loud": flag(default=False)},
    "aim": {"x": number(-1, 1)},
    "leave": {},
}


@pytest.mark.parametrize(
    ("name", "payload", "found"),
    [
        ("buy", {"item": "bow"}, {"item": "bow", "count": 1}),
        ("buy", {"item": "bow", "count": 1000}, {"item": "bow", "count": 99}),
        ("buy", {"item": "bow", "count": -5}, {"item": "bow", "count": 1}),
        ("say", {"text": "a long text", "loud": True}, {"text": "a lon", "loud": True}),
        ("aim", {"x": 7}, {"x": 1.0}),
        ("leave", None, {}),
        ("leave", {}, {}),
    ],
)
def test_values_are_kept_within_their_bounds(name: str, payload: Any, found: dict[str, Any]) -> None:
    assert checked(COMMANDS, name, payload) == found


@pytest.mark.parametrize(
    ("name", "payload", "reason"),
    [
        ("sell", {}, "'sell': no such command (there are buy, say, aim, leave)"),
        ("buy", [], "buy: must be a table of item, count"),
        ("buy", {}, "buy.item: missing"),
        ("buy", {"item": "shoe"}, "buy.item = 'shoe': must be one of sword, bow"),
        ("buy", {"item": "bow", "count": True}, "buy.count = True: must be a whole number"),
        ("buy", {"item": "bow", "count": 1.0}, "buy.count = 1.0: must be a whole number"),
        ("buy", {"item": "bow", "price": 0}, "buy.'price': no such field (there are item, count)"),
        ("say", {"text": "a"}, "say.text = 'a': must be a text of at least 2 characters"),
        ("say", {"text": "abc", "loud": 1}, "say.loud = 1: must be true or false"),
        ("aim", {"x": float("nan")}, "aim.x = nan: must be a finite number"),
        ("leave", {"why": 1}, "leave.'why': no such field (there are none)"),
    ],
)
def test_all_else_is_refused_with_a_reason_that_names_it(name: str, payload: Any, reason: str) -> None:
    with pytest.raises(RefusedError) as refused:
        checked(COMMANDS, name, payload)
    assert str(refused.value) == reason


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(), st.lists))
def test_any_payload_is_checked_or_refused(payload: Any) -> None:
    for name in COMMANDS:
        for given_ in (payload, {"item": payload, "count": payload, "text": payload, "x": payload}, {"x": payload}):
            try:
                found = checked(COMMANDS, name, given_)
            except RefusedError:
                continue
            assert found.keys() == COMMANDS[name].keys()


@pytest.mark.parametrize(
    ("commands", "reason"),
    [
        ([], "commands = []: must be a table of commands"),
        ({"buy": 1}, "commands['buy'] = 1: must be a table of fields"),
        ({"buy": {"item": 1}}, "commands['buy'].item = 1: must be whole_number(...), words(...), ..."),
        ({"buy": {"count": whole_number(1, 2, default="x")}}, "default = 'x': must be a whole number"),
        ({"b" * 33: {}}, "must be a text of 1 to 32 characters"),
    ],
)
def test_a_wrong_declaration_is_an_error_at_the_start(commands: Any, reason: str) -> None:
    class Mine(Rules):
        pass

    Mine.commands = commands
    with pytest.raises(RulesError) as refused:
        check_rules(Mine())
    assert reason in str(refused.value)


def test_wrong_bounds_are_refused_where_they_are_written() -> None:
    with pytest.raises(SceneError, match="low"):
        whole_number(2, 1)
    with pytest.raises(SceneError, match="low"):
        number(2, 1)
    with pytest.raises(SceneError, match="longest"):
        words(0)
    with pytest.raises(SceneError, match="one_of"):
        one_of()


def test_describe_prints_what_a_game_consists_of(capsys: pytest.CaptureFixture[str]) -> None:
    class Mine(Rules):
        commands = COMMANDS
        events = {"said": "text, by"}  # noqa: RUF012
        attributes = {"score": "points"}  # noqa: RUF012

        def on_command(self, player: Player, name: str, payload: Any) -> bool:
            return True

    lines = list(describe.described(Mine(), load_scene("flat")))
    assert "  hooks       on_command" in lines
    assert "  command     buy(item: one of sword, bow, count: whole number, 1 to 99 = 1)" in lines
    assert "  event       said: text, by" in lines
    assert "  attribute   score: points" in lines
    assert describe.main(["--game", "sovereign_netcode.examples.dodge:Dodge"]) == 0
    assert "behaviour   Dodger of player, dashing" in capsys.readouterr().out


def test_a_value_of_ones_own_is_possible() -> None:
    even = Value("even number", lambda value: value if value % 2 == 0 else 1 / 0)
    assert checked({"go": {"by": even}}, "go", {"by": 4}) == {"by": 4}
