#!/usr/bin/env python3
"""Fuzzes the code that takes bytes from outside. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.fuzzing.app import main

    sys.exit(main())
