"""The skeleton of a game: it works as it is written, and nothing of anybody's is overwritten."""

import importlib.machinery
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.e2e.processes import running

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("new_game", str(ROOT / "scripts" / "new-game"))
    spec = importlib.util.spec_from_loader("new_game", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    monkeypatch.setattr(module, "ensure", lambda requirements: None)
    monkeypatch.chdir(tmp_path)
    return module


def run(script: ModuleType, monkeypatch: pytest.MonkeyPatch, name: str) -> int:
    monkeypatch.setattr(sys, "argv", ["new-game", name])
    return int(script.main())


@pytest.mark.e2e
def test_its_tests_pass_and_the_server_plays_it(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert run(script, monkeypatch, "my_first_game") == 0
    config = ("-c", str(ROOT / "pyproject.toml"), "-p", "no:cacheprovider")
    tests = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *config, str(tmp_path / "test_my_first_game.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert tests.returncode == 0, tests.stdout
    assert "3 passed" in tests.stdout
    with running("--port", "0", "--game", "my_first_game:MyFirstGame", PYTHONPATH=str(tmp_path)) as server:
        server.address()
    for tool in (("ruff", "check", "--ignore", "I001"), ("ruff", "format", "--check")):
        checks = ("--config", str(ROOT / "pyproject.toml"), str(tmp_path))
        done = subprocess.run([sys.executable, "-m", *tool, *checks], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("mine", ["mine.py", "test_mine.py"])
def test_nothing_is_overwritten(
    script: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mine: str,
) -> None:
    (tmp_path / mine).write_text("precious")
    assert run(script, monkeypatch, "mine") == 2
    assert [path.name for path in tmp_path.iterdir()] == [mine]
    assert (tmp_path / mine).read_text() == "precious"
    assert mine in capsys.readouterr().err


@pytest.mark.parametrize("name", ["server", "json", "class", "My", "a-b", "2fast", ""])
def test_a_name_that_cannot_be_imported_is_refused(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    assert run(script, monkeypatch, name) == 2
    assert list(tmp_path.iterdir()) == []
