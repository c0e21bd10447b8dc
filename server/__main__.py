"""The entry point of `python -m server`, which does what the command `sovereign-server` does."""

import sys

from server.extras import ROOT, install

try:
    from server.app import main
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] in ("server", "shared", "sovereign_netcode"):
        raise
    ready = (ROOT / ".venv").is_dir()
    way = ". .venv/bin/activate (it is in .venv)" if ready else install("server")
    sys.exit(f"error: the server needs {error.name}, which is not installed here: {way}")

if __name__ == "__main__":
    sys.exit(main())
