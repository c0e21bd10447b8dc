#!/usr/bin/env python3
"""Leaves a server alone with everything at once, and then checks its world. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.soak_test.app import main

    sys.exit(main())
