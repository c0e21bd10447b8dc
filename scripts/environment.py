"""The repository's own `.venv`, made from hashed pins. This file needs only the standard library.

Interpreters older than the supported ones must be able to run this file, because it looks for a newer one. The commands
in this folder import it as `environment`, because Python finds the modules beside a command. Everything else imports
`scripts.environment`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, NoReturn

RUNTIME = "requirements.txt"
DEV = "requirements-dev.txt"

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
STAMP = VENV / "sovereign-netcode.stamp"
UNCOMPILED = r"[/\\](tests?|fontTools|matplotlib|mpl_toolkits|mypyc?|numba|pip|pygments|setuptools)[/\\]"
"""Pattern for the paths in `.venv` that the set-up does not compile. They are most of the sources, and most commands
import none of them."""


class Step(NamedTuple):
    title: str
    status: int
    seconds: float


def ensure(requirements: str) -> Path:
    """Returns the Python of an environment that has at least the pins of `requirements`. Sets it up if necessary.

    The stamp file is absent while a set-up runs, so a set-up after an interrupted one starts from scratch. Changed pins
    are installed over the old ones.
    """
    place, installed, digest = _read_stamp()
    usable = place == str(ROOT) and PYTHON.exists()
    if usable and installed == DEV:
        requirements = DEV
    wanted = _digest(requirements)
    if usable and (installed, digest) == (requirements, wanted):
        return PYTHON

    base = _base_python()
    print(f"setting up {VENV} with the pins of {requirements}, once: up to a minute ... ", end="", flush=True)
    started = time.perf_counter()
    if usable:
        STAMP.unlink()
    else:
        _must(base, "-m", "venv", "--clear", str(VENV))
    _install(requirements)
    STAMP.write_text("\n".join((str(ROOT), requirements, wanted)), encoding="utf-8")
    print(f"done in {time.perf_counter() - started:.0f} s", flush=True)
    return PYTHON


def enter(requirements: str = DEV, *, pinned: bool = False) -> None:
    """Continues a command in an interpreter that can import the packages of this checkout.

    Returns if this interpreter can, or else starts the command again in `.venv`.

    Args:
        requirements: file of the pins that `.venv` needs at least.
        pinned: whether only `.venv` will do, because the command depends on the exact versions.
    """
    if pinned or not _can_import():
        python = ensure(requirements)
        if Path(sys.executable) != python:
            become(python, *sys.argv)


def become(python: Path, *args: str) -> NoReturn:
    """Replaces this process by a run of `python` with `args`, so that a signal to it reaches the new program."""
    if os.name == "nt":  # exec would return to the shell at once
        sys.exit(subprocess.run([str(python), *args], check=False).returncode)
    os.execv(python, [str(python), *args])


def run(title: str, *args: str, niceness: int = 0) -> Step:
    """Runs the environment's Python with `args` in the repository's root. Its output is not captured.

    Args:
        niceness: how far other processes come before it, from 0 to 19, where the system can do that.
    """
    print(f"\n== {title}", flush=True)
    started = time.perf_counter()
    status = subprocess.run([*nice(niceness), str(PYTHON), *args], cwd=ROOT, check=False).returncode
    return Step(title, status, time.perf_counter() - started)


def nice(niceness: int) -> tuple[str, ...]:
    """Returns the beginning of a command that runs with a niceness. It is empty where there is no such program."""
    return ("nice", "-n", str(niceness)) if niceness and shutil.which("nice") else ()


def lacking(module: str) -> str:
    """Returns how to install a module that only the development pins have; empty if it is installed."""
    if importlib.util.find_spec(module) is not None:
        return ""
    return f"{module} is not installed here; `python scripts/test --version` installs everything for development"


def _can_import() -> bool:
    """Returns whether this interpreter is new enough, and finds the package `scripts` of this checkout."""
    found = importlib.util.find_spec("scripts") if sys.version_info >= (3, 11) else None
    return found is not None and Path(found.origin or "").resolve() == ROOT / "scripts" / "__init__.py"


def _read_stamp() -> tuple[str, str, str]:
    try:
        place, requirements, digest = STAMP.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return "", "", ""
    return place, requirements, digest


def _digest(requirements: str) -> str:
    sources = (ROOT / requirements, ROOT / "pyproject.toml")
    return hashlib.sha256(b"\0".join(source.read_bytes() for source in sources)).hexdigest()


def _base_python() -> str:
    names = ("python3.11", "python3.12", "python3.13", "python3.14")
    for candidate in (sys.executable, *filter(None, map(shutil.which, names))):
        # A version manager's shim may be on PATH without a Python behind it, so run it to find out.
        probe = [candidate, "-c", "import sys; sys.exit(sys.version_info < (3, 11))"]
        if subprocess.run(probe, capture_output=True, check=False).returncode == 0:
            return candidate
    version = ".".join(map(str, sys.version_info[:2]))
    raise _failure(f"Python 3.11 or newer is needed; this is {version}, and PATH has no newer one")


def _install(requirements: str) -> None:
    """Installs the pins of a file and this checkout.

    Two processes of pip install half of the pins each, and all processors compile the bytecode. pip by itself uses one
    processor, which takes twice as long. The pins name all dependencies, so the halves do not depend on each other.
    """
    pip_install = (str(PYTHON), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        commands = []
        for number, half in enumerate(halves((ROOT / requirements).read_text(encoding="utf-8"))):
            part = Path(folder) / f"{number}.txt"
            part.write_text(half, encoding="utf-8")
            commands.append((*pip_install, "--no-compile", "--require-hashes", "-r", str(part)))
        list(pool.map(lambda command: _must(*command), commands))
    _must(*pip_install, "--no-build-isolation", "-e", ".")
    _compile()


def halves(pins: str) -> tuple[str, str]:
    """Returns the text of a file of pins as two such texts."""
    found: list[str] = []
    for line in pins.splitlines(keepends=True):
        if not line.startswith("#"):
            if line[0].isspace():
                found[-1] += line
            else:
                found.append(line)
    return "".join(found[::2]), "".join(found[1::2])


def _compile() -> None:
    """Compiles the bytecode of the packages that are often used. Some have files of other versions of Python."""
    command = (str(PYTHON), "-m", "compileall", "-q", "-j", "0", "-x", UNCOMPILED, str(VENV))
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)


def _must(*command: str) -> None:
    done = subprocess.run(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode != 0:
        raise _failure(f"failed\n{done.stdout}\nset-up of .venv failed: {' '.join(command)}")


def _failure(message: str) -> SystemExit:
    print(message, file=sys.stderr)
    return SystemExit(2)
