"""Plays a tape (`taped.py`) again and returns what came of it, as a table of texts and numbers.

It uses the client alone, so it runs natively, without numpy, and in a browser.
"""

import hashlib
import sys
import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

import msgpack

from sovereign_netcode.client_sdk.core import Core
from sovereign_netcode.client_sdk.view import View
from sovereign_netcode.shared.inputs import Input


def replayed(tape: bytes, behaviours: Iterable[Any] = (), *, link: str = "", patience_s: float = 0.0) -> dict[str, Any]:
    """Plays a tape again.

    Args:
        tape: the tape.
        behaviours: the classes of the game's behaviours.
        link: the simulated link, for a tape whose core had one.
        patience_s: as for `Core`.

    Returns:
        Checksums of all messages sent, of all views and of both worlds; events by type; corrections and replays.
    """
    core = Core("taped", behaviours=behaviours, patience_s=patience_s)
    sent, drawn = hashlib.sha256(), hashlib.sha256()
    bytes_sent = views = 0
    events: Counter[str] = Counter()
    worst = spent = 0.0
    frames: list[float] = []
    for name, *arguments in msgpack.unpackb(tape):
        began = time.perf_counter()
        if name == "set_input":
            x, y, buttons, aim = arguments[0]
            core.set_input(Input(x, y, buttons, tuple(aim)))
        elif name == "trying":
            core.reconnect.trying()
        elif name == "outgoing":
            for message in core.outgoing():
                sent.update(message)
                bytes_sent += len(message)
        elif name == "view":
            drawn.update(repr(plain(core.view(*arguments))).encode())
            views += 1
        else:
            getattr(core, name)(*arguments)
        took = time.perf_counter() - began
        spent += took
        if name == "update":
            frames.append(took)
    for event in core.events():
        events[type(event).__name__] += 1
    prediction = core.prediction
    frames.sort()
    worst = frames[int(len(frames) * 0.99)] if frames else 0.0
    return {
        "sent": sent.hexdigest(),
        "bytes": bytes_sent,
        "views": views,
        "drawn": drawn.hexdigest(),
        "events": dict(sorted(events.items())),
        "state": core.state,
        "confirmed": prediction.confirmed.state_hash().hex() if prediction else "",
        "predicted": prediction.predicted.state_hash().hex() if prediction else "",
        "corrections": core.stats.corrections,
        "by_cause": dict(sorted(core.stats.corrections_by_cause.items())),
        "replayed": core.stats.replayed_ticks,
        "divergences": core.stats.divergences,
        "kernel": core.stats.kernel,
        "numpy": sys.modules.get("numpy") is not None,
        "seconds": spent,
        "update_p99_ms": 1000 * worst,
    }


def plain(view: View) -> list[Any]:
    """Returns a view as lists of numbers and texts."""
    drawn = [*view.others, *([view.me] if view.me else [])]
    entities = [
        (
            each.entity, each.template, each.position, each.velocity, sorted(each.attributes.items()),
            sorted(each.fields.items()), each.facing,
        )
        for each in drawn
    ]  # fmt: skip
    return [view.tick, view.seen, entities]


SAME = (
    "sent", "bytes", "views", "drawn", "events", "state", "confirmed", "predicted", "corrections", "by_cause",
    "replayed", "divergences",
)  # fmt: skip
"""Names of the results that must be the same everywhere."""
