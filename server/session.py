"""One client as the server knows it: its inputs and their fates on one side, what it has been sent on the other."""

import math
import struct
from collections import deque
from typing import Protocol

from server.pacing import Pacing
from server.sight import Sight
from shared.checks import Cell
from shared.inputs import NEUTRAL, Input, clamp
from shared.messages import (
    AHEAD_MAX,
    FATES_MAX,
    IDLE,
    INPUT_ROW_BYTES,
    MARGIN_ONE,
    MARGIN_REFUSED,
    NEUTRALISED,
    REPEATED,
    REPEATS_MAX,
    USED,
    Command,
    Inputs,
)
from shared.ring import Ring

INPUT_ROW = struct.Struct("<bbB")


class Link(Protocol):
    """What a session needs of a transport."""

    def send(self, message: bytes) -> None:
        """Queues one message; never blocks."""

    def outstanding(self) -> int:
        """Bytes handed over that the peer has not yet acknowledged."""
        ...

    def close(self, code: int, reason: str) -> None:
        """Closes once what was sent has gone out."""


class InputQueue:
    """The inputs of one player: exactly one is taken per tick, and each one's fate is kept until it is told."""

    def __init__(self) -> None:
        self._ring: Ring[Input] = Ring(AHEAD_MAX + 1)
        self._held = NEUTRAL  # the latest to arrive whose tick has come
        self._missing = 0  # ticks since anything has arrived
        self.first = self.newest = -1
        self.margins: deque[int] = deque(maxlen=FATES_MAX)
        self.fates: deque[int] = deque(maxlen=FATES_MAX)
        self.late = self.refused = self.used = self.substituted = 0

    def file(self, message: Inputs, tick: int, ahead: float) -> None:
        """Takes a message at tick `tick`; the next tick's deadline is `ahead` ticks away."""
        first, rows = message.first, message.rows
        count = len(rows) // INPUT_ROW_BYTES
        known = min(max(self.newest + 1 - first, 0), count)  # duplicates, or an order that TCP cannot produce
        usable = min(max(tick + AHEAD_MAX + 1 - first, known), count)
        self.refused += known + count - usable
        for i in range(known, usable):
            at = first + i
            self._reached(at)
            wish = clamp(Input(*INPUT_ROW.unpack_from(rows, i * INPUT_ROW_BYTES)))
            margin = math.floor((at - tick - 1 + ahead) * MARGIN_ONE)
            if at <= tick:
                self.late += 1
                self._held, self._missing = wish, 0
                margin = min(margin, -1)
            else:
                self._ring.put(at, wish)
            self.margins.append(max(MARGIN_REFUSED + 1, min(margin, -MARGIN_REFUSED - 1)))
        if usable < count:
            self._reached(message.first + usable)
            self.margins.extend([MARGIN_REFUSED] * (count - usable))
            self.newest = message.first + count - 1

    def _reached(self, at: int) -> None:
        """`at` is the newest from here on: ticks left out get a margin each, so that they can be counted off."""
        if self.newest < 0:
            self.first = at
        elif at > self.newest + 1:
            self.margins.extend([MARGIN_REFUSED] * min(at - self.newest - 1, FATES_MAX))
        self.newest = at

    def take(self, tick: int) -> Input:
        """The input for a tick whose time has come."""
        wish = self._ring.get(tick)
        if wish is not None:
            fate, self._missing, self._held = USED, 0, wish
            self.used += 1
        elif self.first < 0 or tick < self.first:
            fate = IDLE
        else:
            self._missing += 1
            self.substituted += 1
            fate = REPEATED if self._missing <= REPEATS_MAX else NEUTRALISED
        self.fates.append(fate)
        return NEUTRAL if fate == NEUTRALISED else self._held

    def told(self) -> None:
        """Margins and fates have been sent."""
        self.margins.clear()
        self.fates.clear()


class Session:
    """One connection, from the handshake to its end."""

    def __init__(self, number: int, link: Link, now: float) -> None:
        self.number = number
        self.link = link
        self.name = ""
        self.entity = 0
        """The player's entity; 0 before the client has joined."""
        self.opened = self.heard = self.sent_at = now
        self.allowance = 0.0
        self.joining = False
        self.closed = False
        self.inputs = InputQueue()
        self.acked = -1
        # What it has been sent:
        self.tick = -1
        self.snapshot_bytes = 0
        self.sight = Sight()
        self.terrain_due: deque[Cell] = deque()
        self.terrain_now: tuple[Cell, bytes, int] | None = None
        """The packed segment that is being sent, and how much of it has been."""
        self.commands: deque[Command] = deque()
        self.command = -1
        """The highest number of a command so far."""
        self.resynced_at = now
        self.verdicts: list[tuple[int, int]] = []
        self.edits_left = math.inf
        self.pacing = Pacing()
        self.sent_when: Ring[float] = Ring(FATES_MAX)
        """When snapshots were sent before which nothing was on the way."""
        self.skipped = 0

    def send(self, message: bytes) -> None:
        """Hands a message to the link."""
        self.pacing.sent(len(message))
        self.link.send(message)

    def close(self, code: int, reason: str) -> None:
        """Ends the connection; nothing is taken from it or sent to it any more."""
        if not self.closed:
            self.closed = True
            self.link.close(code, reason)
