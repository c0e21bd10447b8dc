#!/usr/bin/env python3
"""Measures the cost of saving a world. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.benchmarks.store import main

    sys.exit(main())
