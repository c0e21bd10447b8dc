"""Nothing in the product uses a wall clock, which may jump, except for the expiry of tokens."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WALL = {"time", "time_ns", "localtime", "gmtime", "ctime", "asctime", "strftime"}
"""Functions of the module `time` that read a wall clock."""
ALLOWED = {"server/auth/tokens.py"}
"""Files that may read a wall clock: the expiry of a token is a wall-clock time, and is checked only at a join."""
SOURCES = sorted(
    path.relative_to(ROOT).as_posix()
    for part in ("shared", "server", "client_sdk")
    for path in (ROOT / part).rglob("*.py")
)


def wall_clocks(source: str) -> list[str]:
    """Returns the uses of wall clocks in a module."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Attribute(value=ast.Name(id="time"), attr=name) if name in WALL:
                found.append(f"time.{name}")
            case ast.ImportFrom(module="time", names=names):
                found += [f"time.{alias.name}" for alias in names if alias.name in WALL]
            case ast.Import(names=names):
                found += [alias.name for alias in names if alias.name == "datetime"]
            case ast.ImportFrom(module="datetime"):
                found.append("datetime")
    return found


@pytest.mark.parametrize("path", SOURCES)
def test_no_wall_clock_decides_anything(path: str) -> None:
    used = wall_clocks((ROOT / path).read_text("utf-8"))
    assert bool(used) == (path in ALLOWED), used


@pytest.mark.parametrize(
    "source",
    ["import time\nx = time.time()", "from time import time_ns", "import datetime", "from datetime import date"],
)
def test_a_wall_clock_is_seen(source: str) -> None:
    assert wall_clocks(source)
