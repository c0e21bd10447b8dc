"""One client as the server knows it: a `Player`, who may come back, and a `Session`, the connection of the moment."""

import math
import struct
import sys
from array import array
from collections import deque
from functools import lru_cache
from typing import Protocol

from server.outbox import Outbox
from server.pacing import Pacing
from server.sight import Sight
from shared.bounds import Bounds, bounds
from shared.checks import Cell
from shared.inputs import NEUTRAL, Input, clamp
from shared.messages import (
    IDLE,
    INPUT_ROW_BYTES,
    MARGIN_REFUSED,
    NEUTRALISED,
    REPEATED,
    USED,
    Command,
    Hello,
    Inputs,
)

INPUT_ROW = struct.Struct("<bbB")
DEFAULT = bounds(32)
SETTLED_MAX = 128
assert sys.byteorder == "little", "margins lie in memory as they go over the wire"


class Link(Protocol):
    """What a session needs of a transport."""

    def send(self, message: bytes) -> None:
        """Queues one message; never blocks."""

    def outstanding(self) -> int | None:
        """Bytes handed over that the peer's system has not yet acknowledged; None: nobody can tell."""
        ...

    def close(self, code: int, reason: str) -> None:
        """Closes once what was sent has gone out."""


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


class Player:
    """Somebody who plays: stays while the entity stays, whatever becomes of the connection.

    Args:
        entity: the player's own.
        name: what it calls itself.
        subject: whose token it showed; empty where none is asked for.
        bounds: those of the scene's tick rate.
    """

    def __init__(self, entity: int, name: str = "", subject: str = "", bounds: Bounds = DEFAULT) -> None:
        self.entity = entity
        self.name = name
        self.subject = subject
        self.announced = True
        """Whether the rules have been told of the join."""
        self.inputs = InputQueue(bounds)
        self.commands: deque[Command] = deque()
        """Those that wait for their tick."""
        self.command = -1
        """The highest number of a command so far."""
        self.verdicts: list[tuple[int, int]] = []
        """Number and verdict of commands, to be told."""
        self.settled: dict[int, int] = {}
        """The latest verdicts: who was cut off before hearing one asks again, and is told the same."""
        self.edits_left = math.inf
        self.tokens: list[bytes] = []
        """Digests of the tokens with which to come back: the newest, and the one before until that has been heard."""
        self.away_until = math.inf
        """While there is no connection: when the entity goes."""
        self.session: Session | None = None
        self.outbox = Outbox()
        """What the rules have sent, to be told."""

    def __repr__(self) -> str:
        return f"<Player {self.name!r}, entity {self.entity}>"

    def heard(self) -> None:
        """The client has got its newest token: it may throw away the one before, and so is that one worth nothing."""
        del self.tokens[:-1]

    def settle(self, number: int, verdict: int) -> None:
        """A command has been carried out, or not."""
        self.verdicts.append((number, verdict))
        self.settled[number] = verdict
        if len(self.settled) > SETTLED_MAX:
            del self.settled[next(iter(self.settled))]


class Session:
    """One connection, from the handshake to its end."""

    def __init__(self, link: Link, now: float) -> None:
        self.link = link
        self.player: Player | None = None
        self.entity = 0
        """The player's entity; 0 before the client has joined."""
        self.inputs = InputQueue()
        """The player's."""
        self.hello: Hello | None = None
        """With which it waits to join."""
        self.greeting: tuple[int, bytes] | None = None
        """Its welcome, and the tick from which on it may be sent: when the token in it is on disk."""
        self.subject = ""
        self.opened = self.heard = self.sent_at = now
        self.allowance = 0.0
        self.closed = False
        self.acked = -1
        # What it has been sent:
        self.tick = -1
        self.snapshot_bytes = 0
        self.gaps: tuple[tuple[int, int], ...] = ()
        """Pairs of ticks that followed each other in its snapshots with others between, as long as a shot may ask."""
        self.sight = Sight()
        self.terrain_due: deque[Cell] = deque()
        self.terrain_now: tuple[Cell, bytes, int] | None = None
        """The packed segment that is being sent, and how much of it has been."""
        self.shared = 0
        """The version of the game's shared values that it has been sent, or that waits:"""
        self.shared_due = b""
        """The message with the shared values that goes behind the next snapshot; empty: there is none."""
        self.resynced_at = now
        self.pacing = Pacing(link.outstanding)
        self.probe: tuple[int, float, int] | None = None
        """A snapshot before which nothing was on the way: its tick, when it was sent, its bytes."""
        self.corrections = -1
        """As the client has reported them; -1: not yet."""

    def seat(self, player: Player) -> None:
        """This connection is the player's from now on."""
        self.player, self.entity, self.inputs = player, player.entity, player.inputs
        player.session, player.away_until = self, math.inf
        del player.verdicts[:-SETTLED_MAX]  # who comes back time and again without reading must not pile them up
        self.hello = None

    def vacate(self) -> None:
        """Undoes `seat`."""
        if self.player is not None:
            self.player.session = None
        self.player, self.entity, self.inputs = None, 0, InputQueue()

    def send(self, message: bytes) -> None:
        """Hands a message to the link."""
        self.pacing.sent_bytes += len(message)
        self.link.send(message)

    def close(self, code: int, reason: str) -> None:
        """Ends the connection; nothing is taken from it or sent to it any more."""
        if not self.closed:
            self.closed = True
            self.link.close(code, reason)
