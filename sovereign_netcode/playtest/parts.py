"""The parts of a world on many processes in simulated time: bus, sequencer, edges and standbys."""

import random
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

from server.cluster.bus import RefusedError
from server.cluster.following import WAIT_S
from server.cluster.sequencer import RETRY_S, SILENCE_S
from server.config.limits import Limits
from server.scale.clock import EdgeClock
from server.scale.edge import EdgeServer
from server.scale.replica import Replica
from server.scale.sequencer import WorldSequencer, begin_record
from server.scale.wire import Batch, Record, packed, record_of
from server.scale.writer import DeposedError, Entry, LogWriter, id_of
from sovereign_netcode.playtest.log import Answer

if TYPE_CHECKING:
    from sovereign_netcode.playtest.scaled import ScaledMatch


class Bus:
    """A simulated bus.

    Args:
        match: has the simulated time.
        seed: source of everything random.
        delay_s: least time of a message, in seconds.
        jitter_s: largest additional time, in seconds.
        stop: about every `stop[0]` seconds, the messages of one pair of parts wait for up to `stop[1]` seconds.
        twice: share of the messages that come twice.
        lost: share of the batches, and of the records on their way to a part, that do not come at all.
        far: additional time of all messages from and to a part, in seconds, by its name.
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
        far: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self._match, self._rng = match, random.Random(seed)
        self._delay_s, self._jitter_s, self._stop, self._twice = delay_s, jitter_s, stop, twice
        self._lost, self._far = lost, far
        self._free: dict[tuple[str, str], float] = {}
        self._cut: set[str] = set()

    def send(self, source: str, target: str, deliver: Callable[[], None], *, sure: bool = True) -> None:
        """Delivers a message from one part to another, after the messages before it.

        Args:
            source, target: the parts; "log": the log; "sequencer": all sequencers.
            deliver: function that is called when it arrives.
            sure: whether it cannot be lost.
        """
        rng, now = self._rng, self._match.now
        if self._lost and not sure and rng.random() < self._lost:
            return
        due = (
            now
            + self._delay_s
            + self._far.get(source, 0.0)
            + self._far.get(target, 0.0)
            + rng.random() * self._jitter_s
        )
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


class Part:
    """A process of the match: it can be killed."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True


class SequencerPart(Part):
    """The sequencer in one process, which runs the world since its record `begin` was stored."""

    def __init__(self, match: "ScaledMatch", name: str, core: WorldSequencer, begin: Entry) -> None:
        super().__init__(name)
        self._match, self.core = match, core
        self._began, self._ticks = match.now, 0
        self._writer = LogWriter(name, begin.id)
        self.still = 0
        """Ticks at which time stood still, because too many records had no acknowledgement."""
        self.hashes: dict[str, bytes] = {}
        """Hashes of the world by records that are not stored yet."""
        self._schedule()

    def _schedule(self) -> None:
        self._ticks += 1
        self._match.at(self._began + self._ticks / self._match.rate, self._tick)

    def _tick(self) -> None:
        if not self.alive:
            return
        self._schedule()
        if self._writer.full:
            self.still += 1
            return
        data, world = self.core.tick(self._match.now), self.core.world
        entry = self._writer.add(self.core.epoch, world.tick, data)
        if world.tick % self._match.hash_every == 0:
            self.hashes[entry.id] = world.state_hash()
        self._send([entry])

    def _send(self, entries: list[Entry]) -> None:
        for entry in entries:
            self._match.log.append(self.name, entry, partial(self._answered, entry))

    def _answered(self, entry: Entry, answer: Answer) -> None:
        """Takes what became of a record."""
        if not self.alive:
            return
        if isinstance(answer, str):
            self._writer.accepted(entry)
        elif isinstance(answer, RefusedError):
            try:
                self._send(self._writer.refused(entry, answer.last))
            except DeposedError:
                self.alive = False
        else:
            self._match.at(self._match.now + RETRY_S, lambda: self._again(entry))

    def _again(self, entry: Entry) -> None:
        if self.alive:
            self._send(self._writer.unanswered(entry))


class Reader(Part):
    """A process with a replica: an edge or a standby."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica) -> None:
        super().__init__(name)
        self.match, self.replica = match, replica
        self.heard_at = match.now
        self.seq = match.log.place(replica)
        """Number of records that the replica has."""

    def receive(self, seq: int, data: bytes) -> None:
        """Takes a record by its number, and fetches the ones before it from the log if they are missing."""
        if not self.alive or seq <= self.seq:
            return
        for number in range(self.seq, seq):
            self.heard_at = self.match.now
            self.seq = number + 1
            self.follow(record_of(self.match.log.records[number]))

    def look(self) -> None:
        """Fetches what is missing up to the end of the log, because it may have been lost on its way."""
        records = self.match.log.records
        if records:
            self.receive(len(records), records[-1])

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
        self._silence_s = SILENCE_S * (1 + rank / 8)
        self._asks = False
        self._watch()

    def receive(self, seq: int, data: bytes) -> None:
        if not self._asks:  # it reads on after the answer
            super().receive(seq, data)

    def _watch(self) -> None:
        if not self.alive:
            return
        if not self._asks and self.match.now - self.heard_at > self._silence_s:
            self._asks = True
            self.match.log.end(self.name, self._ended)
        self.match.at(self.match.now + 1 / self.match.rate, self._watch)

    def _ended(self, answer: Answer) -> None:
        """Takes the end of the log. Begins the next epoch if the replica has all records."""
        log, replica = self.match.log, self.replica
        if not self.alive:
            return
        if answer != log.newest or self.seq < len(log.records):
            self._read_on(answer)
            return
        epoch, data = begin_record(replica)
        entry = Entry(id_of(epoch, replica.world.tick, self.name), log.newest, data)
        log.append(self.name, entry, partial(self._begun, entry))

    def _begun(self, entry: Entry, answer: Answer) -> None:
        if not self.alive:
            return
        if answer == entry.id:
            self.alive = False
            self.match.take_over(self, entry)
        else:
            self._read_on(answer)

    def _read_on(self, answer: Answer) -> None:
        """Goes on following. After an error of the log, its silence says nothing about the sequencer."""
        self._asks = False
        if not isinstance(answer, str | RefusedError):
            self.heard_at = self.match.now
        self.look()


class EdgePart(Reader):
    """An edge, with its clock: it follows the arrival of records."""

    def __init__(self, match: "ScaledMatch", name: str, replica: Replica, limits: Limits | None) -> None:
        super().__init__(match, name, replica)
        self.address = f"ws://{name.replace(' ', '-')}"
        """Address of the edge for clients."""
        self.core = EdgeServer(name, replica, limits, address=self.address)
        self.clock = EdgeClock(match.rate)
        self._watch()

    def _watch(self) -> None:
        """Looks at the end of the log after a silence."""
        if self.alive:
            if self.match.now - self.heard_at > WAIT_S:
                self.look()
            self.match.at(self.match.now + WAIT_S, self._watch)

    def take(self, record: Record) -> None:
        again = self.core.follow(record, self.match.now)
        if record.journal is None:
            self.clock.restart()
        else:
            missing = record.tick - self.replica.batches.get(self.name, record.tick)
            self.clock.arrived(record.tick, missing, self.match.now)
            margin_s = record.margin_s(self.name)
            if margin_s is not None:
                self.clock.learn(record.tick - missing, margin_s)
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
            self.clock.sent(batch.number, self.match.now)
            self._send(batch)
        self._schedule()

    def _send(self, batch: Batch) -> None:
        data = packed(batch)
        self.match.bus.send(self.name, "sequencer", lambda: self.match.deliver(data), sure=False)
