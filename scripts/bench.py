#!/usr/bin/env python3
"""Runs a benchmark and prints its figures with their scatter. `--help` lists the benchmarks."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.benchmarks.app import main

    sys.exit(main())
