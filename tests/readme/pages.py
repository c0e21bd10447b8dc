"""The pages for readers (README.md and the others beside it, docs/), and the programs in them by their heading."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted({*ROOT.glob("*.md")} - {ROOT / "README.md"}),
    *sorted((ROOT / "docs").glob("*.md")),
]
_HEADING_OR_FENCE = re.compile(r"^#+ ([^\n]+)$|^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def programs(language: str = "python") -> dict[str, str]:
    """Returns all blocks of a language in the pages, in order, by their heading; each heading has one at most.

    The tutorial's are not among them (`tests.readme.tutorial`).
    """
    found: dict[str, str] = {}
    for page in PAGES:
        if page.name == "tutorial.md":
            continue
        heading = ""
        for title, kind, text in _HEADING_OR_FENCE.findall(page.read_text("utf-8")):
            heading = title or heading
            if kind == language:
                assert heading not in found, f"{page.name}: a second block of {language} under {heading!r}"
                found[heading] = text
    return found


def headings(page: Path) -> set[str]:
    """Returns the anchors of a page, as GitHub makes them."""
    titles = [title for title, _, _ in _HEADING_OR_FENCE.findall(page.read_text("utf-8")) if title]
    anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
    assert len(anchors) == len(set(anchors)), f"{page.name}: the same heading twice"
    return set(anchors)


def section(page: Path, title: str) -> str:
    """Returns the text under a heading of the second level, up to the next one."""
    _, heading, text = page.read_text("utf-8").partition(f"\n## {title}\n")
    assert heading, f"{page.name}: no heading {title!r}"
    return text.partition("\n## ")[0]
