"""The imports of the product's sources in the wheel (hatch_build.py)."""

import ast
from pathlib import Path

import pytest

import hatch_build
from hatch_build import FOLDERS, PACKAGE, RewriteError, rewritten
from tests.lengths import long_but

ROOT = Path(__file__).resolve().parents[2]
MODULES = frozenset(hatch_build.module_names(ROOT))
SOURCES = [
    *(file for file in hatch_build.files(ROOT / PACKAGE) if file.suffix == ".py"),
    *(file for folder in FOLDERS for file in hatch_build.files(ROOT / folder) if file.suffix == ".py"),
]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("from server.game import Game\n", "from sovereign_netcode.server.game import Game\n"),
        ("from shared import edits, messages as m\n", "from sovereign_netcode.shared import edits, messages as m\n"),
        ("from server import *\n", "from sovereign_netcode.server import *\n"),
        ("import server.game as g\n", "import sovereign_netcode.server.game as g\n"),
        (
            "import os, shared as s, server.game as g\n",
            "import os, sovereign_netcode.shared as s, sovereign_netcode.server.game as g\n",
        ),
        ("from \\\n  shared.ring import Ring\n", "from \\\n  sovereign_netcode.shared.ring import Ring\n"),
        ("from shared . ring import Ring\n", "from sovereign_netcode.shared . ring import Ring\n"),
        ("if 1: from shared.a import b\n", "if 1: from sovereign_netcode.shared.a import b\n"),
        ("def f():\n\tfrom shared.a import b\n", "def f():\n\tfrom sovereign_netcode.shared.a import b\n"),
        ("x = 'äö→𝕏'; from shared.a import b\n", "x = 'äö→𝕏'; from sovereign_netcode.shared.a import b\n"),
        ("x = '\u2028\x0c'\nfrom shared.a import b\n", "x = '\u2028\x0c'\nfrom sovereign_netcode.shared.a import b\n"),
        (
            "from shared.a import (\n    b,\n    c,\n)\n",
            "from sovereign_netcode.shared.a import (\n    b,\n    c,\n)\n",
        ),
        ('"""See `server.game`."""\n', '"""See `sovereign_netcode.server.game`."""\n'),
        ("x = f'{1}: python -m server --port {2}'\n", "x = f'{1}: python -m sovereign_netcode.server --port {2}'\n"),
        ("# `shared.ring.Ring` and `server`\n", "# `sovereign_netcode.shared.ring.Ring` and `server`\n"),
    ],
)
def test_a_module_of_the_folders_gets_its_full_name(source: str, expected: str) -> None:
    assert rewritten(source, "a.py", MODULES) == expected


@pytest.mark.parametrize(
    "source",
    [
        "from . import server\nfrom .server import a\nfrom .. import shared\n",
        "from serverless import a\nimport shared_memory\nimport os.server\n",
        "from sovereign_netcode.server import rules\nimport sovereign_netcode.server.rules\n",
        "def f(server):\n    yield from server\n    raise ValueError from server.error\n",
        "self.server.game = server.game[shared:server]\n",
        "kept = ['shared', 'server', 'server.toml', 'python -m servers', '-m']\n",
        "import importlib\nimportlib.import_module(server.name)\n",
    ],
)
def test_everything_else_stays(source: str) -> None:
    assert rewritten(source, "a.py", MODULES) == source


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import server.game\n", "a.py:1: import server.game: write from server import game"),
        ("\nimport os, shared\n", "a.py:2: import shared: write from sovereign_netcode import shared"),
        ("f('server.game')\n", "a.py:1: 'server.game': write 'sovereign_netcode.server.game'"),
        ("x = 'server.game:Game'\n", "a.py:1: 'server.game:Game': write 'sovereign_netcode.server.game:Game'"),
        ("x: 'shared.ring.Ring'\n", "a.py:1: 'shared.ring.Ring': write 'sovereign_netcode.shared.ring.Ring'"),
        ("run('-m', 'server')\n", "a.py:1: '-m', 'server': write '-m', 'sovereign_netcode.server'"),
        ("x = [y, '-m', 'server', z]\n", "a.py:1: '-m', 'server': write '-m', 'sovereign_netcode.server'"),
    ],
)
def test_an_import_that_would_fail_in_the_wheel_is_refused(source: str, reason: str) -> None:
    with pytest.raises(RewriteError) as error:
        rewritten(source, "a.py", MODULES)
    assert str(error.value) == reason


@pytest.mark.parametrize("file", long_but(SOURCES[::8], SOURCES), ids=lambda file: str(file.relative_to(ROOT)))
def test_a_source_of_the_product_differs_in_names_only(file: Path) -> None:
    before = file.read_text("utf-8")
    after = rewritten(before, file.name, MODULES)
    assert len(after.splitlines()) == len(before.splitlines())
    assert not any(name.partition(".")[0] in FOLDERS for name in imported(after))
    prefix = f"{PACKAGE}."
    plain = [ast.dump(ast.parse(text)).replace(prefix, "") for text in (before, after)]
    assert plain[0] == plain[1]


def imported(source: str) -> list[str]:
    """Returns the absolute names of all modules that a source imports."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [part.name for part in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.append(node.module or "")
    return names


def test_the_package_alone_has_no_alias(tmp_path: Path) -> None:
    hatch_build.stage(ROOT, tmp_path)
    assert ast.get_docstring(ast.parse((tmp_path / "__init__.py").read_text("utf-8")))
    assert imported((tmp_path / "__init__.py").read_text("utf-8")) == []
    assert not (tmp_path / "_checkout.py").exists()
    assert not list(tmp_path.rglob("*.pyi"))
    assert not list(tmp_path.rglob("__pycache__"))


def test_files_that_are_no_sources_are_carried_as_they_are(tmp_path: Path) -> None:
    root, place = tmp_path / "root", tmp_path / "place"
    content = bytes(range(256)) + b"\r\nfrom server.game import Game\r\n"
    for name in ("sovereign_netcode/__init__.py", "server/a.py", "client_sdk/a.py", "shared/deep/kernel.so"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content if name.endswith(".so") else b'"""A module."""\n')
    (root / "server" / "__pycache__").mkdir()
    (root / "server" / "__pycache__" / "a.nbc").write_bytes(b"cache")
    hatch_build.stage(root, place)
    found = {file.relative_to(place).as_posix() for file in place.rglob("*") if file.is_file()}
    assert found == {"__init__.py", "server/a.py", "client_sdk/a.py", "shared/deep/kernel.so"}
    assert (place / "shared/deep/kernel.so").read_bytes() == content


def test_python_for_browsers_is_carried_once_it_is_complete(tmp_path: Path) -> None:
    root, place = tmp_path / "root", tmp_path / "place"
    for name in ("sovereign_netcode/__init__.py", "build/browser/python_stdlib.zip.gz"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b'"""A module."""\n')
    hatch_build.stage(root, place)
    assert not (place / "server").exists()
    (root / "build/browser/stamp.json").write_text("{}", "utf-8")
    hatch_build.stage(root, place)
    found = {file.name for file in (place / "server/play/runtime").iterdir()}
    assert found == {"python_stdlib.zip.gz", "stamp.json"}
