"""Opens the window: `python -m sovereign_netcode.play --help`."""

import sys

from sovereign_netcode.commands import play

if __name__ == "__main__":
    sys.exit(play())
