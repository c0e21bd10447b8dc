"""A check of the language of texts: docstrings and comments in plain English, by rules that a machine can hold.

    python -m scripts.checks.language [PATH ...]      checks the given files and folders, or else all of `CHECKED`

Prints `file:line: rule: text` for each finding. Exits with 1 if there is a finding.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]
CHECKED = (
    *("ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md", "README.md", "hatch_build.py"),
    *("client_sdk", "docs", "scripts", "server", "shared", "sovereign_netcode", "tests"),
)
"""Files and folders that are checked by default: all texts of the repository."""
SUFFIXES = (".c", ".html", ".js", ".md", ".mjs", ".py", ".service", ".toml", ".ts")
"""Suffixes of the files that are checked. Scripts without a suffix are checked, too."""
SKIPPED = ("node_modules", "__pycache__")
"""Names of folders that are never checked."""
TEXT_MAX = 100
"""Characters of a text that a finding shows."""

OPENINGS = "who what whoever whatever whose whom which whichever that those so and or each how why where when".split()
"""First words that no docstring has: a docstring begins with a verb in the third person or with a noun phrase."""
LEANING = "of for by with as from to it its they their".split()
"""First words that no constant's docstring has, because such a text is complete only with the constant's name."""
GAP = r"[\s#*/]+"
"""A pattern for the space between two words, which may include the start of the next comment line."""
WORST = (
    (rf"\b[Ss]o{GAP}(many|much|often|long)\b", 'name the number: "at most N", "every N s"'),
    (
        rf"\b(is|are|was|were|be|been|being)({GAP}(not|never|also|only|then|once|always))?{GAP}(told|said|heard)\b",
        'use the exact verb: "sent", "reported", "received", "notified"',
    ),
    (r"\bWho(ever|m|se)?\b(?=[^.?]*\.)", 'begin the sentence with its subject: "A client that ..."'),
)
"""Patterns that are wrong anywhere in a file, each with the rule to print."""


class Finding(NamedTuple):
    """A place in a file that breaks a rule."""

    path: str
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        text = " ".join(self.text.split())
        return f"{self.path}:{self.line}: {self.rule}: {text[:TEXT_MAX]}{'...' * (len(text) > TEXT_MAX)}"


def findings(path: str, source: str) -> list[Finding]:
    """Returns the findings in a file, in the order of its lines.

    Args:
        path: name of the file; docstrings are looked for in Python files only.
        source: content of the file.
    """
    found = []
    if path.endswith(".py") or source.startswith("#!/usr/bin/env python"):
        for line, text, constant in docstrings(ast.parse(source)):
            rule = broken_rule(text, constant=constant)
            if rule:
                found.append(Finding(path, line, rule, text))
    for pattern, rule in WORST:
        for match in re.finditer(pattern, source):
            start = source.rfind("\n", 0, match.start()) + 1
            end = source.find("\n", match.end())
            found.append(Finding(path, source.count("\n", 0, match.start()) + 1, rule, source[start:end]))
    return sorted(found, key=lambda finding: finding.line)


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str, bool]]:
    """Yields the line and the text of each docstring, and whether it describes a constant or an attribute."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for i, statement in enumerate(body if isinstance(body, list) else ()):
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield statement.lineno, text.strip(), i > 0


def broken_rule(text: str, *, constant: bool) -> str:
    """Returns the rule that a docstring breaks; empty if it breaks none."""
    opening = re.match(r"\w+", text)
    first = opening[0] if opening else ""
    if first.lower() in OPENINGS or text.startswith("The same"):
        return f"begin with a verb in the third person or a noun phrase, not with {first!r}"
    if first == "See":
        return "describe the thing first; a reference to another place comes after the description"
    if not constant:
        return ""
    if first.lower() in LEANING:
        return f"make a constant's docstring complete without the constant's name; it begins with {first!r}"
    if text[:1].islower():
        return "make a constant's docstring complete; this one begins in lower case, like the rest of a sentence"
    if text.endswith((",", ";")):
        return "end a constant's docstring with a full stop; it must not continue in the next one"
    return ""


def files(place: Path) -> Iterator[Path]:
    """Yields the files to check in a folder, or the file that `place` is."""
    for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
        hidden = any(part in SKIPPED or part.startswith(".") for part in path.relative_to(place).parts)
        if path.is_file() and not hidden and (path.suffix in SUFFIXES or _is_script(path)):
            yield path


def _is_script(path: Path) -> bool:
    with path.open("rb") as file:
        return not path.suffix and file.read(2) == b"#!"


def main(arguments: list[str]) -> int:
    """Checks all files and prints the findings. Returns the exit code."""
    places = [Path(argument).resolve() for argument in arguments] or [ROOT / name for name in CHECKED]
    paths = [path for place in places for path in files(place)]
    found = [
        finding
        for path in paths
        for finding in findings(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    ]
    print(*found, f"{len(found)} findings in {len(paths)} files", sep="\n")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
