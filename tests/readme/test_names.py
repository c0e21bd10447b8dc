"""Files, functions, classes and constants that the pages name exist, in the files that the pages link to."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.readme.pages import PAGES, ROOT, section

LINK = re.compile(r"\[`([^`]+)`\]\(([^)#\s]+)\)")
"""A link whose text is code: a path, or the name of what its target defines."""
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")
FOLDERS = ("client_sdk", "server", "shared", "sovereign_netcode", "scripts")

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def definitions(path: Path) -> frozenset[str]:
    """Returns the names that a source file defines: `f`, `Class`, `CONSTANT`, `Class.method`, `Class.attribute`."""
    found: set[str] = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        found.update(_names(node))
        if isinstance(node, ast.ClassDef):
            own = [name for inner in node.body for name in _names(inner)]
            own += [name for inner in ast.walk(node) for name in _names(inner, of="self")]
            found.update(f"{node.name}.{name}" for name in own)
    return frozenset(found)


def _names(node: ast.AST, of: str = "") -> list[str]:
    """Returns the names that a statement defines, or the attributes of the object `of` that it assigns."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [] if of else [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    flat = [part for target in targets for part in (target.elts if isinstance(target, ast.Tuple) else [target])]
    if of:
        return [part.attr for part in flat if isinstance(part, ast.Attribute) and ast.unparse(part.value) == of]
    return [part.id for part in flat if isinstance(part, ast.Name)]


def wrong(page: Path, text: str, target: str) -> str:
    """Returns why the text of a link is wrong for its target; empty if it is right."""
    path = (page.parent / target).resolve()
    if not path.exists():
        return f"{target}: no such file"
    if "/" in text or path.suffix != ".py" or text.endswith(".py"):
        is_it = f"/{path.relative_to(ROOT).as_posix()}".endswith(f"/{text.rstrip('/')}")
        return "" if is_it else f"{text}: is {target}"
    return "" if text.removesuffix("()") in definitions(path) else f"{text}: not in {target}"


@each_page
def test_a_link_names_what_its_file_defines(page: Path) -> None:
    assert [why for link in LINK.findall(page.read_text("utf-8")) if (why := wrong(page, *link))] == []


def test_a_wrong_name_is_found() -> None:
    readme = ROOT / "README.md"
    assert wrong(readme, "set_input", "client_sdk/base.py") == "set_input: not in client_sdk/base.py"
    assert wrong(readme, "BaseClient.set_input", "client_sdk/base.py") == ""
    assert wrong(readme, "BaseClient.core", "client_sdk/base.py") == ""
    assert wrong(readme, "BaseClient.x", "client_sdk/base.py") == "BaseClient.x: not in client_sdk/base.py"
    assert wrong(readme, "Client.set_input", "client_sdk/client.py") == "Client.set_input: not in client_sdk/client.py"
    assert wrong(readme, "REPEATS_S", "shared/bounds.py") == ""
    assert wrong(readme, "client_sdk/client.py", "client_sdk/base.py") == "client_sdk/client.py: is client_sdk/base.py"
    assert wrong(readme, "lient.py", "client_sdk/client.py") == "lient.py: is client_sdk/client.py"
    assert wrong(readme, "Client", "client_sdk/clients.py") == "client_sdk/clients.py: no such file"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param((ROOT / "ARCHITECTURE.md").read_text("utf-8"), id="ARCHITECTURE.md"),
        pytest.param(section(ROOT / "README.md", "The path of one input"), id="README.md"),
    ],
)
def test_a_name_without_a_link_exists_too(text: str) -> None:
    sources = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    known = {name for path in sources for name in definitions(path)}
    known |= {name.rpartition(".")[2] for name in known} | {"self.game", *sys.stdlib_module_names}
    plain = re.findall(r"`([^`]+)`", LINK.sub("", FENCE.sub("", text)))
    names = [name for name in plain if NAME.fullmatch(name.removesuffix("()")) and not (ROOT / name).exists()]
    assert [name for name in names if name.removesuffix("()") not in known] == []


@pytest.mark.parametrize("folder", ["client_sdk", "server", "shared"])
def test_the_architecture_has_each_module(folder: str) -> None:
    page = ROOT / "ARCHITECTURE.md"
    linked = {(page.parent / target).resolve() for _, target in LINK.findall(page.read_text("utf-8"))}
    assert [path.name for path in (ROOT / folder).rglob("*.py") if path.stem[0] != "_" and path not in linked] == []
