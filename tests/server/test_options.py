"""Options of a game from the command line and a file, and the hook of an orderly stop."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from server.app import main
from server.config.options import SettingsError
from server.config.settings import Settings, parse
from server.declared import Value, flag, number, one_of, whole_number, words
from server.rules import Rules, RulesError, check_rules, with_options
from tests.server.test_persisted_state import Stored
from tests.tables import Table

GAME = """
from server import Rules, flag, number, one_of, whole_number, words

class Rounds(Rules):
    options = {
        "round_s": number(10, 3600, default=120), "teams": flag(default=False), "lives": whole_number(1, 9, default=3),
        "map_name": one_of("big", "small", default="big"), "motto": words(10, default="go"),
    }

class Plain(Rules):
    pass
"""


class Rounds(Rules):
    options: Mapping[str, Value] = {
        "round_s": number(10, 3600, default=120), "teams": flag(default=False), "lives": whole_number(1, 9, default=3),
        "size": one_of("big", "small", default="big"), "motto": words(10, default="go"),
    }  # fmt: skip
    round_s: float
    teams: bool
    lives: int
    size: str
    motto: str

    def __init__(self) -> None:
        self.at_init = (self.round_s, self.teams, self.lives, self.size, self.motto)


def test_options_have_their_defaults_and_can_be_assigned() -> None:
    rules = Rounds()
    assert rules.at_init == (120, False, 3, "big", "go")
    rules.round_s = 20
    assert (rules.round_s, Rounds().round_s) == (20, 120)
    with pytest.raises(AttributeError, match="no attribute 'rounds'"):
        _ = rules.rounds  # type: ignore[attr-defined]


def test_texts_are_converted_to_the_type_of_the_option() -> None:
    given = {"round_s": "90", "teams": "yes", "lives": "5", "size": "small", "motto": "12"}
    made = with_options(Rounds, given)
    assert isinstance(made, Rounds)
    assert made.at_init == (90.0, True, 5, "small", "12")
    typed = with_options(Rounds, {"round_s": 12.5, "teams": True, "lives": 1})
    assert isinstance(typed, Rounds)
    assert typed.at_init == (12.5, True, 1, "big", "go")


@pytest.mark.parametrize(
    ("name", "given", "why"),
    [
        ("round_s", "5", "option round_s = '5': must be: number, 10 to 3600"),
        ("round_s", "soon", "must be: number"), ("round_s", "nan", "must be: number"),
        ("lives", "2.5", "must be: whole number, 1 to 9"), ("lives", "10", "must be: whole"),
        ("lives", True, "must be: whole"),
        ("teams", "1", "must be: true or false"), ("size", "huge", "must be: one of big, small"),
        ("motto", "x" * 11, "must be: text"), ("motto", 7, "must be: text"),
        ("round", "5", r"option round = '5': no such option \(did you mean round_s\?\)"),
        ("scene", "flat", r"no such option"),
    ],
)  # fmt: skip
def test_a_wrong_option_is_named(name: str, given: object, why: str) -> None:
    with pytest.raises(RulesError, match=why):
        with_options(Rounds, {name: given})


@pytest.mark.parametrize(
    "options", [
        {"lives": whole_number(1, 9)}, {"scene": words(9, default="")}, {"on_tick": flag(default=True)}, {"lives": 3},
        {"a b": flag(default=True)}, {"_x": flag(default=True)}, {"n": words(2, default=3)}, ["n"], {"game": flag()},
    ]
)  # fmt: skip
def test_a_wrong_declaration_is_refused(options: Any) -> None:
    made = type("Wrong", (Rules,), {"options": options})
    with pytest.raises(RulesError, match=r"Wrong\.options"):
        check_rules(made())
    with pytest.raises(RulesError, match=r"Wrong\.options"):
        with_options(made, {"n": 1})


def test_rules_that_are_no_class_have_no_options() -> None:
    for rules in (Rounds(), dict, None):
        with pytest.raises(RulesError, match="is no subclass"):
            with_options(rules, {"a": 1})


def settings(*arguments: str) -> Settings:
    found = parse(arguments, {})
    assert isinstance(found, Settings)
    return found


def test_options_come_from_the_command_line_and_the_file(tmp_path: Path) -> None:
    path = tmp_path / "server.toml"
    path.write_text('game = "a:B"\n[options]\nround_s = 30\nmotto = "hi"\n', "utf-8")
    found = settings("--config", str(path), "--option", "round_s=40", "--option", "teams=yes", "--option", "text=a=b")
    assert found.options == {"round_s": "40", "motto": "hi", "teams": "yes", "text": "a=b"}
    printed = parse(["--config", str(path), "--option", "round_s=40", "--print-config"], {})
    assert 'round_s = "40"  # --option\n' in str(printed)
    again = tmp_path / "again.toml"
    again.write_text(str(printed), "utf-8")
    assert settings("--config", str(again)).options == {"round_s": "40", "motto": "hi"}
    assert settings("--game", "a:B").options == {}


def test_wrong_options_in_the_settings(tmp_path: Path) -> None:
    for wrong in ("round_s", "=5", ""):
        with pytest.raises(SettingsError, match="must be NAME=VALUE"):
            settings("--game", "a:B", "--option", wrong)
    with pytest.raises(SettingsError, match=r"option round_s \(from --option\): is of a game; give --game, too"):
        settings("--option", "round_s=5")
    path = tmp_path / "server.toml"
    path.write_text('game = "a:B"\noptions = 7\n', "utf-8")
    with pytest.raises(SettingsError, match="options = 7"):
        settings("--config", str(path))


def test_the_commands_name_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "optional_game.py").write_text(GAME, "utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert main(["describe", "--game", "optional_game:Rounds"]) == 0
    assert "  option      round_s: number, 10 to 3600 = 120\n" in capsys.readouterr().out
    assert main(["--game", "optional_game:Rounds", "--option", "lives=12"]) == 2
    assert "option lives = '12': must be: whole number, 1 to 9" in capsys.readouterr().err
    assert main(["--game", "optional_game:Plain", "--option", "lives=1"]) == 2
    assert "no such option (there are none)" in capsys.readouterr().err


class Closing(Rules):
    """Rules that act when the server stops."""

    def __init__(self) -> None:
        self.stops = 0

    def on_stop(self) -> None:
        self.stops += 1
        self.game.share("closed", self.stops)
        for entity in self.game.entities():
            self.game.set(entity, "asleep", True)
        self.game.set_block(3, 3, 3, 7)
        self.game.after(0, "wake")

    def wake(self) -> None:
        self.game.share("woken", True)


def test_what_the_rules_do_at_the_stop_is_saved(tmp_path: Path) -> None:
    rules = Closing()
    first = Stored(tmp_path, rules)
    npc = first.game.api.spawn("stone", (10.0, 10.0, 1.0))
    first.tick(2)
    link = first.join()
    first.game.shut_down("the server is going down", 2.0)
    first.game.shut_down("again", 2.0)
    assert (rules.stops, first.game.counters.rules_failed) == (1, 0)
    assert link.closings
    first.stop()
    second = Stored(tmp_path, Closing())
    assert dict(second.game.api.shared) == {"closed": 1}
    assert second.game.api.get(npc, "asleep") is True
    assert second.game.api.block(3, 3, 3) == 7
    second.tick(3)
    assert second.game.api.shared["woken"] is True
    second.stop()


def test_a_game_that_never_ticked_has_nothing_to_stop() -> None:
    rules = Closing()
    Table(rules=rules).game.shut_down("going down", -1.0)
    assert rules.stops == 0


def test_a_stop_that_raises_stops_nothing() -> None:
    class Broken(Rules):
        def on_stop(self) -> None:
            raise RuntimeError("not now")

    table = Table(rules=Broken())
    link = table.join()
    table.game.shut_down("going down", -1.0)
    assert (table.game.counters.rules_failed, len(link.closings)) == (1, 1)
