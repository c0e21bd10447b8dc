#!/usr/bin/env python3
"""Writes tests/golden/physics.json, the hashes that the physics must reach.

Run it only for an intended change of the physics: every client must then be updated. The compiled and the plain
executor must agree on every hash first. It needs the environment of the repository: `.venv/bin/python`.
"""

import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

from shared import kernels  # noqa: E402
from tests.golden.scripts import SCRIPTS, run  # noqa: E402


def main() -> int:
    goldens = {}
    for name in SCRIPTS:
        plain = dict(run(name, compiled=False))
        if kernels.available() and dict(run(name, compiled=True)) != plain:
            print(f"{name}: compiled and plain Python differ; nothing was written", file=sys.stderr)
            return 1
        goldens[name] = {str(tick): digest for tick, digest in plain.items()}
        print(f"{name:<8} {plain[max(plain)]}")
    (ROOT / "tests" / "golden" / "physics.json").write_text(json.dumps(goldens, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
