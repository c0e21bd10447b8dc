"""The page /play and its files, as answers to requests.

    /play              the page, which is never kept
    /play/game.json    what to load, and what the game is: made at the first request, in a thread
    /play/HASH/NAME    a file, which browsers keep for ever
    /play/NAME         a script of the page for other pages: leads to its present address

Theory of operation. The page itself is small. Its script asks for `game.json`, then a worker of the browser loads
Python, the client's sources and the game's behaviours, and connects to the same port. A server whose page nobody opens
reads none of this.
"""

import json
import threading
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any, NamedTuple

from server.config.settings import Settings
from server.observability.pages import JSON, Page, PageRequest, line
from server.play.behaviours import modules_of
from server.play.bundles import HERE, Bundle, archive, bundle, pack, page_bundle, runtime_bundle, runtime_folder
from server.play.bundles import source_bundle as sources
from server.rules import Rules
from shared.scene import Scene

PATH = "/play"
ABSENT = (
    "This server has no files for browsers. In a checkout, run scripts/browser once; a package that was built after "
    "that has them."
)
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; style-src 'self'; img-src 'self' "
    "data:; connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The content security policy of the page and of its worker. Python in WebAssembly needs `wasm-unsafe-eval`."""
SAFE = (
    ("Content-Security-Policy", POLICY),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
)
FRESH = (*SAFE, ("Cache-Control", "no-store"))
KEPT = (*SAFE, ("Cache-Control", "public, max-age=31536000, immutable"), ("Content-Encoding", "gzip"))
"""Headers of files that browsers keep."""


class PlayedGame(NamedTuple):
    """A game that can be played on a server: its title, its scene and its rules."""

    title: str
    scene: Scene
    rules: Rules


class PlayPages:
    """The page and its files.

    Args:
        games: the game of the default world first, then those of the kinds of worlds.
    """

    def __init__(self, games: Sequence[PlayedGame]) -> None:
        self._games = games
        self._bundles: dict[str, Bundle] = {}
        self._game: Page | None = None
        self._making: threading.Thread | None = None
        self._failed = ""

    @property
    def ready(self) -> bool:
        """Whether there is Python for browsers, so that the page can be played on."""
        return runtime_folder() is not None

    def get(self, request: PageRequest) -> Page | None:
        """Returns the answer to a request; None: it is for another page."""
        path = request.path
        if path != PATH and not path.startswith(f"{PATH}/"):
            return None
        if request.method != "GET":
            return line(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is allowed", allow="GET")
        if path == f"{PATH}/":
            query = f"?{request.query}" if request.query else ""
            return line(HTTPStatus.FOUND, f"see {PATH}", location=f"{PATH}{query}")
        if path == PATH:
            return self._index()
        if path == f"{PATH}/game.json":
            return self._description()
        return self._file(path)

    @property
    def _code(self) -> Bundle:
        if "page" not in self._bundles:
            self._bundles["page"] = page_bundle()
        return self._bundles["page"]

    def _index(self) -> Page:
        text = (HERE / "web" / "index.html").read_text("utf-8").replace("CODE/", self._code.address)
        return Page(HTTPStatus.OK, text.encode(), "text/html; charset=utf-8", FRESH)

    def _description(self) -> Page:
        """Returns what to load. While it is being made, the status is 202, and the page asks again."""
        if self._game is None and self._making is None:
            if runtime_folder() is None:
                return Page(HTTPStatus.NOT_FOUND, json.dumps({"error": ABSENT}).encode(), JSON, FRESH)
            self._making = threading.Thread(target=self._make, daemon=True)
            self._making.start()
        if self._failed:
            raise RuntimeError(self._failed)
        return self._game or line(HTTPStatus.ACCEPTED, "preparing", retry_after="1")

    def _file(self, path: str) -> Page:
        folder, _, name = path.rpartition("/")
        if folder == PATH and name in self._code.files:
            return line(HTTPStatus.FOUND, "see its present address", location=self._code.address + name)
        for each in tuple(self._bundles.values()):
            file = each.files.get(name) if each.address == f"{folder}/" else None
            if file is not None:
                return Page(HTTPStatus.OK, file.packed, file.content_type, KEPT)
        return line(HTTPStatus.NOT_FOUND, f"{path}: no such file")

    def _make(self) -> None:
        """Reads and compresses all files."""
        try:
            folder = runtime_folder()
            assert folder is not None
            found = described(self._games)
            bundles = {"python": runtime_bundle(folder), "sources": sources()}
            if found["files"]:
                bundles["game"] = bundle({"game.zip": pack(archive(found["files"]))})
            self._bundles.update(bundles)
            del found["files"]
            made = {name: {"at": each.address, "files": each.sizes} for name, each in bundles.items()}
            body = json.dumps({**found, "bundles": made}, separators=(",", ":")).encode()
            self._game = Page(HTTPStatus.OK, body, JSON, FRESH)
        except Exception as error:
            self._failed = f"{type(error).__name__}: {error}"


def play_pages(settings: Settings, games: Sequence[tuple[str, Scene, Rules]]) -> PlayPages | None:
    """Returns the page to play on; None: the settings switch it off.

    Args:
        settings: the settings.
        games: name or MODULE:CLASS, scene and rules of each game.
    """
    if not settings.play:
        return None
    return PlayPages([PlayedGame(name.rpartition(":")[2], scene, rules) for name, scene, rules in games])


def described(games: Sequence[PlayedGame]) -> dict[str, Any]:
    """Returns what a browser needs of games: titles, keys and commands, and their behaviours with their files."""
    entries = [entry for game in games for entry in game.scene.behaviours]
    modules = modules_of(entry.code for entry in entries if entry.code is not None)
    keys: dict[str, str] = {}
    commands: dict[str, list[str]] = {}
    for game in reversed(games):  # where two games differ, the default world's counts
        keys |= game.rules.keys
        commands |= {name: list(fields) for name, fields in game.rules.commands.items()}
    return {
        "title": games[0].title,
        "keys": keys,
        "commands": commands,
        "behaviours": modules.classes,
        "trouble": modules.trouble,
        "files": modules.files,
    }
