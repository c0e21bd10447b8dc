"""Writes tests/golden/physics.json, the hashes that the physics must reach. `scripts/regenerate_goldens.py` runs it."""

import json
import sys
from pathlib import Path

from shared import kernels
from tests.golden.scripts import SCRIPTS, run

GOLDENS = Path(__file__).with_name("physics.json")


def main() -> int:
    goldens = {}
    for name in SCRIPTS:
        plain = dict(run(name, compiled=False))
        if kernels.available() and dict(run(name, compiled=True)) != plain:
            print(f"{name}: compiled and plain Python differ; nothing was written", file=sys.stderr)
            return 1
        goldens[name] = {str(tick): digest for tick, digest in plain.items()}
        print(f"{name:<8} {plain[max(plain)]}")
    GOLDENS.write_text(json.dumps(goldens, indent=2) + "\n")
    return 0
