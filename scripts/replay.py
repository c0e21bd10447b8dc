"""Runs `sovereign-replay` of this checkout: a recording again, tick by tick. `--help` says more."""

import sys

from sovereign_netcode.replay import main

if __name__ == "__main__":
    sys.exit(main())
