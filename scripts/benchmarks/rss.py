"""`bench.py memory` over sockets: the memory (RSS) of a server process, per connection and under churn.

RSS includes the sockets' buffers in Python, the event loop and the allocator's reserves. It does not include the
kernel's memory for a socket.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

from scripts.benchmarks import server

FEW, MANY = 200, 400
HOLD_S = 3.0
CHURN_CLIENTS = 100
LEAVING_PER_S = 10.0
MARGIN = 6
"""Segments between the players and the segment that is unloaded and loaded."""
SETTLE_S = 30.0
"""Seconds of churn until the number of entities is steady: half of the clients leave without a message, and the server
keeps their entities for a while."""
SAMPLE_S = 5.0
COUNTS = ("joined", "left", "spawned", "removed", "segments_loaded")
LEVELS = ("clients", "players", "entities", "segments")
Figures = dict[str, Any]


def connections(rounds: int) -> list[float]:
    """Returns the bytes of RSS per client with its entity, once per round: the slope from `FEW` to `MANY` clients."""
    found = []
    for seed in range(1, rounds + 1):
        with server.rig("game", seed=seed, capacity=MANY) as running:
            few, many = (running.hold(clients, HOLD_S) for clients in (FEW, MANY))
        found.append((many["rss_mb"] - few["rss_mb"]) * 1e6 / (MANY - FEW))
    return found


def churn(minutes: float, told: Callable[[Figures], None]) -> Figures:
    """Measures a server in which clients, entities and segments come and go.

    Args:
        minutes: length of the measurement.
        told: called with the figures of each minute, and with those at the end.
    """
    with server.rig("churn", capacity=CHURN_CLIENTS, margin=MARGIN) as running:
        running.hold(CHURN_CLIENTS, 1.0)
        running.leaving(LEAVING_PER_S)
        time.sleep(SETTLE_S)
        first = now = running.stats()
        began = time.monotonic()
        samples: list[tuple[float, float]] = [(0.0, first["rss_mb"])]
        at_minutes: list[Figures] = []
        while True:
            minute = (time.monotonic() - began) / 60
            if minute >= min(len(at_minutes), minutes):
                at_minutes.append(sample(first, now, minute))
                told(at_minutes[-1])
            if minute >= minutes:
                break
            time.sleep(min(SAMPLE_S, 60 * (minutes - minute)))
            now = running.stats()
            samples.append(((time.monotonic() - began) / 60, now["rss_mb"]))
    return {
        "minutes": at_minutes,
        "slope_kb_per_minute": slope(samples),
        "slope_kb_per_minute_second_half": slope(samples[len(samples) // 2 :]),
        "rss_mb": samples,
        "rules_failed": now["rules_failed"],
        "internal_errors": now["internal_errors"],
    }


def sample(first: Figures, now: Figures, minute: float) -> Figures:
    """Returns the current numbers, and how many entities, clients and segments have come and gone since `first`."""
    levels = {name: now[name] for name in ("rss_mb", *LEVELS)}
    return {"minute": round(minute, 2)} | levels | {name: now[name] - first[name] for name in COUNTS}


def slope(samples: list[tuple[float, float]]) -> float:
    """Returns the slope of (minute, MB) samples in KB per minute, by least squares."""
    minutes, mb = zip(*samples, strict=True)
    return statistics.linear_regression(minutes, mb).slope * 1e3
