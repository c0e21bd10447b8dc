"""The language check finds a text that breaks a rule at its line, and accepts plain texts."""

import subprocess
from pathlib import Path

import pytest

from scripts.checks import language

# The bad texts of this file are put together from pieces, so that the check passes on the file itself.
BAD_WORDS = "who what whoever whose whom that those so and or each how why where when which see".split()
SO, WAS, WHO = "so", "was", "who".capitalize()
GOOD_TEXTS = (
    *("Removes players whose reconnect window has expired.", "The server's address.", "Time in seconds.", "`now`: s."),
    *("Returns whether the player exists.", "p50, p99 and max.", "Andromeda and Sofia.", "", "Thousands of blocks."),
)
PLACES = (
    "{}",
    "class A:\n    {}",
    "def f():\n    {}",
    "async def f():\n    {}",
    "class A:\n    def f(self):\n        {}",
)
CONSTANTS = ('A = 1\n"""{}"""', 'class A:\n    a: int = 1\n    """{}"""', 'def f():\n    f.a = 1\n    """{}"""')


def lines(source: str, path: str = "a.py") -> list[int]:
    """Returns the lines of all findings in a text."""
    return [finding.line for finding in language.findings(path, source)]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("text", [f"{word.capitalize()} leaves." for word in BAD_WORDS] + ["The same for clients."])
def test_a_docstring_with_a_bad_opening_is_found(place: str, text: str) -> None:
    assert set(lines(place.format(f'"""{text}"""'))) == {place.count("\n") + 1}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("text", GOOD_TEXTS)
def test_a_docstring_with_a_good_opening_is_not_found(place: str, text: str) -> None:
    assert lines(place.format(f'"""{text}"""')) == []


@pytest.mark.parametrize(
    "text",
    [
        "and bytes per second.",
        "blocks.",
        "Each in seconds.",
        "Of one core.",
        "Its width.",
        "Bytes per client,",
        "Or less.",
    ],
)
@pytest.mark.parametrize("constant", CONSTANTS)
def test_a_constant_whose_docstring_does_not_stand_alone_is_found(text: str, constant: str) -> None:
    assert len(lines(constant.format(text))) == 1


@pytest.mark.parametrize("text", ["Bytes per second.", "`a` in seconds.", "1 for a cube.", "Share of one core."])
@pytest.mark.parametrize("constant", CONSTANTS)
def test_a_constant_whose_docstring_stands_alone_is_not_found(text: str, constant: str) -> None:
    assert lines(constant.format(text)) == []


@pytest.mark.parametrize(
    "text",
    [
        f"a server with {SO} many clients",
        f"waits for {SO}\n# long",
        f"{SO.capitalize()} much of it",
        f"every {SO} often",
        f"the client {WAS} told",
        f"it {WAS} never heard before",
        f"they {WAS}\n# said to be it",
        f"Clients leave. {WHO} stays is asked.",
        f"Clients leave. {WHO}ever stays is asked.",
    ],
)
@pytest.mark.parametrize("path", ["a.py", "a.md", "a.c"])
def test_one_of_the_worst_patterns_is_found_anywhere(text: str, path: str) -> None:
    assert lines(f"# first\n# {text}\n", path) == [2]
    assert len(lines(f"A = '''{text}'''", path)) == 1


@pytest.mark.parametrize(
    "text", ["so far", "not so fast", "it was tolderia", "Who should take it?", "a client who asks."]
)
def test_similar_words_are_not_found(text: str) -> None:
    assert lines(f"# {text}\n") == []


def test_a_finding_names_place_rule_and_text() -> None:
    (finding,) = language.findings("server/a.py", 'A = 1\n"""Those\n\n  of the ' + "x" * 200 + '."""')
    assert str(finding).startswith(
        "server/a.py:2: begin with a verb in the third person or a noun phrase, not with 'Th"
    )
    assert str(finding).endswith(": Those of the " + "x" * 87 + "...")


def test_every_folder_and_page_is_checked() -> None:
    assert all((language.ROOT / name).exists() for name in language.CHECKED)
    listed = subprocess.run(("git", "ls-files"), cwd=language.ROOT, capture_output=True, text=True, check=False).stdout
    places = {Path(path).parts[0] for path in listed.splitlines() if Path(path).suffix in (".md", ".py")}
    assert {place for place in places if place[0] != "."} <= set(language.CHECKED)


def test_files_are_found_by_suffix_or_first_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = f'"""{SO.capitalize()} many."""\n'
    checked = ("a.py", "b/run", "c.md")
    for name in (*checked, "b/data", "c.json", ".git/a.py", "node_modules/a.js"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("#!/usr/bin/env python3\n" * (name == "b/run") + bad)
    (tmp_path / "picture").write_bytes(b"\x89PNG")
    monkeypatch.setattr(language, "ROOT", tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in language.files(tmp_path)] == list(checked)
    assert language.main([str(tmp_path)]) == 1
    *found, last = capsys.readouterr().out.splitlines()
    assert {line.partition(":")[0] for line in found} == set(checked)
    assert last == "5 findings in 3 files"
