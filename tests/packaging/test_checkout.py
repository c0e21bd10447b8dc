"""The name `sovereign_netcode` in a checkout: an alias of the folders, for programs and for type checkers."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import hatch_build
from tests.lengths import long

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(name for name in hatch_build.module_names(ROOT) if not name.endswith(".__main__"))


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)


def test_a_module_is_one_object_under_both_names() -> None:
    assert "client_sdk.async_client" in MODULES
    for name in MODULES:
        module = importlib.import_module(f"sovereign_netcode.{name}")
        assert module is importlib.import_module(name)
        assert module.__name__ == name
        assert module.__spec__ is not None
        assert module.__spec__.name == name


@pytest.mark.parametrize("name", ["sovereign_netcode.server.nothing", "sovereign_netcode.nothing"])
def test_a_missing_module_is_named_as_it_was_imported(name: str) -> None:
    with pytest.raises(ModuleNotFoundError) as error:
        importlib.import_module(name)
    assert error.value.name == name


def test_the_long_name_first(tmp_path: Path) -> None:
    program = "import sovereign_netcode.server.rules as a; import server.rules as b; print(a is b, a.__name__)"
    done = run(tmp_path, "-c", program)
    assert (done.stdout, done.stderr) == ("True server.rules\n", "")


def test_a_package_runs_under_the_long_name(tmp_path: Path) -> None:
    done = run(tmp_path, "-m", "sovereign_netcode.server", "--list-scenes")
    assert done.returncode == 0, done.stderr
    assert "hills" in done.stdout
    done = run(ROOT, "-m", "server", "--list-scenes")
    assert done.returncode == 0, done.stderr
    assert "hills" in done.stdout


@pytest.mark.parametrize("theirs", ["shared/__init__.py", *long("server.py", "client_sdk.py")])
def test_a_module_of_the_program_with_the_same_name_is_reported(tmp_path: Path, theirs: str) -> None:
    (tmp_path / theirs).parent.mkdir(exist_ok=True)
    (tmp_path / theirs).write_text("", "utf-8")
    name = theirs.partition("/")[0].removesuffix(".py")

    (tmp_path / "ours_first.py").write_text(f"import sovereign_netcode.{name}\n", "utf-8")
    done = run(tmp_path, "ours_first.py")
    assert done.returncode == 0
    assert f"{tmp_path / theirs} cannot be imported, because {ROOT / name} has the same name: rename" in done.stderr
    assert "ours_first.py:1" in done.stderr

    (tmp_path / "theirs_first.py").write_text(f"import {name}, sovereign_netcode\n", "utf-8")
    done = run(tmp_path, "theirs_first.py")
    assert done.returncode == 1
    assert f"ImportError: sovereign_netcode in a checkout needs the name '{name}' for {ROOT / name}" in done.stderr


def test_each_module_has_a_stub_and_no_stub_is_left(tmp_path: Path) -> None:
    for name in ("server/__init__.py", "server/__main__.py", "server/rules.py", "client_sdk/transports/__init__.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "shared").mkdir()
    hatch_build.write_stubs(tmp_path)
    place = tmp_path / "sovereign_netcode"
    stubs = {file.relative_to(place).as_posix(): file.read_text() for file in place.rglob("*.pyi")}
    assert stubs == {
        "server/__init__.pyi": "from server import *\n",
        "server/rules.pyi": "from server.rules import *\n",
        "client_sdk/transports/__init__.pyi": "from client_sdk.transports import *\n",
    }
    (tmp_path / "server" / "rules.py").unlink()
    hatch_build.write_stubs(tmp_path)
    assert not (place / "server" / "rules.pyi").exists()


@pytest.mark.slow
def test_type_checkers_see_through_the_alias(tmp_path: Path) -> None:
    hatch_build.write_stubs(ROOT)
    (tmp_path / "mine.py").write_text(
        "from sovereign_netcode.client_sdk import Client\n"
        "from sovereign_netcode.server.rules import Rules\n"
        "from sovereign_netcode.shared import scene\n"
        "class Mine(Rules):\n"
        "    def on_start(self) -> int:\n        return 1\n"
        "reveal_type(Client.connect('').view())\n"
        "reveal_type(scene.load_scene('flat').tick_rate)\n",
        "utf-8",
    )
    done = run(tmp_path, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "mine.py")
    assert 'mine.py:5: error: Return type "int" of "on_start" incompatible with return type "None"' in done.stdout
    assert 'mine.py:7: note: Revealed type is "client_sdk.view.View"' in done.stdout
    assert 'mine.py:8: note: Revealed type is "int"' in done.stdout
    assert "Found 1 error" in done.stdout
