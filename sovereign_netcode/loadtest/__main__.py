"""Runs the load test: `python -m sovereign_netcode.loadtest --help`."""

import sys

from sovereign_netcode.commands import loadtest

if __name__ == "__main__":
    sys.exit(loadtest())
