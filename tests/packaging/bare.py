"""A bare environment outside the repository, in which the built wheel is installed."""

import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 300.0
NAME = re.compile(r"[\w.-]+")


def build(source: Path, place: Path, *targets: str) -> None:
    """Builds distributions of a source tree into the folder `place`."""
    chosen = [part for target in targets for part in ("-t", target)]
    run(source, sys.executable, "-m", "hatchling", "build", "-d", str(place), *chosen)


def environment(place: Path, wheel: Path, *packages: str) -> Path:
    """Makes a virtual environment of a wheel, and of `packages` with what they require. Returns its Python.

    The packages are links to those of this environment, so nothing is downloaded, and the repository is not importable.
    """
    run(place.parent, sys.executable, "-m", "venv", "--without-pip", str(place))
    python = place / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    site = Path(sysconfig.get_path("purelib", "venv", {"base": str(place)}))
    for path in {path for package in required(*packages) for path in top_level(package)}:
        (site / path.name).symlink_to(path)
    pip = (sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check")
    run(place.parent, *pip, "install", "--quiet", "--no-index", "--no-deps", str(wheel))
    return python


def required(*packages: str) -> set[str]:
    """Returns distributions and all that they require."""
    found: set[str] = set()
    waiting = list(packages)
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name in found:
            continue
        found.add(name)
        for text in importlib.metadata.requires(name) or ():
            requirement, _, marker = text.partition(";")
            if "extra" not in marker and (match := NAME.match(requirement)) and installed(match[0]):
                waiting.append(match[0])
    return found


def installed(package: str) -> bool:
    """Returns whether a distribution is installed. One for another system or Python is not."""
    try:
        importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def top_level(package: str) -> Iterator[Path]:
    """Yields the files and folders of a distribution in `site-packages`."""
    for path in importlib.metadata.files(package) or ():
        if path.parts[0] not in ("..", "__pycache__"):
            yield Path(str(path.locate())).parents[len(path.parts) - 1] / path.parts[0]


def run(folder: Path, *command: str, **variables: str) -> str:
    """Runs a command in a folder. Returns its output, and fails if it fails."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SOVEREIGN_"))}
    done = subprocess.run(
        command,
        cwd=folder,
        env=clean | variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}"
    return done.stdout
