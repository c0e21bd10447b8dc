"""Time limits that client and server must agree on, in ticks for a tick rate.

Each limit is a time, so that a game at 240 ticks per second bears the same delays as one at 20. A minimum in ticks
keeps scenes of a few ticks per second playable.
"""

import math
from functools import lru_cache
from typing import NamedTuple

AHEAD_S = 2.0
"""The server refuses inputs and commands for ticks further ahead than this, in seconds."""
REPEATS_S = 0.3125
"""The latest input stands in for missing ones for at most this long, in seconds."""
HISTORY_S = 2.0
"""The server keeps changes for this long, and a client follows motion that long without a snapshot, in seconds."""
STATUSES_S = 8.0
"""The server keeps input statuses and margins that it could not send for this long, in seconds."""
UNCONFIRMED_S = 4.0
"""A client predicts at most this far beyond the newest snapshot, in seconds."""
UPDATE_S = 1.5
"""A client catches up on at most this much time in one update, in seconds; after a longer pause it starts the
prediction again."""
PREDICTED_S = 6.0
"""A client keeps its own inputs and predicted states for this long, in seconds."""
MARGINS_PER_S = 8192
"""Unit of a margin on the wire, as parts of a second; so an i16 holds 4 s at every tick rate."""
TICK_RATE_MAX = 240
"""Highest tick rate of a scene, per second."""

assert AHEAD_S < UNCONFIRMED_S, "a client that waits for snapshots has sent all that the server takes"
assert UNCONFIRMED_S + REPEATS_S < PREDICTED_S, "a replay finds the inputs it starts from"
assert UPDATE_S <= AHEAD_S, "the inputs of one update are accepted"


class Bounds(NamedTuple):
    """The time limits in ticks, for one tick rate; `bounds(rate)` returns them."""

    ahead: int
    repeats: int
    history: int
    statuses: int
    unconfirmed: int
    update: int
    predicted: int
    margin_one: float
    """Value on the wire of a margin of one tick: `MARGINS_PER_S` divided by the tick rate."""

    def stands_in(self, missing: int) -> bool:
        """Returns whether the latest input stands in for a missing one; if not, `NEUTRAL` does.

        Server and client use the same substitutes, so that a client predicts what the server will use.

        Args:
            missing: number of ticks without an input since the latest input, including this one.
        """
        return missing <= self.repeats


def in_ticks(seconds: float, rate: float, least: int) -> int:
    """Returns a time as a whole number of ticks, rounded up, at least `least`."""
    return max(math.ceil(seconds * rate), least)


@lru_cache
def bounds(rate: int) -> Bounds:
    """Returns the limits for a tick rate (ticks per second)."""
    return Bounds(
        ahead=in_ticks(AHEAD_S, rate, 8),
        repeats=in_ticks(REPEATS_S, rate, 2),
        history=in_ticks(HISTORY_S, rate, 8),
        statuses=in_ticks(STATUSES_S, rate, 64),
        unconfirmed=in_ticks(UNCONFIRMED_S, rate, 16),
        update=in_ticks(UPDATE_S, rate, 8),
        predicted=in_ticks(PREDICTED_S, rate, 32),
        margin_one=MARGINS_PER_S / rate,
    )
