"""The skeleton of a game works as it is written, and overwrites no file."""

import subprocess
import sys
from pathlib import Path

import pytest

from sovereign_netcode import new_game
from tests.e2e.processes import running

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _in_a_folder_of_ones_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def run(monkeypatch: pytest.MonkeyPatch, name: str) -> int:
    monkeypatch.setattr(sys, "argv", ["sovereign-new-game", name])
    return new_game.main()


@pytest.mark.e2e
def test_its_tests_pass_and_the_server_plays_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert run(monkeypatch, "my_first_game") == 0
    config = ("-c", str(ROOT / "pyproject.toml"), "-p", "no:cacheprovider")
    tests = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *config, str(tmp_path / "test_my_first_game.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert tests.returncode == 0, tests.stdout
    assert "4 passed" in tests.stdout
    with running("--port", "0", "--game", "my_first_game:MyFirstGame", PYTHONPATH=str(tmp_path)) as server:
        server.address()
    for tool in (("ruff", "check", "--ignore", "I001"), ("ruff", "format", "--check")):
        checks = ("--config", str(ROOT / "pyproject.toml"), str(tmp_path))
        done = subprocess.run([sys.executable, "-m", *tool, *checks], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("mine", ["mine.py", "test_mine.py"])
def test_nothing_is_overwritten(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mine: str,
) -> None:
    (tmp_path / mine).write_text("precious")
    assert run(monkeypatch, "mine") == 2
    assert [path.name for path in tmp_path.iterdir()] == [mine]
    assert (tmp_path / mine).read_text() == "precious"
    assert mine in capsys.readouterr().err


@pytest.mark.parametrize("name", ["server", "json", "class", "My", "a-b", "2fast", ""])
def test_a_name_that_cannot_be_imported_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    assert run(monkeypatch, name) == 2
    assert list(tmp_path.iterdir()) == []
