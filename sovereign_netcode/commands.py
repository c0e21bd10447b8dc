"""Entry points of the installed commands, `sovereign-server` and others (`[project.scripts]` in pyproject.toml)."""

import importlib
import sys

from server.extras import install


def server() -> int:
    """Runs `sovereign-server`, which is `python -m sovereign_netcode.server`. Returns the exit code."""
    return _run("sovereign_netcode.server.__main__")


def loadtest() -> int:
    """Runs `sovereign-loadtest`, which is `python -m sovereign_netcode.loadtest`. Returns the exit code."""
    return _run("sovereign_netcode.loadtest.app", "tools")


def new_game() -> int:
    """Runs `sovereign-new-game`, which is `python -m sovereign_netcode.new_game`. Returns the exit code."""
    return _run("sovereign_netcode.new_game")


def play() -> int:
    """Runs `sovereign-play`, which is `python -m sovereign_netcode.play`. Returns the exit code."""
    if "--browser" in sys.argv:
        return _run("sovereign_netcode.play.in_browser")
    return _run("sovereign_netcode.play.app", "play")


def replay() -> int:
    """Runs `sovereign-replay`, which is `python -m sovereign_netcode.replay`. Returns the exit code."""
    return _run("sovereign_netcode.replay", "tools")


def _run(module: str, extra: str = "") -> int:
    """Calls a module's `main` as `python -m` would: modules in the current folder can be imported.

    Args:
        extra: the extra in pyproject.toml that installs the packages which the module needs.

    Raises:
        SystemExit: a package that the module needs is not installed.
    """
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        main = importlib.import_module(module).main
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if not extra or missing in ("sovereign_netcode", "client_sdk", "server", "shared"):
            raise
        sys.exit(f"error: this command needs {missing}, which is not installed here: {install(extra)}")
    return int(main())
