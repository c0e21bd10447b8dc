"""What the scripts say when they set up their environment; nothing is installed here."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """`scripts/_env.py` with an environment of its own, for which every command succeeds."""
    module = importlib.import_module("_env")
    venv = tmp_path / ".venv"
    venv.mkdir()
    for name, value in {"VENV": venv, "PYTHON": venv / "python", "STAMP": venv / "stamp"}.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(module, "_must", lambda *command: (venv / "python").touch())
    return module


def test_a_set_up_says_where_with_what_and_how_long(env: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert env.ensure(env.RUNTIME) == env.PYTHON
    said = capsys.readouterr().out
    assert said.startswith(
        f"setting up {env.VENV} with the pins of requirements.txt, once: up to a minute ... done in "
    )
    assert env.ensure(env.RUNTIME) == env.PYTHON
    assert capsys.readouterr().out == "", "it is there"
    env.ensure(env.DEV)
    assert "with the pins of requirements-dev.txt" in capsys.readouterr().out
    env.ensure(env.RUNTIME)
    assert capsys.readouterr().out == "", "more than that is there"


def test_an_interrupted_set_up_is_begun_anew(
    env: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*command: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as interrupted:
        interrupted.setattr(env, "_must", fails)
        with pytest.raises(KeyboardInterrupt):
            env.ensure(env.DEV)
    capsys.readouterr()
    env.ensure(env.DEV)
    assert "done in" in capsys.readouterr().out
