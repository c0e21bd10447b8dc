"""The client in Pyodide, in Node.js, does the same as natively: bytes sent, views, worlds, corrections and replays."""

import gzip
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from scripts.browser_build import tools
from scripts.browser_build.packages import npm_package, wheels
from scripts.browser_build.tools import FetchError
from server.play.bundles import source_bundle
from tests.acrobat import CLASSES
from tests.browser.replayed import SAME, replayed
from tests.browser.tapes import Recorded, acrobats, walkers

ROOT = Path(__file__).parent.parent.parent
MODULES = ("tests/acrobat.py", "tests/browser/replayed.py")
PROGRAM = """
import js, json
from sovereign_netcode.shared import kernels
if "{form}": kernels.force("{form}")
from tests import acrobat
from tests.browser import replayed
found = [
    replayed.replayed(open(f"/tape/{{i}}", "rb").read(), acrobat.CLASSES if behaves else (), js.cpu)
    for i, behaves in enumerate({behaves})
]
json.dumps(found)
"""

pytestmark = pytest.mark.slow
Packages = tuple[str, Path, list[Path]]
"""Node.js, the folder of Pyodide, and the wheels for it."""


@pytest.fixture(scope="module")
def packages() -> Packages:
    """The packages, which are fetched if they are missing."""
    try:
        return tools.node(), npm_package("pyodide"), wheels()
    except FetchError as error:
        pytest.skip(str(error))


def in_pyodide(packages: Packages, recorded: list[Recorded], folder: Path, form: str = "") -> list[dict[str, Any]]:
    """Returns the results of tapes that are played in Pyodide, with the archive that a server hands out."""
    node, pyodide, own = packages
    sources = folder / "sources.zip"
    sources.write_bytes(gzip.decompress(source_bundle().files["sources.zip"].packed))
    files = {f"/site/{name}": str(ROOT / name) for name in MODULES}
    for i, each in enumerate(recorded):
        (folder / f"{i}").write_bytes(each.tape.data)
        files[f"/tape/{i}"] = str(folder / f"{i}")
    given = {
        "pyodide": str(pyodide),
        "archives": [str(path) for path in (*own, sources)],
        "files": files,
        "program": PROGRAM.format(form=form, behaves=[each.tape.behaves for each in recorded]),
    }
    command = (node, str(Path(__file__).with_name("pyodide.mjs")))
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout.splitlines()[-1])
    return found


def natively(recorded: Recorded) -> dict[str, Any]:
    """Returns the results of a tape that is played here, as far as they have to be the same everywhere."""
    found = replayed(recorded.tape.data, CLASSES if recorded.tape.behaves else ())
    return {name: found[name] for name in SAME}


def test_the_same_bytes_views_worlds_and_corrections(packages: Packages, tmp_path: Path) -> None:
    recorded = [walkers(10, players=20, link="far"), walkers(6, players=4, scene="hills"), acrobats(15)]
    assert recorded[0].replayed > 20
    assert recorded[2].corrections > 0
    found = in_pyodide(packages, recorded, tmp_path)
    assert [each["kernel"] for each in found] == ["prebuilt"] * 3
    assert not any(each["numpy"] for each in found)
    assert [{name: each[name] for name in SAME} for each in found] == [natively(each) for each in recorded]
    print(json.dumps({"CPU time in ms (mean, median, p99)": [each["ms"] for each in found]}))


def test_the_plain_kernel_too(packages: Packages, tmp_path: Path) -> None:
    recorded = [acrobats(2, players=3)]
    (found,) = in_pyodide(packages, recorded, tmp_path, "plain")
    assert found["kernel"] == "plain"
    assert {name: found[name] for name in SAME} == natively(recorded[0])
