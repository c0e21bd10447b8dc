#!/usr/bin/env python3
"""Writes tests/golden/physics.json, the hashes that the physics must reach.

Run it only for an intended change of the physics: every client must then be updated. The compiled and the plain
executor must agree on every hash first.
"""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from tests.golden.regenerate import main

    sys.exit(main())
