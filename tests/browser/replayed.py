"""Plays a tape (`taped.py`) again and returns what came of it, as a table of texts and numbers.

    python -m tests.browser.replayed TAPE [behaves] [--no-numpy]

It uses the client alone, so it runs natively, without numpy, and in a browser.
"""

import hashlib
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

if "--no-numpy" in sys.argv:
    sys.modules["numpy"] = None  # type: ignore[assignment]

import msgpack

from sovereign_netcode.client_sdk.core import Core
from sovereign_netcode.client_sdk.view import View
from sovereign_netcode.shared.inputs import Input

SAME = (
    "sent", "bytes", "views", "drawn", "events", "state", "confirmed", "predicted", "corrections", "by_cause",
    "replayed", "divergences",
)  # fmt: skip
"""Names of the results that must be the same everywhere."""


class Tape(NamedTuple):
    """A tape, and whether its scene has the behaviours of `tests.acrobat`."""

    data: bytes
    behaves: bool


def replayed(
    tape: bytes, behaviours: Iterable[Any] = (), clock: Callable[[], float] = time.process_time
) -> dict[str, Any]:
    """Plays a tape again.

    Args:
        tape: the tape.
        behaviours: the classes of the game's behaviours.
        clock: returns the CPU time so far, in seconds.

    Returns:
        Checksums of all messages sent, of all views and of both worlds; events by type; corrections and replays; and
        the CPU time of the calls.
    """
    core = Core("taped", behaviours=behaviours, patience_s=10.0)
    sent, drawn = hashlib.sha256(), hashlib.sha256()
    bytes_sent = views = 0
    took: dict[str, list[float]] = {"update": [], "receive": [], "view": []}
    for name, *arguments in msgpack.unpackb(tape):
        began = clock()
        if name == "set_input":
            x, y, buttons, aim = arguments[0]
            core.set_input(Input(x, y, buttons, tuple(aim)))
        elif name == "trying":
            core.reconnect.trying()
        elif name == "outgoing":
            for message in core.outgoing():
                sent.update(message)
                bytes_sent += len(message)
        else:
            result = getattr(core, name)(*arguments)
            if name in took:
                took[name].append(clock() - began)
            if name == "view":
                drawn.update(repr(plain(result)).encode())
                views += 1
    prediction = core.prediction
    assert prediction is not None
    return {
        "sent": sent.hexdigest(),
        "bytes": bytes_sent,
        "views": views,
        "drawn": drawn.hexdigest(),
        "events": dict(sorted(Counter(type(event).__name__ for event in core.events()).items())),
        "state": core.state,
        "confirmed": prediction.confirmed.state_hash().hex(),
        "predicted": prediction.predicted.state_hash().hex(),
        "corrections": core.stats.corrections,
        "by_cause": dict(sorted(core.stats.corrections_by_cause.items())),
        "replayed": core.stats.replayed_ticks,
        "divergences": core.stats.divergences,
        "kernel": core.stats.kernel,
        "numpy": sys.modules.get("numpy") is not None,
        "ms": {name: figures(each) for name, each in took.items()},
    }


def figures(seconds: list[float]) -> list[float]:
    """Returns mean, median and 99th percentile in milliseconds."""
    ordered = sorted(seconds)
    n = len(ordered)
    return [1000 * each for each in (sum(ordered) / n, ordered[n // 2], ordered[n * 99 // 100])]


def plain(view: View) -> list[Any]:
    """Returns a view as lists of numbers and texts."""
    entities = [
        (
            each.entity, each.template, each.position, each.velocity, sorted(each.attributes.items()),
            sorted(each.fields.items()), each.facing,
        )
        for each in view.figures
    ]  # fmt: skip
    return [view.tick, view.seen, entities]


def main() -> None:
    classes: Iterable[Any] = ()
    if "behaves" in sys.argv:
        from tests.acrobat import CLASSES

        classes = CLASSES
    print(json.dumps(replayed(Path(sys.argv[1]).read_bytes(), classes)))


if __name__ == "__main__":
    main()
