"""The set-up of the environment, and how commands start. Nothing is installed here."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from scripts import environment


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The module with an environment of its own, for which every command succeeds."""
    venv = tmp_path / ".venv"
    venv.mkdir()
    for name, value in {"VENV": venv, "PYTHON": venv / "python", "STAMP": venv / "stamp"}.items():
        monkeypatch.setattr(environment, name, value)
    monkeypatch.setattr(environment, "_must", lambda *command: (venv / "python").touch())
    monkeypatch.setattr(environment, "_compile", lambda: None)
    return environment


def test_a_set_up_says_where_with_what_and_how_long(env: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert env.ensure(env.RUNTIME) == env.PYTHON
    said = capsys.readouterr().out
    assert said.startswith(
        f"setting up {env.VENV} with the pins of requirements.txt, once: up to a minute ... done in "
    )
    assert env.ensure(env.RUNTIME) == env.PYTHON
    assert capsys.readouterr().out == "", "the environment is there already"
    env.ensure(env.DEV)
    assert "with the pins of requirements-dev.txt" in capsys.readouterr().out
    env.ensure(env.RUNTIME)
    assert capsys.readouterr().out == "", "only a part of the environment is there"


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


@pytest.mark.parametrize("requirements", [environment.RUNTIME, environment.DEV])
def test_two_halves_have_all_pins_with_their_hashes(requirements: str) -> None:
    text = (environment.ROOT / requirements).read_text("utf-8")
    one, two = environment.halves(text)
    assert sorted(one.splitlines() + two.splitlines()) == sorted(
        line for line in text.splitlines() if not line.startswith("#")
    )
    for half in (one, two):
        pins = [line for line in half.splitlines() if not line.startswith(" ")]
        assert all("==" in pin and pin.endswith("\\") for pin in pins)
        assert half.count("--hash=") >= len(pins) > 5
    assert abs(one.count("==") - two.count("==")) < 10


@pytest.mark.parametrize(
    ("path", "compiled"),
    [
        ("numpy/_core/multiarray.py", True), ("pytest/__init__.py", True), ("nats/aio/client.py", True),
        ("numpy/_core/tests/test_half.py", False), ("mypy/build.py", False), ("pygame/tests/test_utils/png.py", False),
    ],
)  # fmt: skip
def test_the_set_up_compiles_what_commands_import(path: str, compiled: bool) -> None:
    for found in (f".venv/lib/site-packages/{path}", f".venv/lib/site-packages/{path}".replace("/", "\\")):
        assert (re.search(environment.UNCOMPILED, found) is None) == compiled


def test_a_half_that_cannot_be_installed_is_told(env: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*command: str) -> None:
        if command[-1].endswith("1.txt"):
            raise SystemExit(2)
        (env.VENV / "python").touch()

    monkeypatch.setattr(env, "_must", fails)
    with pytest.raises(SystemExit):
        env.ensure(env.DEV)
    assert not env.STAMP.exists()


def command(folder: Path) -> Path:
    """Writes a checkout with a command whose package prints the arguments and a flag. Returns the command's path."""
    scripts = folder / "scripts"
    (scripts / "tool").mkdir(parents=True)
    shutil.copy(environment.__file__, scripts)
    (scripts / "__init__.py").touch()
    (scripts / "tool" / "app.py").write_text("import sys\nprint(sys.argv[1:], sys.flags.optimize)\n", "utf-8")
    (scripts / "use.py").write_text("from environment import enter\nenter()\nimport scripts.tool.app\n", "utf-8")
    return scripts / "use.py"


@pytest.mark.parametrize("name", ["plain", "with a space"])
def test_a_command_runs_in_an_interpreter_that_has_the_checkout_on_its_path(tmp_path: Path, name: str) -> None:
    tool = command(tmp_path / name)
    here = {"PYTHONPATH": str(tmp_path / name)}
    done = subprocess.run(
        [sys.executable, "-O", tool, "--a", "b"], env=os.environ | here, capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("['--a', 'b'] 1\n", "")
    assert not (tmp_path / name / ".venv").exists()


@pytest.mark.parametrize(("pinned", "importable", "again"), [(False, True, 0), (False, False, 1), (True, True, 1)])
def test_a_command_starts_again_in_the_environment_if_it_must(
    env: ModuleType, monkeypatch: pytest.MonkeyPatch, pinned: bool, importable: bool, again: int
) -> None:
    started: list[tuple[object, ...]] = []
    monkeypatch.setattr(env, "become", lambda *command: started.append(command))
    monkeypatch.setattr(env, "_can_import", lambda: importable)
    env.enter(pinned=pinned)
    assert started == [(env.PYTHON, *sys.argv)] * again
    monkeypatch.setattr(sys, "executable", str(env.PYTHON))
    env.enter(pinned=pinned)
    assert len(started) == again, "a command never starts again within the environment"


def test_another_checkout_is_not_this_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert environment._can_import()
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    assert not environment._can_import()
