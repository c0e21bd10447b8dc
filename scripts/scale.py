#!/usr/bin/env python3
"""Kills the processes of one world on many processes while bots play. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.scale_lab.app import main

    sys.exit(main())
