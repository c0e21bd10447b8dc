"""A wall clock may jump (set by hand, by the network, by daylight saving): nothing that plays looks at one."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WALL = {"time", "time_ns", "localtime", "gmtime", "ctime", "asctime", "strftime"}
"""Of the module time: all that tell what a wall clock shows."""
ALLOWED = {"server/auth/tokens.py"}
"""How long a token is good for is said in the world's time; it is looked at when somebody comes in, and only then."""
SOURCES = sorted(
    path.relative_to(ROOT).as_posix()
    for part in ("shared", "server", "client_sdk")
    for path in (ROOT / part).rglob("*.py")
)


def wall_clocks(source: str) -> list[str]:
    """What a module uses of wall clocks."""
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
