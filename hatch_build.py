"""Build hook of hatchling: makes the wheel's one top-level package, `sovereign_netcode`.

In the repository, server/, client_sdk/ and shared/ stand at the root and import each other by these names. A wheel with
such top-level packages would collide with a user's own `server.py` or `shared/`. The wheel therefore has them under
`sovereign_netcode`, with their imports rewritten; every other file is carried as it is. Line numbers stay the same.

An editable install uses the repository itself, where `sovereign_netcode` is an alias (sovereign_netcode/_checkout.py).
Type checkers do not run that alias. For them the hook writes one stub per module, which git ignores.
"""

import ast
import hashlib
import importlib.util
import io
import json
import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "sovereign_netcode"
FOLDERS = ("client_sdk", "server", "shared")
"""The folders at the repository's root that become subpackages of `PACKAGE`."""
ALIAS = "_checkout.py"
"""The file in the folder `PACKAGE` that is of use in a checkout only."""

KERNEL_SOURCES = ("kernel.py", "bulk.py", "traffic.py", "delivery.py", "pacing.py", "places.py")
"""The files in shared/ of which shared/prebuilt is made."""
BROWSER, RUNTIME = Path("build/browser"), Path("server/play/runtime")
"""Folder of Python for browsers, if `scripts/browser` has made it, and its place in the wheel."""

_NAMES = "|".join(FOLDERS)
_IN_TEXT = re.compile(rf"(?<=`)(?=(?:{_NAMES})\.[a-z_])|(?<=python -m )(?=(?:{_NAMES})\b)")
"""Matches where a docstring, comment or message names a module. Neither alternative can occur in other code."""
_FROM = re.compile(r"from[\s\\]+")
"""Matches the word `from` of an import and the space behind it, which may have line continuations."""


class RewriteError(Exception):
    """A source uses a module's name in a way that cannot be rewritten. The message has the place and what to write."""


class StaleError(Exception):
    """The prebuilt kernels were not built from the current sources."""


class Hook(BuildHookInterface[Any]):
    """Called by hatchling around each build of a wheel."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            write_stubs(Path(self.root))
            return
        refuse_stale_kernels(Path(self.root))
        self._staged = tempfile.TemporaryDirectory(prefix=f"{PACKAGE}-")
        stage(Path(self.root), Path(self._staged.name))
        build_data["force_include"][self._staged.name] = PACKAGE

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if version != "editable":
            self._staged.cleanup()


def stage(root: Path, place: Path) -> None:
    """Writes the package as the wheel has it to the folder `place`.

    Raises:
        RewriteError: a source cannot be rewritten.
    """
    own, modules = root / PACKAGE, frozenset(module_names(root))
    for file, target in [
        *((file, file.relative_to(own)) for file in files(own) if file.relative_to(own).parts[0] not in FOLDERS),
        *((file, file.relative_to(root)) for folder in FOLDERS for file in files(root / folder)),
    ]:
        if target == Path(ALIAS):
            continue
        copy = place / target
        copy.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix != ".py":
            shutil.copyfile(file, copy)
            continue
        source = file.read_text("utf-8")
        text = docstring_alone(source) if target == Path("__init__.py") else rewritten(source, str(target), modules)
        copy.write_text(text, "utf-8", newline="\n")
    if (root / BROWSER / "stamp.json").is_file():
        shutil.copytree(root / BROWSER, place / RUNTIME)


def refuse_stale_kernels(root: Path) -> None:
    """Checks that the prebuilt kernels were built from the sources that go into the same wheel.

    Raises:
        StaleError: they were not, or a file differs from the manifest. The message says what to do.
    """
    spec = importlib.util.spec_from_file_location("freshness", root / "shared" / "freshness.py")
    assert spec is not None
    assert spec.loader is not None
    freshness = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(freshness)
    folder = root / "shared" / "prebuilt"
    manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
    texts = freshness.sources(root / "shared" / name for name in KERNEL_SOURCES)
    if freshness.code_crc(texts) != manifest["code_crc"]:
        raise StaleError(
            f"shared/prebuilt is not made from the present {', '.join(KERNEL_SOURCES)}: run scripts/kernels"
        )
    for name, told in manifest["files"].items():
        if hashlib.sha256((folder / name).read_bytes()).hexdigest() != told["sha256"]:
            raise StaleError(f"shared/prebuilt/{name} differs from its hash in manifest.json: run scripts/kernels")


def files(folder: Path) -> Iterator[Path]:
    """Yields all files below a folder in a fixed order. Caches and hidden files are left out."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith("."):
            yield path


