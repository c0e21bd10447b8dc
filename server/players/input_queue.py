"""The input queue: the inputs of one player by tick, from their arrival until they are used.

Theory of operation. Exactly one input is taken per tick. If the player's own input has not arrived, the last known one
is repeated for some ticks (`Bounds.repeats`); after that the neutral input is used. An input that arrives after its
tick was computed does not change that tick, but it is the one that is repeated from then on. A client may say that an
input holds for some ticks (`Held`): then none is missing in them, and a later input for one of them still counts.
It holds for as long as it would be repeated, so a client that falls silent stops as soon. With each snapshot the client
gets two lists: the arrival margin of each message, and the input status of each tick (its own input, a repeated one,
the neutral one, or none expected yet). From these it controls how far ahead it sends.
"""

import math
import sys
from array import array
from collections.abc import Callable
from functools import lru_cache

from shared.bounds import Bounds, bounds
from shared.fields import FIRST_MAX, INPUT_ROW_BYTES
from shared.inputs import NEUTRAL, Input, clamp, unpacked
from shared.messages import IDLE, MARGIN_REFUSED, NEUTRALISED, REPEATED, USED, Held, Inputs

DEFAULT = bounds(32)
"""Bounds of the default tick rate, 32 Hz."""
assert sys.byteorder == "little", "margins lie in memory as they go over the wire"


@lru_cache(4096)
def decoded(row: bytes) -> Input:
    """Decodes and clamps an input. The cache helps because a key is held for many ticks, so most rows repeat."""
    return clamp(unpacked(row))


