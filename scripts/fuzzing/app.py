"""Fuzzes the code that takes bytes from outside: the decoders, a client's session, and the settings.

    python scripts/fuzz.py [--inputs 10000000] [--seed 1] [--target client ...] [--keep] [--json OUT]

Inputs are changed copies of the corpus (tests/fuzz/corpus, small files) and of some well-formed messages. An input with
a new result joins the pool of inputs to change. A result is new if its outcome is, or if a traced input reaches a line
of the project's code that none has reached. The first thousand inputs are traced, then one in 256, because tracing
takes ten times as long. --keep writes inputs with new results to the corpus. Everything depends on the seed only. A
failure is reported with the number of its input. Exits with 1 if there was a failure.
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

from scripts.environment import ROOT
from scripts.fuzzing import mutate
from scripts.fuzzing.targets import TARGETS, Target

CORPUS = ROOT / "tests" / "fuzz" / "corpus"
CODE = tuple(str(ROOT / part) for part in ("shared", "server"))
TRACED_FIRST, TRACED_EACH = 1000, 256
BATCH = 2000
KEPT_BYTES_MAX = 1024
"""Largest input, in bytes, that --keep writes to the corpus."""

Figures = dict[str, Any]


class Traced:
    """The lines of the project's code that have been reached."""

    def __init__(self) -> None:
        self.lines: set[tuple[Any, int]] = set()

    def run(self, target: Target, data: bytes) -> tuple[str, bool]:
        """Runs a target. Returns the outcome, and whether it reached a new line."""
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
    """Fuzzes one target. Returns the figures; "failure" is empty, or describes a failure with the input in hexadecimal.

    Args:
        name: the target (`TARGETS`).
        inputs: number of inputs.
        corpus: folder of the corpus.
        keep: whether to write inputs with new results to the corpus.
        tick: called from time to time with the number of inputs since the last call.
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
            data = pool[done] if done < given else mutate.mutated(rng.choice(pool), pool, rng)
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
    parser.add_argument(
        "--inputs", type=int, default=200_000, metavar="N", help="number of inputs (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parser.add_argument(
        "--target", action="append", choices=sorted(TARGETS), help="fuzz only this target; may be repeated"
    )
    parser.add_argument("--keep", action="store_true", help="write inputs with new results to the corpus")
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
