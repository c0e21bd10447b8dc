"""The distributions, and the installed package beside a user's own `server.py`, `shared/` and `client_sdk.py`.

Everything runs in a bare environment outside the repository (`tests.packaging.bare`).
"""

import email
import gzip
import json
import re
import shutil
import subprocess
import tarfile
import tomllib
import urllib.request
import zipfile
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import pytest

from hatch_build import FOLDERS
from tests.client_sdk.servers import real_server
from tests.lengths import long
from tests.packaging.bare import ROOT, build, environment, run
from tests.packaging.test_rewriting import imported
from tests.readme.pages import programs
from tests.readme.run_snippet import LOOPS, URL
from tests.readme.test_snippets import A_FILE, ALONE, ENGINES, ON_A_SERVER, WORLDS

pytestmark = pytest.mark.e2e

PACKAGES = (
    *("numpy", "websockets", "msgpack"),
    *("prometheus-client", "pyjwt", "structlog", "uvloop", "pettingzoo", "pygame-ce", "rich"),
    *("mypy", "pytest"),
)
"""Requirements of the package with all its extras, without Numba, which is for other platforms; and tools of users."""
DIST_INFO = f"sovereign_netcode-{tomllib.loads((ROOT / 'pyproject.toml').read_text())['project']['version']}.dist-info"
"""Folder of the metadata in the wheel."""
COMMANDS = ("loadtest", "new-game", "play", "replay", "server")