class InputQueue:
    """The inputs of one player. Exactly one is taken per tick, and its status is kept until it is sent.

    Args:
        bounds: bounds for the scene's tick rate.
        row_bytes: length of one input in a message, `Scene.input_row_bytes`.
    """

    unrecorded: dict[int, tuple[int, Input]] | None = None
    """At an edge: statuses and inputs of the ticks whose records have not come, by tick."""
    sent: Input | None = None
    """At an edge: the input in the latest batch that had one."""

    def __init__(self, bounds: Bounds = DEFAULT, row_bytes: int = INPUT_ROW_BYTES) -> None:
        self._bounds, self._row_bytes = bounds, row_bytes
        self._margin_one = bounds.margin_one
        self.waiting: dict[int, Input] = {}
        """Inputs for later ticks, by tick, at most `bounds.ahead` ticks ahead."""
        self.held = NEUTRAL
        """The input that is repeated: the newest one used or late."""
        self.missing = 0
        """Number of ticks since an input was used or arrived late."""
        self.held_to = -1
        """Last tick for which the client has said that the input before holds."""
        self.accepted = -1
        """Newest tick of which an input was accepted."""
        self.first = self.newest = -1
        self.margins = array("h")
        """Arrival margins that are not sent yet, in the units of the wire; the last one is that of `newest`. At most
        `bounds.statuses` of them."""
        self.statuses = bytearray()
        """Input statuses of the ticks that are not sent yet, as on the wire. At most `bounds.statuses` of them."""
        self._used = self._late = self._substituted = self._refused = 0
        self.settle: Callable[[], None] | None = None
        """Adds the counts of the fast path to those here; None: the queue is not on it."""
        self.override: Input | None = None
        """Input of an in-process player. If it is set, it is used in every tick and queued inputs are ignored."""

    @property
    def used(self) -> int:
        """Number of ticks in which the player's own input was used."""
        self._settle()
        return self._used

    @used.setter
    def used(self, n: int) -> None:
        self._used = n

    @property
    def late(self) -> int:
        """Number of inputs that arrived after their tick."""
        self._settle()
        return self._late

    @late.setter
    def late(self, n: int) -> None:
        self._late = n

    @property
    def substituted(self) -> int:
        """Number of ticks in which another input stood in for a missing one."""
        self._settle()
        return self._substituted

    @substituted.setter
    def substituted(self, n: int) -> None:
        self._substituted = n

    @property
    def refused(self) -> int:
        """Number of inputs that were not accepted."""
        self._settle()
        return self._refused

    @refused.setter
    def refused(self, n: int) -> None:
        self._refused = n

    def _settle(self) -> None:
        if self.settle is not None:
            self.settle()

    def file(self, message: Inputs, tick: int, ahead: float) -> None:
        """Queues the inputs of a message.

        Args:
            message: the message.
            tick: the newest tick that has been computed.
            ahead: ticks until the next tick's deadline, with a fraction.
        """
        at, _, rows = message
        row_bytes = self._row_bytes
        for start in range(0, len(rows), row_bytes):
            if at <= self.accepted:  # a duplicate, or an order that TCP cannot produce
                self._refused += 1
            else:
                self._reach(at)
                self.margins.append(self._filed(at, rows[start : start + row_bytes], tick, ahead))
            at += 1
        if len(self.margins) > self._bounds.statuses:
            del self.margins[: -self._bounds.statuses]

    def hold(self, message: Held, tick: int, ahead: float) -> None:
        """Notes that the client's latest input holds for some ticks. The first of them gets a margin, like an input.

        It is refused if the message before it was, because the server lacks the input that it means.

        Args:
            message: the message.
            tick: the newest tick that has been computed.
            ahead: ticks until the next tick's deadline, with a fraction.
        """
        at = self.newest + message.after
        if at > FIRST_MAX:
            self._refused += 1
            return
        known = 0 <= self.accepted == self.newest
        self._reach(at)
        if not known or at > tick + self._bounds.ahead:
            self._refused += 1
            self.margins.append(MARGIN_REFUSED)
            return
        self.accepted, end = at, at + self._bounds.repeats
        if at <= tick:  # late, but for the ticks for which an earlier message has said it
            self._late += max(min(tick, end) - max(at, self.held_to + 1) + 1, 0)
            self.missing = 0
        self.held_to = max(self.held_to, end)
        self.margins.append(self._margin(at, tick, ahead))
        del self.margins[: -self._bounds.statuses]

    def restart(self, at: int) -> None:
        """Removes the unused inputs for tick `at` and later, because the client is going to send them again."""
        if self.first < 0 or at > self.newest:
            return
        for tick in [tick for tick in self.waiting if tick >= at]:
            del self.waiting[tick]
        self.accepted = min(self.accepted, at - 1)
        self._forget(at)

    def _forget(self, at: int) -> None:
        """Removes the margins of tick `at` and later, so that `newest` is `at - 1` again."""
        del self.margins[max(len(self.margins) - (self.newest - at + 1), 0) :]
        self.first, self.newest = min(self.first, at), at - 1

    def _reach(self, at: int) -> None:
        """Makes `at` the newest tick, whose margin comes next."""
        if at <= self.newest:  # it was refused before because it came too early
            self._forget(at)
        elif self.first < 0 or at > self.newest + 1:
            self._skipped(at)
        self.newest = at

    def _filed(self, at: int, row: bytes, tick: int, ahead: float) -> int:
        """Queues the input for the tick `at` if that is not too far ahead. Returns its margin in units of the wire."""
        if at > tick + self._bounds.ahead:
            self._refused += 1
            return MARGIN_REFUSED
        self.accepted = at
        self.held_to = min(self.held_to, at - 1)
        if at > tick:
            self.waiting[at] = decoded(row)
        else:
            self._late += 1
            self.held, self.missing = decoded(row), 0
        return self._margin(at, tick, ahead)

    def _margin(self, at: int, tick: int, ahead: float) -> int:
        """Returns the margin of an input that arrives now for the tick `at`, in units of the wire."""
        margin = math.floor((at - tick - 1 + ahead) * self._margin_one)
        if at <= tick:
            margin = min(margin, -1)
        return margin if abs(margin) < -MARGIN_REFUSED else max(MARGIN_REFUSED + 1, min(margin, -MARGIN_REFUSED - 1))

    def _skipped(self, at: int) -> None:
        """Handles the first input, or a gap before tick `at`: each left-out tick gets a margin of `MARGIN_REFUSED`.

        The client assigns margins to ticks by counting back from the newest, so no tick between two margins may be left
        out.
        """
        if self.first < 0:
            self.first = at
        elif self.margins or at > self.held_to + 1:
            self.margins.extend([MARGIN_REFUSED] * min(at - self.newest - 1, self._bounds.statuses))

    def coming(self, tick: int) -> Input:
        """Returns the input that `take` would take for a tick now. Changes nothing."""
        if self.override is not None:
            return self.override
        input_ = self.waiting.get(tick)
        if input_ is not None:
            return input_
        holds = self.first < 0 or tick < self.first or tick <= self.held_to
        return self.held if holds or self._bounds.stands_in(self.missing + 1) else NEUTRAL

    def take(self, tick: int) -> Input:
        """Takes the input for the tick that is about to be computed, or a substitute, and notes the input status."""
        if self.override is not None:
            self._used += 1
            return self.override
        input_ = self.waiting.pop(tick, None)
        if input_ is not None:
            status, self.missing, self.held = USED, 0, input_
            self._used += 1
        elif self.first < 0 or tick < self.first:
            status = IDLE
        elif tick <= self.held_to:
            status, self.missing = USED, self._bounds.repeats
            self._used += 1
        else:
            self.missing += 1
            self._substituted += 1
            status = REPEATED if self._bounds.stands_in(self.missing) else NEUTRALISED
        self.statuses.append(status)
        if len(self.statuses) > self._bounds.statuses:
            del self.statuses[0]
        return NEUTRAL if status == NEUTRALISED else self.held

    def take_feedback(self) -> tuple[bytes, bytes]:
        """Takes the margins and statuses for the next snapshot, as on the wire. They count as sent."""
        margins, statuses = self.margins.tobytes(), bytes(self.statuses)
        del self.margins[:]
        self.statuses.clear()
        return margins, statuses
