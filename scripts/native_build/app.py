"""Runs a program of the repository with its sources compiled by mypyc. The network lab takes half the time.

    python scripts/native.py scripts/netlab.py --preset typical --minutes 60
    python scripts/native.py -m server --scene hills

Needs a C compiler and Python's headers. A copy of the sources is compiled in `build/native`, once for each state of the
sources (a minute, 30 MB), and the program runs there. Nothing else uses the compiled copy.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from scripts.environment import ROOT

SOURCES = ("client_sdk", "scripts", "server", "shared", "sovereign_netcode", "tests")
BUILT = ROOT / "build" / "native"
MODULES = (
    "client_sdk/changing.py", "client_sdk/commands.py", "client_sdk/core.py", "client_sdk/input_loop.py",
    "client_sdk/interpolation/interpolation.py", "client_sdk/interpolation/smoothing.py", "client_sdk/netsim/linked.py",
    "client_sdk/netsim/links.py", "client_sdk/prediction/comparison.py", "client_sdk/prediction/confirmed.py",
    "client_sdk/prediction/prediction.py",
    "client_sdk/program_side.py", "client_sdk/reconnect.py", "client_sdk/replica.py", "client_sdk/stats.py",
    "client_sdk/timing/lead.py", "client_sdk/timing/server_clock.py", "client_sdk/timing/timeline.py",
    "client_sdk/view_builder.py", "client_sdk/worlds.py", "server/game/clocks.py", "server/game/commands.py",
    "server/game/connections.py", "server/game/game.py", "server/game/joining.py", "server/game/roster.py",
    "server/game/session.py", "server/net/admission.py", "server/net/gateway.py", "server/net/websocket.py",
    "server/observability/counters.py", "server/players/input_queue.py", "server/players/player.py",
    "server/replication/change_log.py", "server/replication/client_stream.py", "server/replication/client_view.py",
    "server/replication/flow_control.py", "server/replication/interest.py", "server/replication/sender.py",
    "shared/fields.py", "shared/inputs.py", "shared/messages.py", "shared/ring.py", "shared/snapshot.py",
    "sovereign_netcode/playtest/match.py",
)  # fmt: skip
"""Modules that a tick of a server and of a client runs. Other programs cannot derive from the classes of a compiled
module, so rules, policies and transports are not among them."""


def built() -> Path:
    """Returns the folder with the compiled copy of the current sources. Compiles them if there is none.

    Raises:
        SystemExit: the sources cannot be compiled.
    """
    digest = hashlib.sha256(sys.version.encode())
    for file in sources():
        digest.update(f"{file.relative_to(ROOT)}\0".encode() + file.read_bytes())
    place = BUILT / digest.hexdigest()[:16]
    if not place.exists():
        print("compiling the sources for this machine, once: a minute or two ... ", end="", file=sys.stderr, flush=True)
        started = time.perf_counter()
        raw = BUILT / f"unfinished-{os.getpid()}"
        build(raw)
        raw.rename(place)
        print(f"done in {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return place


def sources() -> list[Path]:
    """Returns all files that a program of the repository may need."""
    files = (file for folder in SOURCES for file in (ROOT / folder).rglob("*") if "__pycache__" not in file.parts)
    return [ROOT / "pyproject.toml", *sorted(file for file in files if file.is_file())]


def build(place: Path, optimise: int = 3) -> None:
    """Copies the sources to a new folder, and compiles them there.

    Args:
        optimise: the C compiler's level of optimisation, from 0 to 3.

    Raises:
        SystemExit: the sources cannot be compiled.
    """
    for file in sources():
        copy = place / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, copy)
    command = (sys.executable, "-P", "-m", "scripts.native_build.compile", str(optimise), *MODULES)
    environment = os.environ | {"PYTHONPATH": str(place)}
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        shutil.rmtree(place)
        sys.exit(
            f"failed\n{done.stdout[-2000:]}{done.stderr[-2000:]}\nAre a C compiler and Python's headers installed?"
        )
    shutil.rmtree(place / "build")  # the C sources and object files


def main(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        sys.exit(not arguments)
    place = built()
    if arguments[0] == "-m":
        command = ["-P", *arguments]  # modules in the current folder cannot hide others
    else:
        script = Path(arguments[0]).resolve()
        if not script.is_relative_to(ROOT):
            sys.exit(f"{arguments[0]}: not a program in {ROOT}")
        command = [str(place / script.relative_to(ROOT)), *arguments[1:]]
    path = os.pathsep.join(filter(None, (str(place), os.environ.get("PYTHONPATH"))))
    # Replaces this process, so that a signal to it reaches the program.
    os.execve(sys.executable, (sys.executable, *command), os.environ | {"PYTHONPATH": path})