class Installed(NamedTuple):
    """A bare environment with the wheel, and a folder of a user's files."""

    python: Path
    folder: Path

    def run(self, *arguments: str) -> str:
        """Runs the environment's Python in the user's folder. Returns the output."""
        return run(self.folder, str(self.python), *arguments)

    def command(self, name: str, *arguments: str) -> str:
        """Runs an installed command in the user's folder. Returns the output."""
        return run(self.folder, str(self.python.parent / name), *arguments)

    def served(self, *flags: str) -> AbstractContextManager[str]:
        """Returns a context with the URL of an installed server in the user's folder."""
        return real_server(*flags, program=(str(self.python.parent / "sovereign-server"),), folder=self.folder)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the source distribution."""
    place = tmp_path_factory.mktemp("built")
    build(ROOT, place, "wheel", "sdist")
    return place


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (found,) = built.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    place = tmp_path_factory.mktemp("user")
    folder = place / "game"
    (folder / "shared").mkdir(parents=True)
    (folder / "server.py").write_text("NAME = 'my server'\n", "utf-8")
    (folder / "client_sdk.py").write_text("NAME = 'my client'\n", "utf-8")
    (folder / "shared" / "__init__.py").write_text("NAME = 'my shared'\n", "utf-8")
    # the pages, and the code that runs their programs, which is not part of the package
    shutil.copytree(ROOT / "tests" / "readme", folder / "tests" / "readme")
    shutil.copy(ROOT / "tests" / "patience.py", folder / "tests")
    shutil.copytree(ROOT / "docs", folder / "docs")
    shutil.copy(ROOT / "README.md", folder)
    return Installed(environment(place / "venv", wheel, *PACKAGES), folder)


def names(wheel: Path) -> set[str]:
    """Returns all files of a wheel except its metadata, relative to the package."""
    with zipfile.ZipFile(wheel) as archive:
        files = {Path(name) for name in archive.namelist()}
    assert {file.parts[0] for file in files} == {"sovereign_netcode", DIST_INFO}
    return {"/".join(file.parts[1:]) for file in files if file.parts[0] == "sovereign_netcode"}


def known_to_git(*places: str) -> set[str]:
    """Returns all files that git has or would take."""
    command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *places)
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return {name for name in listed.split("\0") if name and (ROOT / name).exists()}


def test_the_wheel_has_one_package_with_every_file_of_the_product(wheel: Path) -> None:
    own = {name.removeprefix("sovereign_netcode/") for name in known_to_git("sovereign_netcode")}
    missing = (known_to_git(*FOLDERS) | own - {"_checkout.py"}) - names(wheel)
    assert missing == set()
    page, scene = "server/observability/live.html", "shared/scenes/hills.toml"
    assert {"py.typed", page, scene, "server/__main__.py"} <= names(wheel)


def test_no_source_of_the_wheel_imports_a_folder(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.endswith(".py"):
                source = archive.read(name).decode()
                assert [module for module in imported(source) if module.partition(".")[0] in FOLDERS] == [], name


def test_the_metadata_says_what_it_is(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        metadata = email.message_from_bytes(archive.read(f"{DIST_INFO}/METADATA"))
        commands = archive.read(f"{DIST_INFO}/entry_points.txt").decode()
        licence = archive.read(f"{DIST_INFO}/licenses/LICENSE")
    assert str(metadata.get_payload()).startswith("# Sovereign Netcode\n")
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])
    assert metadata["License-Expression"] == "MIT"
    assert licence == (ROOT / "LICENSE").read_bytes()
    assert all(f"sovereign-{name} = sovereign_netcode.commands:" in commands for name in COMMANDS)


@pytest.mark.slow
def test_the_source_distribution_has_what_git_has_and_makes_the_same_wheel(
    built: Path, wheel: Path, tmp_path: Path
) -> None:
    (found,) = built.glob("*.tar.gz")
    with tarfile.open(found) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    files = {file.relative_to(source).as_posix() for file in source.rglob("*") if file.is_file()}
    assert files - {"PKG-INFO"} == known_to_git()
    if (fetched := ROOT / "build" / "browser").exists():  # Python for browsers, which is not in git
        shutil.copytree(fetched, source / "build" / "browser")
    build(source, tmp_path / "again", "wheel")
    assert (tmp_path / "again" / wheel.name).read_bytes() == wheel.read_bytes()


def test_nothing_of_the_users_is_hidden_and_nothing_of_ours_hides(installed: Installed) -> None:
    program = (
        "import sovereign_netcode.server.game, sovereign_netcode.client_sdk, sovereign_netcode.shared.world\n"
        "import server, shared, client_sdk\n"
        "print(server.NAME, shared.NAME, client_sdk.NAME, sovereign_netcode.__path__)\n"
    )
    said = installed.run("-c", program)
    assert said.startswith("my server my shared my client ")
    assert str(ROOT) not in said


def test_every_module_can_be_imported(installed: Installed) -> None:
    """The module for NATS needs the extra `scale`."""
    program = (
        "import importlib, pkgutil, sys, sovereign_netcode\n"
        "for found in pkgutil.walk_packages(sovereign_netcode.__path__, 'sovereign_netcode.'):\n"
        "    if not found.name.endswith(('__main__', 'nats_bus')):\n"
        "        importlib.import_module(found.name)\n"
        "print(sorted({'server', 'shared', 'client_sdk', 'scripts', 'tests'} & sys.modules.keys()))\n"
    )
    assert installed.run("-W", "error", "-c", program) == "[]\n"


def test_the_physics_is_prebuilt(installed: Installed) -> None:
    """Numba is not installed there."""
    program = "from sovereign_netcode.shared import kernels; print(kernels.chosen(), kernels.trouble())"
    said = installed.run("-c", program)
    assert said == "prebuilt \n" or "no prebuilt kernel for" in said


@pytest.mark.parametrize("name", [*long(*COMMANDS[:-1]), COMMANDS[-1]])
def test_a_command_runs_as_a_module_too(installed: Installed, name: str) -> None:
    said = installed.command(f"sovereign-{name}", "--help")
    assert "usage: " in said
    assert installed.run("-m", f"sovereign_netcode.{name.replace('-', '_')}", "--help") == said


@pytest.mark.slow
def test_a_command_says_what_it_lacks(wheel: Path, tmp_path: Path) -> None:
    alone = Installed(environment(tmp_path / "venv", wheel, "numpy", "websockets", "msgpack"), tmp_path)
    for name, module, extra in (
        ("loadtest", "rich", "tools"),
        ("play", "pygame", "play"),
        ("server", "structlog", "server"),
    ):
        done = subprocess.run(
            [alone.python.parent / f"sovereign-{name}"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 1
        assert f"needs {module}, which is not installed here: pip install 'PATH[{extra}]'" in done.stderr, done.stderr


@pytest.mark.slow
def test_a_game_is_begun_tested_and_served(installed: Installed) -> None:
    said = installed.command("sovereign-new-game", "king_of_the_hill")
    assert "sovereign_netcode.server --game king_of_the_hill:KingOfTheHill" in said
    assert "4 passed" in installed.run("-m", "pytest", "-q", "test_king_of_the_hill.py")
    with installed.served("--game", "king_of_the_hill:KingOfTheHill", "--record", "session"):
        pass
    game = "king_of_the_hill:KingOfTheHill"
    assert "ticks as recorded" in installed.command("sovereign-replay", "session", "--game", game)


@pytest.mark.slow
def test_a_game_is_played_in_the_window(installed: Installed) -> None:
    said = installed.command("sovereign-play", "--script-demo", "picture.png")
    assert "the script has ended" in said
    assert (installed.folder / "picture.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_match(installed: Installed) -> None:
    program = "from tests.readme.pages import programs; exec(programs()['Testing it']); print('over:', match.now)"
    assert "over: 30" in installed.run("-c", program)


@pytest.mark.parametrize("name", [LOOPS[0], *long(*LOOPS[1:], *ENGINES)])
def test_a_program_with_a_loop(installed: Installed, name: str) -> None:
    assert "walked" in installed.run("-m", "tests.readme.run_snippet", name)


@pytest.mark.slow
def test_the_other_programs(installed: Installed) -> None:
    with installed.served("--scene", "flat") as url:
        for name in ON_A_SERVER:
            assert "walked" in installed.run("-m", "tests.readme.run_snippet", name, url)
    for name in ALONE:
        installed.run("-c", f"from tests.readme.pages import programs; exec(programs()[{name!r}])")
    assert len(programs()) == len([*LOOPS, A_FILE, *ENGINES, *ON_A_SERVER, *ALONE, WORLDS])


@pytest.mark.slow
def test_a_world_is_found(installed: Installed, tmp_path: Path) -> None:
    (config := tmp_path / "server.toml").write_text('scene = "flat"\n[worlds.arena]\nscene = "flat"\n', "utf-8")
    with installed.served("--config", str(config)) as url:
        told = {URL: url, "while not client.closed": "for _ in range(240)"}
        program = (
            f"text = programs()[{WORLDS!r}]\nfor old, new in {told!r}.items():\n    text = text.replace(old, new)\n"
        )
        said = installed.run("-c", f"from tests.readme.pages import programs\n{program}exec(text)")
    assert "playing in arena-1" in said


@pytest.mark.slow
def test_five_bots(installed: Installed) -> None:
    said = installed.command("sovereign-loadtest", "--clients", "5", "--seconds", "3", "--scene", "flat", "--verdict")
    assert "failed:" not in said


@pytest.mark.slow
def test_types_are_checked(installed: Installed) -> None:
    (installed.folder / "mine.py").write_text(
        "import server\n"
        "from sovereign_netcode.client_sdk import Client\n"
        "from sovereign_netcode.playtest import Match\n"
        "from sovereign_netcode.server.rules import Rules\n"
        "class Mine(Rules):\n"
        "    def on_start(self) -> int:\n"
        "        return 1\n"
        "reveal_type(Client.connect(server.NAME).view())\n"
        "reveal_type(Match.run)\n",
        "utf-8",
    )
    done = subprocess.run(
        [installed.python, "-m", "mypy", "--strict", "mine.py"],
        cwd=installed.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    said = done.stdout.splitlines()
    assert said[0].startswith('mine.py:6: error: Return type "int" of "on_start" incompatible with return type "None"')
    assert 'mine.py:8: note: Revealed type is "sovereign_netcode.client_sdk.view.View"' in said
    assert said[-1] == "Found 1 error in 1 file (checked 1 source file)"


def test_an_installed_server_has_the_page_to_play_on(installed: Installed) -> None:
    with installed.served("--scene", "flat") as url:
        address = url.replace("ws:", "http:")
        with urllib.request.urlopen(f"{address}/play", timeout=60) as answer:
            page = answer.read().decode()
        scripts = re.findall(r'src="(/play/[0-9a-f]+/play.js)"', page)
        with urllib.request.urlopen(address + scripts[0], timeout=60) as answer:
            assert b"sovereign.js" in gzip.decompress(answer.read())
        with urllib.request.urlopen(f"{address}/play/kernel.wasm", timeout=60) as answer:
            assert gzip.decompress(answer.read()).startswith(b"\0asm")
    told = installed.run("-c", SOURCES)
    assert json.loads(told) == {"others": [], "core": True, "kernel": True}


SOURCES = """
import gzip, io, json, zipfile
from sovereign_netcode.server.play.bundles import source_bundle
(file,) = source_bundle().files.values()
names = zipfile.ZipFile(io.BytesIO(gzip.decompress(file.packed))).namelist()
places = tuple(f"sovereign_netcode/{name}" for name in ("client_sdk/", "shared/", "__init__.py"))
print(json.dumps({
    "others": [name for name in names if not name.startswith(places)],
    "core": "sovereign_netcode/client_sdk/core.py" in names,
    "kernel": "sovereign_netcode/shared/prebuilt/kernel-emscripten.so" in names,
}))
"""
