"""Links in the pages have a target, and files and flags that the pages name exist."""

import re
from pathlib import Path

import pytest

from server.config.settings import KINDS
from tests.readme.pages import PAGES, ROOT, headings

LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(r"(?<![\w./-])(?:client_sdk|docs|scripts|server|shared|sovereign_netcode|tests)/[\w./-]*\w")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
SOURCES = [
    *(ROOT / "scripts").glob("*"),  # some commands have no suffix
    *(path for folder in ("scripts", "server", "sovereign_netcode") for path in (ROOT / folder).rglob("*.py")),
]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def broken(page: Path, target: str) -> str:
    """Returns why a link has no target; empty if it has one."""
    if target.startswith(("http://", "https://")):
        return ""
    path, _, anchor = target.partition("#")
    there = (page.parent / path).resolve() if path else page
    if not there.is_relative_to(ROOT) or not there.exists():
        return f"{target}: no such file"
    return f"{target}: no such heading" if anchor and anchor not in headings(there) else ""


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    targets = LINK.findall(page.read_text("utf-8"))
    assert [why for target in targets if (why := broken(page, target))] == []


def test_a_broken_link_is_found() -> None:
    readme = ROOT / "README.md"
    assert broken(readme, "docs/games.md#templates") == broken(readme, "#measured") == ""
    assert broken(readme, "docs/games.md#hookz") == "docs/games.md#hookz: no such heading"
    assert broken(readme, "docs/game.md") == "docs/game.md: no such file"
    assert broken(readme, "../README.md") == "../README.md: no such file"


def test_every_page_is_linked_from_the_readme() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    assert [page.name for page in PAGES[1:] if f"]({page.relative_to(ROOT).as_posix()})" not in readme] == []


@each_page
def test_files_and_flags_exist(page: Path) -> None:
    text = LINK.sub("]", page.read_text("utf-8"))
    assert [name for name in FILE.findall(text) if not (ROOT / name).exists()] == []
    known = {"--" + name.replace("_", "-") for name in KINDS}
    for source in SOURCES:
        if source.is_file():
            known.update(re.findall(r'"(--[a-z][a-z-]+)"', source.read_text("utf-8")))
    assert set(FLAG.findall(text)) <= known
