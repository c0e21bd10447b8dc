#!/usr/bin/env python3
"""Fuzzes what takes bytes from others: the decoders, the session of a client, and the settings.

    python scripts/fuzz.py [--inputs 10000000] [--seed 1] [--target client ...] [--keep] [--json OUT]

Inputs are changed copies of those of the corpus (tests/fuzz/corpus, small files) and of some that are well-formed. One
is added to those that are changed further when something new comes of it: another outcome or, in the inputs that are
traced (all of the first thousand, then one in 256, for tracing makes them ten times slower), a line of the project's
code that none has reached. --keep writes those to the corpus. Everything follows from the seed: a failure tells the
number of its input, and ends with 1.
"""

import argparse
import hashlib
import json
import random
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import Progress

import _mutate
from _targets import TARGETS, Target

ROOT = Path(__file__).resolve().parent.parent
CORPUS = ROOT / "tests" / "fuzz" / "corpus"
CODE = tuple(str(ROOT / part) for part in ("shared", "server"))
TRACED_FIRST, TRACED_EACH = 1000, 256
BATCH = 2000
KEPT_BYTES_MAX = 1024
"""Of what is new, only so small a file goes into the corpus."""

Figures = dict[str, Any]


class Traced:
    """Lines of the project's code that have been reached."""

    def __init__(self) -> None:
        self.lines: set[tuple[Any, int]] = set()

    def run(self, target: Target, data: bytes) -> tuple[str, bool]:
        """The outcome, and whether a new line was reached."""
        before = len(self.lines)
        sys.settrace(self._enter)
        try:
            told = target(data)
        finally:
            sys.settrace(None)
        return told, len(self.lines) > before

    def _enter(self, frame: FrameType, event: str, _: Any) -> Any:
        return self._line if frame.f_code.co_filename.startswith(CODE) else None

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            self.lines.add((frame.f_code, frame.f_lineno))
        return self._line


def fuzz(
    name: str, inputs: int, seed: int, *, corpus: Path = CORPUS, keep: bool = False, tick: Callable[[int], object] = id
) -> Figures:
    """One target; `tick` is told how many inputs there have been since it was told last. The figures.

    What goes wrong is told in `failure`, with the input in hexadecimal digits.
    """
    make, seeds, _ = TARGETS[name]
    target, rng, trace = make(), random.Random(f"{seed} {name}"), Traced()
    folder = corpus / name
    known = [path.read_bytes() for path in sorted(folder.glob("*"))] if folder.is_dir() else []
    pool = [*seeds, *known]
    given = len(pool)
    outcomes: dict[str, int] = {}
    started, found, failure = time.process_time(), 0, ""
    done, data = 0, b""
    try:
        while done < inputs:
            data = pool[done] if done < given else _mutate.mutated(rng.choice(pool), pool, rng)
            if done < TRACED_FIRST or done % TRACED_EACH == 0:
                told, new = trace.run(target, data)
            else:
                told, new = target(data), False
            done += 1
            if told not in outcomes:
                outcomes[told], new = 0, True
            outcomes[told] += 1
            if new and done > given:
                pool.append(data)
                found += 1
                if keep and len(data) <= KEPT_BYTES_MAX:
                    folder.mkdir(parents=True, exist_ok=True)
                    (folder / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
            if done % BATCH == 0:
                tick(BATCH)
    except Exception:
        failure = f"{name}, input {done} of seed {seed}: {data.hex()}\n{traceback.format_exc()}"
    cpu_s = time.process_time() - started
    return {
        "target": name,
        "inputs": done,
        "cpu_s": round(cpu_s, 2),
        "us_per_input": round(cpu_s / max(1, done) * 1e6, 2),
        "corpus": len(known),
        "new": found,
        "outcomes": len(outcomes),
        "lines": len(trace.lines),
        "failure": failure,
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--inputs", type=int, default=200_000, metavar="N", help="in all (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="only this one; may be repeated")
    parser.add_argument("--keep", action="store_true", help="write what is new to the corpus")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the figures to this file")
    args = parser.parse_args(argv)
    console = Console()
    wanted = {name: TARGETS[name][2] for name in args.target or TARGETS}
    figures = []
    with Progress(console=console, disable=not console.is_terminal) as progress:
        for name, share in wanted.items():
            n = args.inputs * share // sum(wanted.values())
            task = progress.add_task(name, total=n)
            found = fuzz(name, n, args.seed, keep=args.keep, tick=partial(progress.advance, task))
            figures.append(found)
            shown = "  ".join(f"{key} {value}" for key, value in found.items() if key != "failure")
            console.print(shown, highlight=False, soft_wrap=True)
            if found["failure"]:
                console.print(found["failure"], style="red", highlight=False, markup=False, soft_wrap=True)
    if args.json is not None:
        args.json.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
    return int(any(found["failure"] for found in figures))


if __name__ == "__main__":
    sys.exit(main())
