"""The form of scripts/: commands are short and can be started, and packages are imported by their full names."""

import ast
import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "scripts"
COMMANDS = [
    path
    for path in sorted(SCRIPTS.iterdir())
    if path.is_file() and path.name not in ("__init__.py", "environment.py") and path.suffix != ".pyc"
]
MODULES = sorted([*SCRIPTS.rglob("*.py"), *(ROOT / "tests").rglob("*.py")])


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: path.name)
def test_a_command_is_short_and_has_a_docstring(path: Path) -> None:
    text = path.read_text("utf-8")
    assert text.startswith("#!/usr/bin/env python3\n")
    assert text.count("\n") <= 40
    assert ast.get_docstring(ast.parse(text))
    assert os.name == "nt" or os.access(path, os.X_OK)


@pytest.mark.parametrize("path", [*COMMANDS, SCRIPTS / "environment.py"], ids=lambda path: path.name)
def test_an_older_python_can_look_for_a_newer_one(path: Path) -> None:
    ast.parse(path.read_text("utf-8"), feature_version=(3, 7))


def test_a_command_and_a_package_never_share_a_name() -> None:
    packages = {path.name for path in SCRIPTS.iterdir() if path.is_dir()}
    assert packages & {path.stem for path in COMMANDS if path.suffix} == set(), "Python would import the package"


def test_each_package_says_what_it_is_for_and_is_in_the_architecture() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    for package in sorted({path.parent for path in SCRIPTS.rglob("*.py")} - {SCRIPTS}):
        assert ast.get_docstring(ast.parse((package / "__init__.py").read_text("utf-8")))
        assert f"](scripts/{package.relative_to(SCRIPTS).as_posix()})" in page


def test_no_module_is_private_or_searched_for_elsewhere() -> None:
    assert [
        path for path in SCRIPTS.rglob("*.py") if path.stem[0] == "_" and path.stem.strip("_") not in ("init", "main")
    ] == []
    change = "sys.path" + "."
    assert [path for path in MODULES if f"{change}insert(" in path.read_text("utf-8")] == []
    assert [path for path in MODULES if f"{change}append(" in path.read_text("utf-8")] == []
