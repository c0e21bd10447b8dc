"""The files of docs/tutorial.md after each of its steps: `python -m tests.readme.tutorial STEP FOLDER` writes them.

A fence with a file name belongs to the tutorial. If its text begins with a docstring, or is not Python, it is the whole
file. Otherwise it shows parts of the file that are new or changed: a class, a method, a function, an import or a
variable replaces the one with its name, or is added.
"""

import ast
import re
import sys
from pathlib import Path
from typing import NamedTuple

from tests.readme.pages import ROOT

PAGE = ROOT / "docs" / "tutorial.md"
_STEP_OR_FILE = re.compile(r"^## (\d+)\. [^\n]+$|^```\w+ ([\w.]+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ORDER = ("import", "value", "def", "main")
"""Kinds of statements in the order in which a file has them."""


class Part(NamedTuple):
    """A statement of a file or of a class, with the blank lines and comments before it."""

    kind: str
    name: str
    text: str
    body: "list[Part] | None" = None


def steps() -> dict[int, dict[str, str]]:
    """Returns the content of all files by name, after each step by its number."""
    found: dict[int, dict[str, str]] = {}
    files: dict[str, str] = {}
    number = 0
    for step, name, text in _STEP_OR_FILE.findall(PAGE.read_text("utf-8")):
        if step:
            number = int(step)
        elif not name.endswith(".py") or text.startswith('"""'):
            files[name] = text
        else:
            files[name] = merged(files[name], text)
        found[number] = dict(files)
    return found


def merged(old: str, new: str) -> str:
    """Returns a file with the parts that `new` shows replaced or added."""
    return _written(_merged(_parts(old, ast.parse(old).body), _parts(new, ast.parse(new).body)))


def _parts(text: str, body: list[ast.stmt], start: int = 0) -> list[Part]:
    """Returns the statements of a file or of a class, which begins at line `start` of `text`."""
    lines, found = text.splitlines(keepends=True), []
    for node in body:
        assert node.end_lineno is not None
        own = "".join(lines[start : node.end_lineno])
        if isinstance(node, ast.ClassDef):
            head = "".join(lines[start : node.lineno])
            found.append(Part("def", node.name, head, _parts(text, node.body, node.lineno)))
        else:
            found.append(Part(*_named(node), own))
        start = node.end_lineno
    return found


def _named(node: ast.stmt) -> tuple[str, str]:
    """Returns the kind of a statement, and the name by which another one replaces it."""
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
            return "def", name
        case ast.ImportFrom(module=module):
            return "import", str(module)
        case ast.Import(names=[alias]):
            return "import", alias.name
        case ast.Assign(targets=[target]):
            return "value", ast.unparse(target)
        case ast.Expr(value=ast.Constant()):
            return "import", "docstring"
        case ast.If():
            return "main", "main"
    raise AssertionError(f"the tutorial has no rule for: {ast.unparse(node)}")


def _merged(old: list[Part], new: list[Part]) -> list[Part]:
    found = list(old)
    for part in new:
        names = [each.name for each in found]
        if part.name in names:
            at = names.index(part.name)
            before = found[at]
            if before.body is not None and part.body is not None:
                part = before._replace(body=_merged(before.body, part.body))
            found[at] = part
        else:
            order = _ORDER.index(part.kind)
            peers = [i for i, each in enumerate(found) if each.kind == part.kind]
            found.insert(peers[-1] + 1 if peers else sum(_ORDER.index(each.kind) < order for each in found), part)
    return found


def _written(parts: list[Part], depth: int = 0) -> str:
    """Returns the text of a file or of a class, with the blank lines that a formatter puts between its parts."""
    text = ""
    for before, part in zip([None, *parts], parts, strict=False):
        if before is None:
            blank = 0
        elif "def" in (before.kind, part.kind) or part.kind == "main":
            blank = 1 if depth else 2
        else:
            blank = 1 if before.kind != part.kind else len(part.text) - len(part.text.lstrip("\n"))
        text += "\n" * blank + part.text.lstrip("\n")
        if part.body is not None:
            text += _written(part.body, depth + 1)
    return text


def write(step: int, folder: Path) -> None:
    """Writes the files after a step to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in steps()[step].items():
        (folder / name).write_text(text, "utf-8")


if __name__ == "__main__":
    write(int(sys.argv[1]), Path(sys.argv[2]))
