"""Reloading while a game is developed: a changed file restarts the server, and its players come back by themselves.

`sovereign-server --reload` runs the server as a child process. If a source or a scene file beside the game changes,
the child gets SIGTERM and tells its clients to reconnect at once. Another child, which stands by, starts on the same
port. With `--data` the world goes on; without it, it is a new world. A game that cannot be loaded is shown with its
error; the next change starts it again.
"""

import contextlib
import importlib.util
import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from server.config.settings import Settings

LOOK_S = 0.2
"""Seconds between two looks at the files."""
END_S = 5.0
"""Seconds that a child has to end. Then it is killed."""
RESTART_S = 0.5
"""Seconds after which clients reconnect."""
FILES_MAX = 2000
"""Maximum number of files that are watched."""
SUFFIXES = (".py", ".toml")
"""Suffixes of the files that are watched."""
STANDBY = "import json, sys; from sovereign_netcode.server.app import main; sys.exit(main(json.load(sys.stdin)))"
"""Program of a child: most of a server's start is the import, which is done before the server is needed."""
LISTENING = "listening on "
"""Beginning of the line by which a server says that it is ready."""

Stamps = dict[Path, int]
"""Times of the last change of files, in nanoseconds."""


def folder_of(game: str | None) -> Path:
    """Returns the folder of a game's module, or the working directory."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    spec = importlib.util.find_spec((game or "").partition(":")[0]) if game else None
    return Path(spec.origin).parent if spec is not None and spec.origin else Path(here)


def stamps(folder: Path) -> Stamps:
    """Returns the times of the watched files in a folder and the folders in it; hidden folders are left out."""
    found: Stamps = {}
    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.suffix in SUFFIXES and not hidden and path.is_file() and len(found) < FILES_MAX:
            found[path] = path.stat().st_mtime_ns
    return found


class Child:
    """A server in a process of its own. It imports the server at once, and begins when it gets its command line."""

    def __init__(self) -> None:
        self.port: str | None = None
        """Port on which it listens; None: it does not yet."""
        self.process = subprocess.Popen(
            [sys.executable, "-c", STANDBY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        threading.Thread(target=self._read, args=(self.process.stdout,), daemon=True).start()

    def begin(self, arguments: Sequence[str]) -> None:
        """Starts the server with a command line."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already; its exit code says so
            self.process.stdin.write(json.dumps(list(arguments)))
            self.process.stdin.close()

    def end(self) -> int:
        """Ends the process, and returns its exit code."""
        self.process.terminate()
        try:
            return self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def _read(self, out: TextIO) -> None:
        """Passes on what the server prints, and takes the port from it."""
        for line in out:
            if line.startswith(LISTENING):
                self.port = line.strip().rpartition(":")[2]
            print(line, end="", flush=True)


def serve(settings: Settings, arguments: Sequence[str]) -> int:
    """Runs the server until a signal, and restarts it at each change of a file. Returns the exit code.

    Args:
        settings: the settings.
        arguments: the command line that they come from.
    """
    games = [settings.game, *(kind.game for kind in settings.worlds.values())]
    folder = folder_of(next(filter(None, games), None))
    own = [*arguments, "--reload", "false", "--restart-s", str(RESTART_S)]
    child, standby = Child(), None
    try:
        child.begin(own)
        known = stamps(folder)
        print(f"watching {folder} for changes", file=sys.stderr, flush=True)
        failed = False
        while True:
            time.sleep(LOOK_S)
            code = child.process.poll()
            if code == 0:
                return 0
            if code is not None and not failed:
                failed = True
                print("the server has ended; it starts again when a file changes", file=sys.stderr, flush=True)
            if standby is None and (child.port or failed):
                standby = Child()
            found = stamps(folder)
            if found == known:
                continue
            known, failed, port = found, False, child.port
            print("a file has changed: restarting", file=sys.stderr, flush=True)
            child.end()
            child, standby = standby or Child(), None
            child.begin([*own, *(["--port", port] if port else [])])
            child.port = port
    finally:
        for each in (child, standby):
            if each is not None:
                each.end()
