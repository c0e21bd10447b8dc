"""Runs `sovereign-loadtest` of this checkout: bots on real sockets against a real server. See `--help`."""

import sys

from sovereign_netcode.loadtest.app import main

if __name__ == "__main__":
    sys.exit(main())
