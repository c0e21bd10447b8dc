"""`python -m server`: see `--help`."""

import sys
from pathlib import Path

try:
    from server.app import main
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] in ("server", "shared"):
        raise
    if (Path(__file__).parents[1] / ".venv").is_dir():
        sys.exit(f"error: the server needs {error.name} as well, which is in .venv: . .venv/bin/activate")
    sys.exit(f"error: the server needs {error.name} as well: pip install 'sovereign-netcode[server]'")

if __name__ == "__main__":
    sys.exit(main())
