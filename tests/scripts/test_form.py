"""The form of all sources: no file and no function is too long to be read at once."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("client_sdk", "scripts", "server", "shared", "sovereign_netcode")
FILE_LINES_MAX = 400
FUNCTION_LINES_MAX = 70
"""Maximum number of lines of a function, from its `def` to its end, with its docstring."""
KERNELS = ("shared/bulk.py", "shared/kernel.py")
"""Files that may be longer, with longer functions: their form is that of the compiled kernel."""


def too_long(name: str, source: str) -> Iterator[str]:
    """Yields the file, if it is too long, and each function in it that is."""
    lines = len(source.splitlines())
    if lines > FILE_LINES_MAX:
        yield f"{name}: {lines} lines; at most {FILE_LINES_MAX}"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            lines = node.end_lineno - node.lineno + 1
            if lines > FUNCTION_LINES_MAX:
                yield f"{name}:{node.lineno}: {node.name} has {lines} lines; at most {FUNCTION_LINES_MAX}"


def found(name: str) -> list[str]:
    return list(too_long(name, (ROOT / name).read_text("utf-8")))


def test_no_file_and_no_function_is_too_long() -> None:
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    assert set(KERNELS) <= set(names)
    assert [text for name in names if name not in KERNELS for text in found(name)] == []


@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_needs_its_exception(name: str) -> None:
    assert found(name) != []


@pytest.mark.parametrize("start", ["def f():", "async def f():", "class A:\n  def f(self):", "def g():\n def f():"])
def test_a_long_function_is_found(start: str) -> None:
    indent = " " * start.count("\n") + "  "
    longest = f"{start}\n" + f"{indent}pass\n" * (FUNCTION_LINES_MAX - 1)
    assert [text for text in too_long("a.py", longest) if " f has " in text] == []
    (text,) = (text for text in too_long("a.py", f"{longest}{indent}pass\n") if " f has " in text)
    assert text == f"a.py:{start.count(chr(10)) + 1}: f has 71 lines; at most 70"


def test_a_long_file_is_found() -> None:
    assert list(too_long("a.py", "\n" * FILE_LINES_MAX)) == []
    assert list(too_long("a.py", "\n" * (FILE_LINES_MAX + 1))) == ["a.py: 401 lines; at most 400"]
