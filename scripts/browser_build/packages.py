"""The pinned packages that are fetched for browsers, and how: by npm and pip, checked by their hashes."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from scripts.browser_build.tools import FetchError as FetchError
from scripts.browser_build.tools import npm
from scripts.environment import ROOT

FETCHED = ROOT / "build" / "packages"
"""Folder of the fetched packages."""
NPM = {
    "pyodide": ("314.0.7", "0YvXxEhfEdpLfb/XkM2BFAeMROq0iMUX2bzzH9pOttyMcWkwq+HbE5uyuGD82LN7y2q+SNvi/6V5JEsOlD2R1A=="),
    "three": ("0.187.0", "Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA=="),
    "@sparticuz/chromium": (
        "153.0.0",
        "jiGWqSvPMdu4+P9TilYqAR7yEGPEHINx+lCvE/NqNO/EHYzF/x1hUiI5T6ioVIt7dEy7n88byyT0vk+dnsgQwA==",
    ),
}
"""Version and SHA-512 of the archive of each npm package, by name."""
PINS = ROOT / "requirements-browser.txt"
"""Pins of the wheels for Python in browsers, with their hashes."""
WHEELS = "--platform pyemscripten_2026_0_wasm32 --implementation cp --abi cp314 --python-version 3.14".split()
"""Options of pip that select wheels for the Python of `pyodide`."""


def npm_package(name: str) -> Path:
    """Returns the folder of a package of `NPM`. It is fetched if it is missing.

    Raises:
        FetchError: npm cannot be had or fails, or the archive has another hash.
    """
    version, wanted = NPM[name]
    folder = FETCHED / f"{name.replace('/', '-').strip('@')}-{version}"
    if folder.exists():
        return folder
    print(f"fetching {name} {version} ...", flush=True)
    FETCHED.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FETCHED) as place:
        command = (*npm(), "pack", f"{name}@{version}", "--silent", "--pack-destination", place)
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        archives = list(Path(place).glob("*.tgz"))
        if done.returncode or not archives:
            reason = (done.stderr or done.stdout).strip() or f"npm ended with {done.returncode}"
            raise FetchError(f"{name} {version}: {reason}")
        data = archives[0].read_bytes()
        if base64.b64encode(hashlib.sha512(data).digest()).decode() != wanted:
            raise FetchError(f"{name} {version}: the archive differs from its pinned hash")
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(place, filter="data")
        with contextlib.suppress(OSError):  # another process was faster
            (Path(place) / "package").rename(folder)
    return folder


def wheels() -> list[Path]:
    """Returns the wheels of `PINS`. They are fetched if one is missing.

    Raises:
        FetchError: pip fails, or a wheel has another hash.
    """
    folder = FETCHED / f"wheels-{hashlib.sha256(PINS.read_bytes()).hexdigest()[:12]}"
    if not folder.exists():
        print("fetching wheels for Python in browsers ...", flush=True)
        FETCHED.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=FETCHED) as place:
            made = Path(place) / "wheels"
            pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps")
            command = (*pip, *WHEELS, "--only-binary", ":all:", "--require-hashes", "-d", str(made), "-r", str(PINS))
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise FetchError(f"{PINS.name}: {(done.stderr or done.stdout).strip()}")
            made.rename(folder)
    return sorted(folder.glob("*.whl"))
