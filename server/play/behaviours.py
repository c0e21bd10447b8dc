"""The files of a game that browsers get: its behaviours, what these use, and the modules that they import.

A browser runs the behaviours in Python, as every client does, so everybody can read what is sent. Of a module with
behaviours that is only what they use: their classes, and the imports, constants and functions that these name. All else
in it, such as the rules, is left out. Behaviours that use the server are refused with a reason.
"""

import ast
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from shared.behaviours import Behaviour

OURS = "sovereign_netcode"
SENT = ("shared", "client_sdk")
"""Parts of our package that each browser has anyway."""
NOT_SENT = "server"


class Modules(NamedTuple):
    """The modules that browsers get.

    Attributes:
        files: their sources, by path.
        classes: module and name of each class of a behaviour.
        trouble: why they cannot run in a browser; empty if they can.
    """

    files: dict[str, bytes]
    classes: list[tuple[str, str]]
    trouble: str = ""


def modules_of(classes: Iterable[type[Behaviour]]) -> Modules:
    """Returns what browsers get of the modules of behaviours, and of those that they import.

    The standard library, our own package and installed packages are not sent.
    """
    files: dict[str, bytes] = {}
    named: dict[str, list[str]] = {}
    for code in classes:
        named.setdefault(code.__module__, []).append(code.__name__)
    roots = {_root(module, path) for module in named if (path := _path(module)) is not None}
    waiting, seen = list(named), set[str]()
    while waiting:
        module = waiting.pop()
        if module in seen:
            continue
        seen.add(module)
        path = _path(module)
        if path is None:
            return Modules({}, [], f"the module {module} of the behaviours has no source file")
        source = path.read_bytes()
        if module in named:
            source = needed(source, named[module])
        imported = _imported(source, module, path)
        wrong = next(filter(_is_server, imported), None)
        if wrong is not None:
            return Modules({}, [], f"the behaviours use {wrong}, which {path.name} imports and a browser does not have")
        _add(files, module, path, source)
        waiting += [name for name in imported if _is_of_the_game(name, roots)]
    return Modules(files, [(module, name) for module, names in named.items() for name in dict.fromkeys(names)])


def needed(source: bytes, names: Iterable[str]) -> bytes:
    """Returns the statements of a module that define names, and all that these use. Other lines are empty.

    Lines keep their numbers.
    """
    tree, text = ast.parse(source), source.decode()
    kept: set[int] = set()
    waiting, seen = [*names], set[str]()
    defined = [_defined(node) for node in tree.body]
    for place, node in enumerate(tree.body):
        if isinstance(node, ast.ImportFrom) and (node.module == "__future__" or node.names[0].name == "*"):
            kept.add(place)
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        for place, (node, own) in enumerate(zip(tree.body, defined, strict=True)):
            if name in own and place not in kept:
                kept.add(place)
                waiting += [inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)]
    lines = text.splitlines()
    shown = set[int]()
    for place in kept:
        node = tree.body[place]
        decorators = getattr(node, "decorator_list", [])
        first = min((node.lineno, *(each.lineno for each in decorators)))
        shown.update(range(first - 1, node.end_lineno or node.lineno))
    return "".join(f"{line if number in shown else ''}\n" for number, line in enumerate(lines)).encode()


def _defined(statement: ast.stmt) -> set[str]:
    """Returns the names that a statement of a module binds."""
    found: set[str] = set()
    for node in ast.walk(statement) if isinstance(statement, ast.If | ast.Try | ast.With | ast.For) else [statement]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {part.asname or part.name.partition(".")[0] for part in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}
    return found


def _add(files: dict[str, bytes], module: str, path: Path, source: bytes) -> None:
    """Adds a module under its dotted name, in packages that are empty unless they are added themselves."""
    parts = module.split(".")
    if path.stem == "__init__":
        parts.append("__init__")
    files["/".join(parts) + ".py"] = source
    for depth in range(1, len(parts)):
        if parts[:depth] != [OURS]:
            files.setdefault("/".join((*parts[:depth], "__init__.py")), b"")


def _path(module: str) -> Path | None:
    found = getattr(sys.modules.get(module), "__file__", None)
    path = Path(found) if found else None
    return path if path is not None and path.suffix == ".py" and path.is_file() else None


def _imported(source: bytes, module: str, path: Path) -> list[str]:
    """Returns the names of the modules that a source imports, and of what it imports from packages."""
    package = module if path.stem == "__init__" else module.rpartition(".")[0]
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [part.name for part in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = importlib.util.resolve_name("." * node.level + base, package)
            names += [base, *(f"{base}.{part.name}" for part in node.names if f"{base}.{part.name}" in sys.modules)]
    return names


def _is_server(name: str) -> bool:
    return name.removeprefix(f"{OURS}.").partition(".")[0] == NOT_SENT


def _is_of_the_game(name: str, roots: Iterable[Path]) -> bool:
    """Returns whether a module belongs to the game, and so is sent with its behaviours.

    Args:
        name: dotted name of the module.
        roots: folders from which the modules of the behaviours are imported. Modules of other places, such as installed
            packages, are not sent.
    """
    first, _, rest = name.partition(".")
    path = _path(name)
    if path is None or first in SENT or (first == OURS and (not rest or rest.partition(".")[0] in SENT)):
        return False
    inside = [path.relative_to(root) for root in roots if path.is_relative_to(root)]
    return any("site-packages" not in each.parts for each in inside)


def _root(module: str, path: Path) -> Path:
    """Returns the folder from which a module is imported."""
    return path.parents[module.count(".") + (path.stem == "__init__")]
