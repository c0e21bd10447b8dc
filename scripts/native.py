#!/usr/bin/env python3
"""Runs a program of the repository with its sources compiled by mypyc. `--help` tells how."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter(pinned=True)
    from scripts.native_build.app import main

    main(sys.argv[1:])
