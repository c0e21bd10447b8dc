"""`python -m server`: see `--help`."""

import sys

try:
    from server.app import main
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] in ("server", "shared"):
        raise
    sys.exit(f"error: the server needs {error.name} as well: pip install 'sovereign-netcode[server]'")

if __name__ == "__main__":
    sys.exit(main())
