#!/usr/bin/env python3
"""Runs `sovereign-loadtest` of this checkout: bots on real sockets against a real server. See `--help`."""

from __future__ import annotations

import sys

from environment import RUNTIME, enter

if __name__ == "__main__":
    enter(RUNTIME)
    from sovereign_netcode.loadtest.app import main

    sys.exit(main())
