"""An edge as a part: serves clients from the log.

    part = EdgePart(bus, fresh, name="edge-1", world="arena", url="ws://127.0.0.1:8765")
    task = asyncio.create_task(part.run())
    await part.ready.wait()
    gateway = Gateway(part.core)

Theory of operation. Each record of the log is one tick of the edge. An alarm rings at the edge's own deadline of the
next tick, when the batch is made. An edge that is more than `SHED_S` behind the log closes the connections of its
clients with a reason, so that they go on at another edge. It takes no new ones until it has caught up.
"""

import asyncio
import logging
import math
import time
from collections.abc import Callable
from typing import Any

from server.cluster.bus import Bus, PurgedError, Stored
from server.cluster.following import WAIT_S
from server.cluster.part import Part, PartError
from server.config.limits import Limits
from server.game.session import Session
from server.journal.recorded_world import RecordedWorld
from server.journal.records import DivergedError
from server.observability.histogram import Histogram
from server.rules import Rules
from server.runtime.alarm import Alarm, best_alarm
from server.runtime.tasks import Tasks
from server.scale.clock import EdgeClock
from server.scale.edge import AHEAD_MAX, EdgeServer
from server.scale.wire import packed
from shared import messages

SHED_S = 2.0
"""Seconds of records that may wait before an edge sends its clients to other edges."""
BEHIND = "this edge is too slow; go on at another one"
"""Reason for clients that an edge sends away because it is behind."""

logger = logging.getLogger(__name__)


