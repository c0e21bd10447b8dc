#!/usr/bin/env python3
"""Measures what a player feels on each kind of link. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.network_lab.app import main

    sys.exit(main())
