"""Plays a tape (`taped.py`) again and returns what came of it, as a table of texts and numbers.

    python -m tests.browser.replayed TAPE [behaves] [--no-numpy]

It uses the client alone, so it runs natively, without numpy, and in a browser.
"""

import hashlib
import json
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

if "--no-numpy" in sys.argv:
    sys.modules["numpy"] = None  # type: ignore[assignment]

import msgpack

from sovereign_netcode.client_sdk.core import Core
from sovereign_netcode.client_sdk.drawn import Drawn
from sovereign_netcode.client_sdk.view import View
from sovereign_netcode.shared.blocks import BLOCKS, Blocks, unpack
from sovereign_netcode.shared.inputs import Input

SAME = (
    "sent", "bytes", "views", "drawn", "events", "state", "confirmed", "predicted", "corrections", "by_cause",
    "replayed", "divergences", "hits", "blocks",
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
        Checksums of all messages sent, of all views and of both worlds; events by type; corrections and replays; hits;
        and the CPU time of the calls.
    """
    core = Core("taped", behaviours=behaviours, patience_s=10.0)
    sent, drawn = hashlib.sha256(), hashlib.sha256()
    bytes_sent = views = 0
    now = 0.0
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
        now = arguments[-1] if name == "update" else now
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
        "hits": hits(core, now),
        "blocks": blocks(),
        "kernel": core.stats.kernel,
        "numpy": sys.modules.get("numpy") is not None,
        "ms": {name: figures(each) for name, each in took.items()},
    }


def hits(core: Core, now: float) -> list[Any]:
    """Returns the hits of some rays, and the entities in a box, among what a client draws."""
    view, scene, prediction = core.view(now), core.scene, core.prediction
    assert view.me is not None
    assert scene is not None
    assert prediction is not None
    drawn = Drawn(view, scene, prediction)
    x, y, z = view.me.position
    ways = [
        (a, b, c) for a in (-1.0, 0.0, 1.0) for b in (-0.7, 0.0, 1.0) for c in (-0.2, 0.0) if (a, b, c) != (0, 0, 0)
    ]
    ways += [tuple(b - a for a, b in zip((x, y, z), each.position, strict=True)) for each in view.others]  # type: ignore[misc]
    rays = [[list(hit) for hit in drawn.ray((x, y, z + 1.0), way, 40.0)] for way in ways]
    return [json.loads(json.dumps(rays)), drawn.box((x - 6, y - 6, z - 2), (x + 6, y + 6, z + 4))]


def blocks() -> list[str]:
    """Returns checksums of blocks that change, with and without kinds that are not solid, and what differs in a box."""
    made = []
    for passable in ((), (2, 7)):
        world, other = Blocks(passable), Blocks(passable)
        for at in (0, 1, 2):
            kinds = bytes((i * i + at) % 11 for i in range(BLOCKS))
            world.load((at, 0, 0), unpack(zlib.compress(kinds)))
        other.restore(world)
        world.set(33, 4, 5, 9)
        other.restore(world)
        different = other.different((28, 3, 2), (66, 6, 9), 9)
        made += [
            hashlib.sha256(repr((different, other.digest((1, 0, 0)), other.get(33, 4, 5))).encode()).hexdigest(),
            hashlib.sha256(other.solid.tobytes() + other.kinds.tobytes()).hexdigest(),
        ]
    return made


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
