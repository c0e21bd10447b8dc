"""The parts of a world on many processes in simulated time: the bus with its log, sequencer, edges and standbys."""

import random
from collections.abc import Callable
from typing import TYPE_CHECKING

from server.config.limits import Limits
from server.scale.clock import EdgeClock
from server.scale.edge import EdgeServer
from server.scale.replica import GapError, Replica
from server.scale.sequencer import WorldSequencer
from server.scale.wire import Batch, Record, packed, record_of

if TYPE_CHECKING:
    from sovereign_netcode.playtest.scaled import ScaledMatch

SILENCE_S = 0.25
"""Seconds without a record after which a standby takes over."""


class Bus:
    """A simulated bus with one log.

    Args:
        match: has the simulated time.
        seed: source of everything random.
        delay_s: least time of a message, in seconds.
        jitter_s: largest additional time, in seconds.
        stop: about every `stop[0]` seconds, the messages of one pair of parts wait for up to `stop[1]` seconds.
        twice: share of the messages that come twice.
        lost: share of the batches that do not come at all.
    """

    def __init__(
        self,
        match: "ScaledMatch",
        seed: int,
        *,
        delay_s: float = 0.001,
        jitter_s: float = 0.001,
        stop: tuple[float, float] | None = None,
        twice: float = 0.0,
        lost: float = 0.0,
    ) -> None:
        self._match, self._rng = match, random.Random(seed)
        self._delay_s, self._jitter_s, self._stop, self._twice = delay_s, jitter_s, stop, twice
        self._lost = lost
        self._free: dict[tuple[str, str], float] = {}
        self._cut: set[str] = set()
        self.log: list[bytes] = []
        """All records that the log has accepted."""
        self.refused = 0
        """Records that the log has refused, because their writer is deposed."""
        self._last = (0, -1)

    def send(self, source: str, target: str, deliver: Callable[[], None]) -> None:
        """Delivers a message from one part to another, after the messages before it."""
        rng, now = self._rng, self._match.now
        if self._lost and target == "sequencer" and rng.random() < self._lost:
            return
        due = now + self._delay_s + rng.random() * self._jitter_s
        if self._stop is not None and rng.random() < 1 / (self._stop[0] * self._match.rate):
            due += rng.random() * self._stop[1]
        for _ in range(2 if rng.random() < self._twice else 1):
            due = max(due, self._free.get((source, target), 0.0))
            self._free[source, target] = due
            self._match.at(due, lambda: None if source in self._cut else deliver())

    def cut(self, source: str) -> None:
        """Loses all messages from one part that are on their way."""
        self._cut.add(source)

    def hold(self, source: str, target: str, seconds: float) -> None:
        """Makes all messages from one part to another wait for some time from now on."""
        self._free[source, target] = self._match.now + seconds

    def append(self, data: bytes, last: tuple[int, int]) -> bool:
        """Appends a record if `last`, its writer's newest record, is the newest of the log. Returns whether it was."""
        if last != self._last:
            self.refused += 1
            return False
        record = record_of(data)
        self._last = (record.epoch, record.tick)
        self.log.append(data)
        self._match.publish(data)
        return True


class Part:
    """A process of the match: it can be killed."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True


class SequencerPart(Part):
    """The sequencer in one process."""

    def __init__(
        self, match: "ScaledMatch", name: str, core: WorldSequencer, begin: bytes, last: tuple[int, int]
    ) -> None:
        super().__init__(name)
        self._match, self.core, self._last = match, core, last
        self._began, self._ticks = match.now, 0
        self._append(begin, None)
        self._schedule()

    def _schedule(self) -> None:
        self._ticks += 1
        self._match.at(self._began + self._ticks / self._match.rate, self._tick)

    def _tick(self) -> None:
        if not self.alive:
            return
        data, world = self.core.tick(self._match.now), self.core.world
        hashed = world.state_hash() if world.tick % self._match.hash_every == 0 else None
        self._match.bus.send(self.name, "log", lambda: self._append(data, hashed))
        self._schedule()

    def _append(self, data: bytes, hashed: bytes | None) -> None:
        """Is called when a record arrives at the log, also after its writer was killed."""
        record = record_of(data)
        if (record.epoch, record.tick) <= self._last:
            return  # it came twice
        if self._match.bus.append(data, self._last):
            self._last = (record.epoch, record.tick)
            if hashed is not None:
                self._match.seen(self.name, record.tick, hashed)
        else:
            self.alive = False  # another one has taken over


class Reader(Part):
    """A process with a replica: an edge or a standby."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica) -> None:
        super().__init__(name)
        self.match, self.replica = match, replica
        self.heard_at = match.now
        self.hashes: dict[int, bytes] = {}

    def receive(self, data: bytes) -> None:
        """Takes a record, and fetches the ones before it from the log if they are missing."""
        if not self.alive:
            return
        self.heard_at = self.match.now
        try:
            self.follow(record_of(data))
        except GapError:
            for each in self.match.bus.log:
                self.follow(record_of(each))

    def follow(self, record: Record) -> None:
        """Takes a record."""
        before = self.replica.world.tick
        self.take(record)
        if self.replica.world.tick > before and self.replica.world.tick % self.match.hash_every == 0:
            self.match.seen(self.name, self.replica.world.tick, self.replica.world.state_hash())

    def take(self, record: Record) -> None:
        """Passes a record to the core."""
        self.replica.take(record)
        self.replica.settle()


class StandbyPart(Reader):
    """A replica without clients, which takes over if the log falls silent."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica, rank: int) -> None:
        super().__init__(match, name, replica)
        self._silence_s = SILENCE_S * (1 + rank)
        self._watch()

    def _watch(self) -> None:
        if not self.alive:
            return
        if self.match.now - self.heard_at > self._silence_s:
            for each in self.match.bus.log:  # the log's end may be newer than what was delivered
                self.follow(record_of(each))
            self.alive = False
            self.match.take_over(self)
            return
        self.match.at(self.match.now + 1 / self.match.rate, self._watch)


class EdgePart(Reader):
    """An edge, with its clock: it follows the arrival of records."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica, limits: Limits | None) -> None:
        super().__init__(match, name, replica)
        self.address = f"ws://{name.replace(' ', '-')}"
        """Address of the edge for clients."""
        self.core = EdgeServer(name, replica, limits, address=self.address)
        self.clock = EdgeClock(match.rate)

    def take(self, record: Record) -> None:
        again = self.core.follow(record, self.match.now)
        if record.journal is None:
            self.clock.restart()
        else:
            missing = record.tick - self.replica.batches.get(self.name, record.tick)
            self.clock.arrived(record.tick, missing, self.match.now)
            self._schedule()
        if again:
            for batch in self.core.unrecorded():
                self._send(batch)

    def due(self) -> float:
        """Returns the time of the deadline of the next tick at this edge."""
        return self.clock.due(self.core.newest + 1)

    def _schedule(self) -> None:
        self.match.at(max(self.due(), self.match.now + 1e-4), self._collect, key=self)

    def _collect(self) -> None:
        if not self.alive:
            return
        due = self.due()
        if due <= self.match.now + 1e-9:
            batch = self.core.collect(due, self.match.now)
            if batch is None:  # the log is silent
                self.match.at(self.match.now + 1 / self.match.rate, self._collect, key=self)
                return
            self._send(batch)
        self._schedule()

    def _send(self, batch: Batch) -> None:
        data = packed(batch)
        self.match.bus.send(self.name, "sequencer", lambda: self.match.deliver(data))
