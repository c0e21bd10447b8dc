#!/usr/bin/env python3
"""Runs `sovereign-replay` of this checkout: replays a recording tick by tick. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import RUNTIME, enter

if __name__ == "__main__":
    enter(RUNTIME)
    from sovereign_netcode.replay import main

    sys.exit(main())
