"""Tables in the pages have a row for each thing in the code, and no other rows."""

import re
import tomllib
from dataclasses import fields
from typing import get_args

from client_sdk import events
from server.game_api.api import GameApi
from server.rules import HOOKS
from shared.scene import Template
from tests.readme.pages import ROOT, section

README = ROOT / "README.md"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CALLED_BY_THE_GAME = {"banned", "discard", "forget_private", "turn_results", "hosting", "sent_away"}
"""Methods of the game API's class that hooks do not call."""


def first_cells(text: str) -> list[str]:
    """Returns the code in the first cells of a text's tables, without arguments."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("|")]
    return [re.sub(r"\W.*", "", code) for cell in cells for code in re.findall(r"`([^`]+)`", cell)]


def test_events_of_a_client() -> None:
    told = first_cells(section(ROOT / "docs" / "client.md", "Events"))
    assert sorted(told) == sorted(event.__name__ for event in get_args(events.Event))


def test_fields_of_a_template() -> None:
    told = first_cells(section(ROOT / "docs" / "games.md", "Templates"))
    assert sorted(told) == sorted(field.name for field in fields(Template) if field.name != "name")


def test_hooks() -> None:
    text = section(README, "Your own game").partition("### Hooks")[2].partition("###")[0]
    assert sorted(first_cells(text)) == sorted(HOOKS)


def test_the_game_api() -> None:
    text = section(README, "Your own game").partition("### The game API")[2].partition("###")[0]
    rows = "".join(re.findall(r"^\|.*\n", text, re.MULTILINE))
    named = re.findall(r"`(\w+)(?:\([^`]*\))?`", rows)
    public = {name for name in dir(GameApi) if not name.startswith("_")} - CALLED_BY_THE_GAME
    assert sorted(named) == sorted({*public, "players"})


def test_extras_and_commands() -> None:
    text = section(README, "Installing it")
    names = re.findall(r"^\| `([\w-]+)", text, re.MULTILINE)
    assert sorted(names) == sorted([*PROJECT["optional-dependencies"], *PROJECT["scripts"]])
