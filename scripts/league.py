#!/usr/bin/env python3
"""Compares lead controllers: late inputs against added latency. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.experiments.league import main

    sys.exit(main())
