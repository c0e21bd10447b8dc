#!/usr/bin/env python3
"""Measures the speed of the environment for agents. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.benchmarks.agents import main

    sys.exit(main())
