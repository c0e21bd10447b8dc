"""Runs `sovereign-replay` of this checkout: replays a recording tick by tick. `--help` lists the options."""

import sys

from sovereign_netcode.replay import main

if __name__ == "__main__":
    sys.exit(main())
