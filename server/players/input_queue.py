"""The inputs of one player: exactly one is taken per tick."""

import math
import struct
import sys
from array import array
from functools import lru_cache

from shared.bounds import Bounds, bounds
from shared.inputs import NEUTRAL, Input, clamp
from shared.messages import IDLE, INPUT_ROW_BYTES, MARGIN_REFUSED, NEUTRALISED, REPEATED, USED, Inputs

INPUT_ROW = struct.Struct("<bbB")
DEFAULT = bounds(32)
"""Bounds of the default tick rate, 32 Hz."""
assert sys.byteorder == "little", "margins lie in memory as they go over the wire"


@lru_cache(4096)
def _wish(row: bytes) -> Input:
    """A row as an input that is allowed. Hands hold keys for longer than a tick: most rows have been seen before."""
    return clamp(Input(*INPUT_ROW.unpack(row)))


class InputQueue:
    """The inputs of one player: exactly one is taken per tick, and each one's fate is kept until it is sent.

    Args:
        bounds: those of the scene's tick rate.
    """

    def __init__(self, bounds: Bounds = DEFAULT) -> None:
        self._bounds = bounds
        self._margin_one = bounds.margin_one
        self._waiting: dict[int, Input] = {}  # by tick, at most `bounds.ahead` ahead
        self._held = NEUTRAL  # the latest to arrive whose tick has come
        self._missing = 0  # ticks since anything has arrived
        self._accepted = -1  # the newest tick of which an input was not refused
        self.first = self.newest = -1
        self.margins = array("h")
        """As they go over the wire, up to that of `newest`; at most `bounds.fates`, like the fates."""
        self.fates = bytearray()
        self.late = self.refused = self.used = self.substituted = 0
        self.wheel: Input | None = None
        """What is taken in every tick, whatever comes: of a player who is inside the server."""

    def file(self, message: Inputs, tick: int, ahead: float) -> None:
        """Takes a message at tick `tick`; the next tick's deadline is `ahead` ticks away."""
        at, _, rows = message
        for start in range(0, len(rows), INPUT_ROW_BYTES):
            if at <= self._accepted:  # a duplicate, or an order that TCP cannot produce
                self.refused += 1
            else:
                if at <= self.newest:  # it was refused before, for coming too early
                    self._forget(at)
                elif self.first < 0 or at > self.newest + 1:
                    self._skipped(at)
                self.newest = at
                self.margins.append(self._filed(at, rows[start : start + INPUT_ROW_BYTES], tick, ahead))
            at += 1
        if len(self.margins) > self._bounds.fates:
            del self.margins[: -self._bounds.fates]

    def restart(self, at: int) -> None:
        """Withdraws the inputs for tick `at` and later that have not been used: the client sends them anew."""
        if self.first < 0 or at > self.newest:
            return
        for tick in [tick for tick in self._waiting if tick >= at]:
            del self._waiting[tick]
        self._accepted = min(self._accepted, at - 1)
        self._forget(at)

    def _forget(self, at: int) -> None:
        """Counts margins off from tick `at - 1` again."""
        del self.margins[max(len(self.margins) - (self.newest - at + 1), 0) :]
        self.first, self.newest = min(self.first, at), at - 1

    def _filed(self, at: int, row: bytes, tick: int, ahead: float) -> int:
        """Files the input for the tick `at`; its margin."""
        if at > tick + self._bounds.ahead:
            self.refused += 1
            return MARGIN_REFUSED
        self._accepted = at
        margin = math.floor((at - tick - 1 + ahead) * self._margin_one)
        if at > tick:
            self._waiting[at] = _wish(row)
        else:
            self.late += 1
            self._held, self._missing = _wish(row), 0
            margin = min(margin, -1)
        return margin if abs(margin) < -MARGIN_REFUSED else max(MARGIN_REFUSED + 1, min(margin, -MARGIN_REFUSED - 1))

    def _skipped(self, at: int) -> None:
        """The tick `at` is the first, or some before it are left out: each gets a margin, to count them off by."""
        if self.first < 0:
            self.first = at
        else:
            self.margins.extend([MARGIN_REFUSED] * min(at - self.newest - 1, self._bounds.fates))

    def take(self, tick: int) -> Input:
        """The input for a tick whose time has come."""
        if self.wheel is not None:
            self.used += 1
            return self.wheel
        wish = self._waiting.pop(tick, None)
        if wish is not None:
            fate, self._missing, self._held = USED, 0, wish
            self.used += 1
        elif self.first < 0 or tick < self.first:
            fate = IDLE
        else:
            self._missing += 1
            self.substituted += 1
            fate = REPEATED if self._missing <= self._bounds.repeats else NEUTRALISED
        self.fates.append(fate)
        if len(self.fates) > self._bounds.fates:
            del self.fates[0]
        return NEUTRAL if fate == NEUTRALISED else self._held

    def told(self) -> tuple[bytes, bytes]:
        """Margins and fates as they go over the wire, which count as sent."""
        margins, fates = self.margins.tobytes(), bytes(self.fates)
        del self.margins[:]
        self.fates.clear()
        return margins, fates