class EdgePart(Part):
    """An edge.

    Args:
        bus, fresh, name, world: as for `Part`.
        url: address for clients, which other edges may tell theirs; empty: none.
        limits: the limits.
        authenticate: returns the subject of a client's token, as for `Game`.
        rules: the rules, whose `load_player` the edge runs; None: there is none.

    Attributes:
        core: the edge, from the moment at which it is ready; None: not yet.
        ready: set when the edge can serve.
    """

    def __init__(
        self,
        bus: Bus,
        fresh: RecordedWorld,
        *,
        name: str,
        world: str = "world",
        url: str = "",
        limits: Limits | None = None,
        authenticate: Callable[[str], str] | None = None,
        rules: Rules | None = None,
    ) -> None:
        super().__init__(bus, fresh, name=name, world=world)
        self.url = url
        self.core: EdgeServer | None = None
        self.ready = asyncio.Event()
        self.shedding = False
        """Whether the edge is behind, and takes no clients."""
        self.sheds = 0
        self.clock = EdgeClock(self.scene.tick_rate)
        self._limits, self._authenticate, self._rules = limits or Limits(), authenticate, rules
        self._tasks: Tasks | None = None
        self._empty = asyncio.Event()
        self.round_trip = Histogram()
        """Durations from a tick's batch to its record: the latency that the bus adds to an input."""
        self._sent: dict[int, float] = {}
        self._alarm: Alarm | None = None
        self._shed_at = round(SHED_S * self.scene.tick_rate)

    def others(self) -> list[str]:
        """Returns the addresses of the other edges that take clients, first the one with the fewest players."""
        return [] if self.core is None else self.core.moves.others

    async def run(self) -> None:
        following = self.following
        await following.catch_up()
        self.began()
        self.core = EdgeServer(
            self.name,
            following.replica,
            self._limits,
            address=self.url,
            authenticate=self._authenticate,
            rules=self._rules,
        )
        self.faults = self.core.faults
        self._tasks = Tasks(asyncio.get_running_loop(), self._limits.load_s)
        self.core.joining.run = self._tasks.run
        self._alarm = best_alarm(asyncio.get_running_loop(), self._ring)
        try:
            while True:
                stored = await following.next(WAIT_S)
                if following.reader is None:
                    return  # the part was stopped while it waited
                if stored is not None:
                    self._take(self.core, stored)
                    self._look_whether_behind(self.core, following.reader.waiting)
                    await asyncio.sleep(0)  # one turn of the loop for the messages of clients
        except (DivergedError, PurgedError) as error:
            raise PartError(str(error)) from error
        finally:
            self.stop()

    def drain(self) -> None:
        """Begins to send all clients to other edges, because this one is about to stop."""
        if self.core is not None:
            self.core.drain()

    @property
    def drained(self) -> bool:
        """Whether no client plays over this edge."""
        return self.core is None or self.core.drained

    async def leave(self) -> None:
        """Sends all clients to other edges, and waits until they are gone. Without another edge, it does nothing."""
        if self.others():
            self.drain()
            await self._empty.wait()

    def stop(self) -> None:
        super().stop()
        if self._alarm is not None:
            self._alarm.close()
            self._alarm = None
        if self._tasks is not None:
            self._tasks.stop()

    def unready(self) -> str:
        if self.shedding:
            return f"behind: {self.following.reader.waiting if self.following.reader else 0} records wait"
        return super().unready()

    def stats(self) -> dict[str, Any]:
        core = self.core
        figures: dict[str, Any] = {"edge_lead_ms": round(1e3 * self.clock.lead_s, 3), "batches_late": self.clock.late}
        figures |= {"bus_round_trip_ms": self.round_trip.summary(), "bus_round_trip_counts": self.round_trip.counts()}
        figures["sheds"] = self.sheds
        if core is not None:
            figures |= {**core.stats(), "handovers_asked": core.moves.asked}
        return {**super().stats(), **figures}

    def shut_down(self, reason: str, wait: float) -> None:
        if self.core is not None:  # at another edge, a client can go on at once
            self.core.connections.shut_down(reason, 0.0 if self.others() else wait, messages.GOING_AWAY)

    def open(self, link: Any, now: float) -> Session:
        assert self.core is not None
        return self.core.open(link, now)

    def receive(self, session: Session, data: bytes, now: float) -> None:
        assert self.core is not None
        self.core.receive(session, data, now)

    def lost(self, session: Session, now: float) -> None:
        assert self.core is not None
        self.core.lost(session, now)

    # -- inside ------------------------------------------------------------------------------------------------

    def _take(self, core: EdgeServer, stored: Stored) -> None:
        """Takes one record: a tick of the edge."""
        record, now = self.following.take(stored), time.monotonic()
        again = core.follow(record, now)
        if record.journal is None:
            self.clock.restart()
        else:
            newest = self.following.replica.batches.get(self.name)
            if newest is None and self.ready.is_set() and record.epoch == self.following.replica.epoch:
                raise PartError(f"the sequencer has forgotten the edge {self.name}")
            if (sent := self._sent.pop(record.tick, None)) is not None:
                self.round_trip.record(now - sent)
            self.clock.arrived(record.tick, 0 if newest is None else record.tick - newest, now)
            margin_s = record.margin_s(self.name)
            if newest is not None and margin_s is not None:
                self.clock.learn(newest, margin_s)
            self.lateness.record(max(now - self.clock.due(record.tick) - self.clock.lead_s, 0.0))
            self.ticks += 1
            self.latest = now
            if newest is not None:
                self.ready.set()
            self._schedule(core)
        if core.moves.draining and core.drained:
            self._empty.set()
        if again:
            for batch in core.unrecorded():
                self.bus.publish(packed(batch))
        self.work.record(time.monotonic() - now)

    def _look_whether_behind(self, core: EdgeServer, waiting: int) -> None:
        """Sends the clients away if too many records wait, and takes clients again once none waits."""
        if waiting > self._shed_at and not self.shedding:
            self.shedding = True
            self.sheds += 1
            logger.warning("%d records wait: %d clients are sent to other edges", waiting, len(core.sessions))
            core.connections.shut_down(BEHIND, 0.0, messages.GOING_AWAY)
        elif self.shedding and not waiting:
            self.shedding = False
            logger.info("caught up at tick %d", core.world.tick)

    def _schedule(self, core: EdgeServer) -> None:
        due = self.clock.due(core.newest + 1)
        if self._alarm is not None and due < math.inf:
            self._alarm.set(due)

    def _ring(self) -> None:
        """Makes the batch of the next tick at its deadline."""
        core, now = self.core, time.monotonic()
        if core is None or self._alarm is None:
            return
        due = self.clock.due(core.newest + 1)
        if due <= now:
            try:
                batch = core.collect(due, now)
            except Exception:
                self.faults.report("making a batch")
                batch = None
            if batch is None:  # the log is silent
                self._alarm.set(now + 1 / self.scene.tick_rate)
                return
            self.bus.publish(packed(batch))
            if len(self._sent) > AHEAD_MAX:  # their records came before them
                self._sent.clear()
            self._sent[batch.number] = now
            self.clock.sent(batch.number, now)
        self._schedule(core)