def module_names(root: Path) -> Iterator[str]:
    """Yields the dotted name of every module in `FOLDERS`, as in the repository (`server.game`)."""
    for folder in FOLDERS:
        for file in files(root / folder):
            if file.suffix == ".py":
                yield ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def docstring_alone(source: str) -> str:
    """Returns a module's source reduced to its docstring. The wheel's package needs no alias."""
    return f'"""{ast.get_docstring(ast.parse(source))}"""\n'


def rewritten(source: str, name: str, modules: Collection[str]) -> str:
    """Returns a module's source with the imports of `FOLDERS` changed to imports from `PACKAGE`.

    Args:
        source: the text of a module.
        name: file name for error messages.
        modules: the dotted names of all modules of `FOLDERS`.

    Raises:
        RewriteError: the source uses a module's name in a way that cannot be rewritten.
    """
    tree = ast.parse(source, name)
    lines = io.StringIO(source).readlines()
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def offset(line: int, column_bytes: int) -> int:
        """Converts a position of the syntax tree, which counts bytes of UTF-8, to an index into the text."""
        return starts[line - 1] + len(lines[line - 1].encode()[:column_bytes].decode())

    inserts = {match.start() for match in _IN_TEXT.finditer(source)}
    for node in ast.walk(tree):
        _refuse(node, name, modules)
        if isinstance(node, ast.Import):
            inserts |= {offset(part.lineno, part.col_offset) for part in node.names if _is_ours(part.name)}
        elif isinstance(node, ast.ImportFrom) and not node.level and _is_ours(node.module or ""):
            before = _FROM.match(source, offset(node.lineno, node.col_offset))
            assert before is not None
            inserts.add(before.end())
    parts, done = [], 0
    for at in sorted(inserts):
        parts += [source[done:at], f"{PACKAGE}."]
        done = at
    return "".join(parts) + source[done:]


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] in FOLDERS


def _refuse(node: ast.AST, name: str, modules: Collection[str]) -> None:
    """Raises `RewriteError` if a node names a module in a way that would be wrong in the wheel."""
    match node:
        case ast.Import(names=names):
            for part in names:
                if _is_ours(part.name) and part.asname is None:
                    package, _, rest = part.name.rpartition(".")
                    better = f"from {package} import {rest}" if package else f"from {PACKAGE} import {rest}"
                    raise RewriteError(f"{name}:{node.lineno}: import {part.name}: write {better}")
        case ast.Constant(value=str(text)) if ".".join(re.split("[.:]", text)[:2]) in modules and "." in text:
            raise RewriteError(f"{name}:{node.lineno}: {text!r}: write {PACKAGE + '.' + text!r}")
        case (
            ast.List(elts=elements, lineno=line)
            | ast.Tuple(elts=elements, lineno=line)
            | ast.Call(args=elements, lineno=line)
        ):
            texts = [element.value if isinstance(element, ast.Constant) else None for element in elements]
            for flag, module in pairwise(texts):
                if flag == "-m" and module in FOLDERS:
                    raise RewriteError(f"{name}:{line}: '-m', {module!r}: write '-m', {f'{PACKAGE}.{module}'!r}")


def write_stubs(root: Path) -> None:
    """Writes one stub per module for type checkers, like `sovereign_netcode/server/rules.pyi` for server/rules.py."""
    stubs: dict[Path, str] = {}
    for module in module_names(root):
        path = root / PACKAGE / module.replace(".", "/")
        if path.name != "__main__":
            is_package = (root / module.replace(".", "/")).is_dir()
            stubs[path / "__init__.pyi" if is_package else path.with_suffix(".pyi")] = f"from {module} import *\n"
    for folder in FOLDERS:
        for stale in set((root / PACKAGE / folder).rglob("*.pyi")) - stubs.keys():
            stale.unlink()
    for path, text in stubs.items():
        if not path.exists() or path.read_text("utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")


if __name__ == "__main__":
    write_stubs(Path(__file__).resolve().parent)
