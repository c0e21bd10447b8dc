#!/usr/bin/env python3
"""Measures the speed and the errors of the choices in the physics. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.experiments.accuracy import main

    sys.exit(main())
