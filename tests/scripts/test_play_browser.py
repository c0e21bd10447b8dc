"""`sovereign-play --browser`: which page it opens, and what it needs."""

import subprocess
import sys
from pathlib import Path

import pytest

from sovereign_netcode.play import in_browser


@pytest.mark.parametrize(
    ("url", "query", "page"),
    [
        ("ws://127.0.0.1:8765", {"name": "You"}, "http://127.0.0.1:8765/play?name=You"),
        ("ws://127.0.0.1:8765/", {"name": "", "lag": "80"}, "http://127.0.0.1:8765/play?lag=80"),
        ("wss://game.example/arena-1", {}, "https://game.example/play?at=%2Farena-1"),
        ("ws://[::1]:1/match?kind=a&x=1", {}, "http://[::1]:1/play?at=%2Fmatch%3Fkind%3Da%26x%3D1"),
        ("ws://h:1", {"name": "A&B =1"}, "http://h:1/play?name=A%26B+%3D1"),
    ],
)
def test_the_page_of_a_server_or_a_world(url: str, query: dict[str, str], page: str) -> None:
    assert in_browser.page_of(url, **query) == page


def test_it_opens_the_page_of_a_server_that_runs_already() -> None:
    opened: list[str] = []

    def open_page(url: str) -> None:
        opened.append(url)
        raise KeyboardInterrupt

    assert in_browser.main(["--browser", "--url", "ws://127.0.0.1:1/arena-1", "--name", "Ann"], open_page) == 0
    assert opened == ["http://127.0.0.1:1/play?at=%2Farena-1&name=Ann"]


def test_pictures_are_for_the_window(capsys: pytest.CaptureFixture[str]) -> None:
    assert in_browser.main(["--browser", "--picture", "x.png"], pytest.fail) == 2
    assert capsys.readouterr().err == "error: --browser takes no --picture and no --script-demo\n"


def test_a_package_without_python_for_browsers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(in_browser, "runtime_folder", lambda: None)
    monkeypatch.setattr(in_browser, "FETCH", tmp_path / "browser")
    with pytest.raises(RuntimeError, match="built without Python for browsers"):
        in_browser.fetch()
    (tmp_path / "browser").write_text("import sys; sys.exit(1)", "utf-8")
    with pytest.raises(RuntimeError, match="cannot be fetched"):
        in_browser.fetch()
    (tmp_path / "browser").write_text("", "utf-8")
    in_browser.fetch()


def test_it_needs_no_pygame() -> None:
    program = "import sys, sovereign_netcode.play.in_browser; sys.exit('pygame' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
