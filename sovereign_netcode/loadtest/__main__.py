"""`python -m sovereign_netcode.loadtest`: see `--help`."""

import sys

from sovereign_netcode.commands import loadtest

if __name__ == "__main__":
    sys.exit(loadtest())
