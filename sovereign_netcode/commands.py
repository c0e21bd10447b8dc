"""The installed commands, `sovereign-server` and others: what pyproject.toml's `[project.scripts]` name."""

import importlib
import sys

DISTRIBUTIONS = {"pygame": "pygame-ce"}
"""What to install for a module, where that has another name."""


def server() -> int:
    """Runs `sovereign-server`, which is `python -m sovereign_netcode.server`. Returns the exit code."""
    return _run("sovereign_netcode.server.__main__")


def _run(module: str) -> int:
    """Calls a module's `main`, in the conditions of `python -m`: modules in the current folder can be imported.

    Raises:
        SystemExit: a package that the command needs is not installed.
    """
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        main = importlib.import_module(module).main
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if not missing or missing == "sovereign_netcode":
            raise
        sys.exit(f"error: this command needs {missing} as well: pip install {DISTRIBUTIONS.get(missing, missing)}")
    return int(main())
