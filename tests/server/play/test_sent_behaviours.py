"""The modules of a game that browsers get: those of its behaviours with what they import, and never the rules."""

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from server.play.behaviours import Modules, modules_of
from shared.behaviours import Behaviour, entry_of
from tests.readme import tutorial

BEHAVIOURS = """
from sovereign_netcode.shared.behaviours import Behaviour, field
from sovereign_netcode.shared.body import Body
{imports}

class Runner(Behaviour):
    templates = ("player",)

    def turn(self, me: Body) -> None:
        {used}
"""


@pytest.fixture
def game(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An importable folder for the modules of a game."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def sent(folder: Path, module: str, imports: str = "", used: str = "pass", **others: str) -> Modules:
    """Returns what is sent of a game whose behaviours import and use something.

    Args:
        folder: the game's folder.
        module: name of the module of the behaviours.
        imports: statements of that module.
        used: statement of the turn.
        others: sources of further modules, with two lines for a dot in the name.
    """
    own = module.replace(".", "__"), BEHAVIOURS.format(imports=imports, used=used)
    for name, source in (*others.items(), own):
        path = folder / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, "utf-8")
    importlib.invalidate_caches()
    code: type[Behaviour] = importlib.import_module(module).Runner
    return modules_of([code])


def test_the_module_and_what_it_imports(game: Path) -> None:
    found = sent(
        game,
        "my_game_a.moves",
        "import math\nfrom .speeds import FAST\nfrom my_game_a import limits, unused",
        "me.velocity = (FAST, limits.MOST, math.pi)",
        my_game_a__speeds="from my_game_a.units import BLOCK\nFAST = 3 * BLOCK\n",
        my_game_a__units="BLOCK = 1\n",
        my_game_a__limits="MOST = 5\n",
        my_game_a__unused="",
        my_game_a__rules="SECRET = 1\n",
    )
    names = ("__init__", "limits", "moves", "speeds", "units", "unused")
    assert found.files.keys() == {f"my_game_a/{name}.py" for name in names}
    assert found.classes == [("my_game_a.moves", "Runner")]
    assert found.trouble == ""
    assert found.files["my_game_a/__init__.py"] == b""


def test_a_module_beside_the_script(game: Path) -> None:
    assert sent(game, "moves_b").files.keys() == {"moves_b.py"}


GAME = """
# the secret is 42
from __future__ import annotations
import math
import secrets
from sovereign_netcode.server import Rules
from sovereign_netcode.shared.behaviours import Behaviour, field
{more}
FAST: float = 3.0
SLOW, WAIT = 1.0, 32
PASSWORD = secrets.token_hex()


def decorated(code):
    return code


def speed(way):
    return helper(way) * FAST


def helper(way):
    return math.hypot(way, SLOW)


@decorated
class Runner(Behaviour):
    templates = ("player",)  # a comment within

    def turn(self, me):
        me.velocity = (speed(1){used}, 0, 0)


class Game(Rules):
    behaviours = (Runner,)
    password = PASSWORD
"""


def test_of_a_module_with_the_rules_only_what_the_behaviours_use(game: Path) -> None:
    (game / "game_c.py").write_text(source := GAME.format(more="", used=""), "utf-8")
    found = modules_of([importlib.import_module("game_c").Runner])
    assert found.trouble == ""
    text = found.files["game_c.py"].decode()
    for word in ("42", "Rules", "secrets", "PASSWORD", "WAIT = ", "Game"):
        assert (word in source, word in text) == (True, word == "WAIT = "), word
    before, after = source.splitlines(), text.splitlines()
    assert len(before) == len(after)
    assert all(line in ("", was) for line, was in zip(after, before, strict=True))
    scope: dict[str, object] = {}
    exec(compile(text, "game_c.py", "exec"), scope)
    assert {"Runner", "speed", "helper", "decorated", "FAST", "SLOW", "math", "annotations"} <= scope.keys()


def test_the_digest_stays(game: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    (game / "game_e.py").write_text(GAME.format(more="", used=""), "utf-8")
    code: type[Behaviour] = importlib.import_module("game_e").Runner
    there = tmp_path_factory.mktemp("browser") / "game_e.py"
    there.write_bytes(modules_of([code]).files["game_e.py"])
    spec = importlib.util.spec_from_file_location("game_e", there)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["game_e"] = other = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(other)
    assert entry_of(other.Runner) == entry_of(code)


@pytest.mark.parametrize(
    "more",
    ["from sovereign_netcode.server.rules import Rules as USED", "import server.game as USED", "import server as USED"],
)
def test_behaviours_that_use_the_server_are_refused(game: Path, more: str) -> None:
    (game / "game_f.py").write_text(GAME.format(more=more, used=" * len(USED.__name__)"), "utf-8")
    found = modules_of([importlib.import_module("game_f").Runner])
    assert (found.files, found.classes) == ({}, [])
    assert found.trouble.startswith("the behaviours use ")
    assert found.trouble.endswith(", which game_f.py imports and a browser does not have")


def test_a_module_that_they_import_may_not_use_the_server_either(game: Path) -> None:
    (game / "rules_g.py").write_text("from sovereign_netcode.server import Rules\nUSED = 2\n", "utf-8")
    (game / "game_g.py").write_text(GAME.format(more="from rules_g import USED", used=" * USED"), "utf-8")
    found = modules_of([importlib.import_module("game_g").Runner])
    assert "which rules_g.py imports" in found.trouble


def test_installed_packages_are_not_sent(game: Path) -> None:
    assert sent(game, "moves_d", "import numpy, pytest", "numpy, pytest").files.keys() == {"moves_d.py"}


def test_the_game_of_the_tutorial(game: Path) -> None:
    tutorial.write(9, game)
    found = modules_of(importlib.import_module("dodge").Dodge.behaviours)
    assert (list(found.files), found.trouble) == (["abilities.py"], "")


def test_a_class_without_a_file_is_refused() -> None:
    made = type("Runner", (Behaviour,), {"__module__": "nowhere"})
    assert modules_of([made]).trouble == "the module nowhere of the behaviours has no source file"
    assert modules_of([]) == Modules({}, [])
