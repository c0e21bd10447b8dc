"""The page /play and its files: what is kept by browsers and what is not, and what the policy allows."""

import gzip
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest

from server.observability.pages import Page, PageRequest
from server.play import bundles
from server.play.play import ABSENT, PlayedGame, PlayPages
from server.rules import Rules, prepared
from shared.scene import load_scene
from sovereign_netcode.examples.chat import Chat
from sovereign_netcode.examples.dodge import Dodge

RUNTIME = {"pyodide.mjs": b"export {}", "pyodide.asm.wasm": bytes(1000), "packages.zip": bundles.archive({"a.py": b""})}


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of Python for browsers."""
    folder = tmp_path / "runtime"
    folder.mkdir()
    for name, data in RUNTIME.items():
        (folder / f"{name}.gz").write_bytes(bundles.pack(data))
    (folder / bundles.LAST).write_text("{}", "utf-8")
    monkeypatch.setattr(bundles, "RUNTIME", (tmp_path / "nothing", folder))
    return folder


def pages(rules: Rules | None = None) -> PlayPages:
    rules = rules or Rules()
    return PlayPages([PlayedGame("Game", prepared(rules, load_scene(rules.scene or "flat")), rules)])


def get(made: PlayPages, target: str, method: str = "GET") -> Page:
    path, _, query = target.partition("?")
    page = made.get(PageRequest(method, path, query, trusted=False, authorization=""))
    assert page is not None
    return page


def described(made: PlayPages) -> dict[str, Any]:
    """Returns the content of game.json, for which browsers ask until it is ready."""
    while (page := get(made, "/play/game.json")).status == 202:
        assert made._making is not None
        made._making.join()
    assert page.status == 200
    return dict(json.loads(page.body))


def test_the_page_is_not_kept_and_its_files_are_kept_for_ever(runtime: Path) -> None:
    made = pages()
    index = get(made, "/play?at=/arena-1")
    assert dict(index.headers)["Cache-Control"] == "no-store"
    found = re.findall(r'(?:src|href)="(/play/[^"]+)"', index.body.decode())
    assert [path.rpartition("/")[2] for path in found] == ["play.css", "play.js"]
    folders = {path.rpartition("/")[0] for path in found}
    assert all(re.fullmatch(r"/play/[0-9a-f]{16}", folder) for folder in folders)
    for path in (*found, *(f"{folders.copy().pop()}/{name}" for name in ("sovereign.js", "worker.js", "kernel.wasm"))):
        file = get(made, path)
        assert file.status == 200
        headers = dict(file.headers)
        assert headers["Cache-Control"] == "public, max-age=31536000, immutable"
        assert headers["Content-Encoding"] == "gzip"
        assert gzip.decompress(file.body)
    assert get(made, "/play/0123456789abcdef/play.js").status == 404
    assert get(made, f"{found[0]}x").status == 404
    assert get(made, f"{folders.copy().pop()}/../../app.py").status == 404
    moved = get(made, "/play/sovereign.js")
    assert (moved.status, dict(moved.headers)["Location"]) == (302, f"{folders.pop()}/sovereign.js")
    assert dict(moved.headers).get("Cache-Control") != "public, max-age=31536000, immutable"


def test_no_script_or_style_stands_in_the_page_and_the_policy_allows_none(runtime: Path) -> None:
    made = pages()
    index = get(made, "/play")
    text = index.body.decode()
    assert re.findall(r"<script[^>]*>([^<]*)</script>", text) == [""]
    assert "<style" not in text
    assert not re.search(r"\son\w+=|\sstyle=|javascript:", text)
    policy = dict(part.split(" ", 1) for part in dict(index.headers)["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self' 'wasm-unsafe-eval'"
    assert policy["worker-src"] == policy["connect-src"] == policy["style-src"] == "'self'"
    worker = get(made, re.findall(r"/play/[0-9a-f]+/", text)[0] + "worker.js")
    assert dict(worker.headers)["Content-Security-Policy"] == dict(index.headers)["Content-Security-Policy"]


def test_what_a_browser_loads(runtime: Path) -> None:
    made = pages(Dodge())
    found = described(made)
    assert found["trouble"] == ""
    assert found["keys"] == {"dash": "left shift", "fire": "left mouse"}
    assert found["behaviours"] == [["sovereign_netcode.examples.dodge_behaviours", name] for name in ("Dodger", "Ball")]
    assert {at.rpartition("/")[2] for at in found["bundles"]["python"]["files"]} == RUNTIME.keys()
    for bundle in found["bundles"].values():
        for address, size in bundle["files"].items():
            assert len(gzip.decompress(get(made, address).body)) == size
    game = unpacked(made, found, "game")
    assert game.keys() == {
        "sovereign_netcode/examples/__init__.py",
        "sovereign_netcode/examples/dodge_behaviours.py",
    }, "the rules are not sent"
    sources = unpacked(made, found, "sources")
    assert {"client_sdk/core.py", "shared/kernel.py", "shared/prebuilt/kernel-emscripten.so"} <= sources.keys()
    assert not [name for name in sources if name.startswith(("server", "tests"))]


def unpacked(made: PlayPages, found: dict[str, Any], name: str) -> dict[str, bytes]:
    (address,) = found["bundles"][name]["files"]
    with zipfile.ZipFile(io.BytesIO(gzip.decompress(get(made, address).body))) as archive:
        return {each: archive.read(each) for each in archive.namelist()}


def test_the_same_content_has_the_same_address_and_other_content_another_one(runtime: Path) -> None:
    first, second = described(pages()), described(pages())
    assert first == second
    (runtime / "pyodide.mjs.gz").write_bytes(bundles.pack(b"export { more }"))
    third = described(pages())
    assert third["bundles"]["python"]["at"] != first["bundles"]["python"]["at"]
    assert third["bundles"]["sources"] == first["bundles"]["sources"]
    assert "game" not in first["bundles"], "a game without behaviours"


def test_games_of_other_worlds(runtime: Path) -> None:
    games = [
        PlayedGame("Game", load_scene("flat"), Rules()),
        *(PlayedGame(type(rules).__name__, prepared(rules, load_scene("flat")), rules) for rules in (Dodge(), Chat())),
    ]
    found = described(PlayPages(games))
    assert (found["title"], found["keys"], found["commands"]["say"]) == ("Game", dict(Dodge.keys), ["text"])
    assert [name for _, name in found["behaviours"]] == ["Dodger", "Ball"]


def test_commands_that_the_rules_declare(runtime: Path) -> None:
    assert described(pages(Chat()))["commands"]["say"] == ["text"]


def test_without_python_for_browsers_the_page_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bundles, "RUNTIME", (tmp_path,))
    made = pages()
    assert not made.ready
    assert get(made, "/play").status == 200
    page = get(made, "/play/game.json")
    assert page.status == 404
    assert json.loads(page.body) == {"error": ABSENT}
    assert "scripts/browser" in ABSENT


def test_other_paths_and_methods(runtime: Path) -> None:
    made = pages()
    for path in ("/", "/playing", "/worlds", "/live"):
        assert made.get(PageRequest("GET", path, "", trusted=True, authorization="")) is None
    assert get(made, "/play", "POST").status == 405
    moved = get(made, "/play/?at=/arena-1")
    assert (moved.status, dict(moved.headers)["Location"]) == (302, "/play?at=/arena-1")


def test_nothing_is_read_before_the_first_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail(f"{path} was read"))
    assert pages()._bundles == {}
