#!/usr/bin/env python3
"""Takes a picture of the live page. `--help` lists the options."""

from __future__ import annotations

import sys

from environment import enter

if __name__ == "__main__":
    enter()
    from scripts.live_page.app import main

    sys.exit(main())
