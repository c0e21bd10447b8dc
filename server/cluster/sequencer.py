"""A sequencer or a standby as a part.

Theory of operation. Both follow the log until it is silent. A sequencer may begin the log of a new world; a standby
waits for one. After `takeover_s` without a record, a part asks for the end of the log, and appends the record that
begins the next epoch. The log accepts it only behind the record that the part has as its newest, so one of several
parts succeeds, and the others go on following. The part that has succeeded runs the world. If one of its records is
refused because another sequencer has begun, it ends. While it follows, a part saves a checkpoint from time to time.
"""

import asyncio
import logging
import time
from typing import Any

from server.cluster.bus import Bus, BusError, PurgedError, RefusedError, Snapshot, Stored
from server.cluster.part import Part, PartError
from server.config.limits import Limits
from server.journal.recorded_world import RecordedWorld
from server.journal.records import DivergedError
from server.players.persisted_state import PersistedState
from server.rules import Rules
from server.runtime.alarm import best_alarm
from server.runtime.ticker import Ticker
from server.scale import checkpoint
from server.scale.sequencer import WorldSequencer, begin_record
from server.scale.wire import batch_of
from server.scale.writer import DeposedError, Entry, LogWriter, LostError, id_of

SILENCE_S = 0.25
"""Default of the seconds without a record after which a part takes over."""
SILENCE_TICKS = 3
"""Minimum number of ticks without a record after which a part takes over, for worlds with few ticks per second."""
RETRY_S = 0.05
"""Seconds until records without an answer are sent again."""
KEPT_S = 30.0
"""Seconds of records that stay in the log behind a checkpoint, for parts that have missed them."""

logger = logging.getLogger(__name__)


class SequencerPart(Part):
    """A sequencer or a standby.

    Args:
        bus, fresh, name, world: as for `Part`.
        rules: the rules; None: players only walk and edit.
        limits: the limits.
        seed: seed of the rules' random numbers.
        begins: whether the part begins a new world if the log is empty.
        checkpoint_s: seconds of the world's time between two checkpoints.
        takeover_s: seconds without a record after which the part takes over; at least `SILENCE_TICKS` ticks.

    Attributes:
        core: the sequencer, as soon as the part runs the world; None: it follows.
        leads: set when the part runs the world.
    """

    def __init__(
        self,
        bus: Bus,
        fresh: RecordedWorld,
        *,
        name: str,
        world: str = "world",
        rules: Rules | None = None,
        limits: Limits | None = None,
        seed: int = 0,
        begins: bool = True,
        checkpoint_s: float = 60.0,
        takeover_s: float = SILENCE_S,
    ) -> None:
        super().__init__(bus, fresh, name=name, world=world)
        self._rules, self._limits, self._seed, self._begins = rules, limits, seed, begins
        self.core: WorldSequencer | None = None
        self.leads = asyncio.Event()
        self.checkpoints = 0
        self.still = 0
        """Ticks at which time stood still, because too many records had no acknowledgement."""
        self.takeover_s = 0.0
        """Seconds from the newest record before this part to its first one."""
        self._checkpoint_ticks = max(1, round(checkpoint_s * self.scene.tick_rate))
        self._silence_s = max(takeover_s, SILENCE_TICKS / self.scene.tick_rate)
        self._saved_tick = 0
        self._saving: asyncio.Task[None] | None = None
        self._writer: LogWriter | None = None
        self._ticker: Ticker | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._over: asyncio.Future[None] | None = None
        self._heard = time.monotonic()

    @property
    def kept(self) -> PersistedState:
        return super().kept if self.core is None else self.core.api.kept

    async def run(self) -> None:
        following = self.following
        try:
            await following.catch_up()
            self.began()
            self._saved_tick = self.world.tick
            self._heard = time.monotonic()
            while (begin := await self._follow()) is None:
                pass
            await self._sequence(begin)
        except (DivergedError, PurgedError) as error:
            raise PartError(str(error)) from error
        finally:
            self.stop()

    def stop(self) -> None:
        super().stop()
        if self._ticker is not None:
            self._ticker.stop()
        for task in (*self._tasks, *([self._saving] if self._saving else [])):
            task.cancel()

    def unready(self) -> str:
        return "" if self.core is not None and self._saves() else super().unready()

    def stats(self) -> dict[str, Any]:
        core, writer = self.core, self._writer
        figures: dict[str, Any] = {"leads": core is not None, "checkpoints": self.checkpoints}
        if core is not None and writer is not None and self._ticker is not None:
            figures |= {
                **self._ticker.stats(),
                "epoch": core.epoch,
                "unacknowledged": len(writer),
                "repeated": writer.repeated,
                "ticks_still": self.still,
                "takeover_ms": round(1e3 * self.takeover_s, 1),
                "rules_failed": core.counters.rules_failed,
            }
        return {**super().stats(), **figures}

    def _saves(self) -> bool:
        """Returns whether the log acknowledges records."""
        return self._writer is None or not self._writer.full

    # -- following ---------------------------------------------------------------------------------------------

    async def _follow(self) -> Entry | None:
        """Takes one record, or takes over if there is none for too long. Returns the record that begins the epoch."""
        following = self.following
        stored = await following.next(self._silence_s)
        if stored is not None:
            self._take(stored)
            await asyncio.sleep(0)
            return None
        if not self._begins and not following.seq:
            return None
        return await self._take_over()

    def _take(self, stored: Stored) -> None:
        began = time.monotonic()
        replica = self.following.replica
        replica.take(self.following.take(stored))
        replica.settle()
        self.ticks += 1
        self.latest = self._heard = time.monotonic()
        self.work.record(self.latest - began)
        due = self.world.tick - self._saved_tick >= self._checkpoint_ticks
        if due and (self._saving is None or self._saving.done()):
            self._saved_tick = self.world.tick
            data = checkpoint.encoded(replica, self.following.last)
            self._saving = asyncio.create_task(self._save(Snapshot(self.following.seq, data)))

    async def _save(self, snapshot: Snapshot) -> None:
        try:
            await self.bus.put_checkpoint(snapshot, round(KEPT_S * self.scene.tick_rate))
            self.checkpoints += 1
        except Exception:
            self.faults.report("saving a checkpoint")

    async def _take_over(self) -> Entry | None:
        """Appends the record that begins the next epoch. Returns it; None: this part goes on following."""
        following = self.following
        try:
            seq, last = await self.bus.end()
        except BusError:
            self._heard = time.monotonic()  # the bus is silent, which says nothing about the sequencer
            return None
        if (seq, last) != (following.seq, following.last) or time.monotonic() - self._heard < self._silence_s:
            return None
        epoch, data = begin_record(following.replica)
        entry = Entry(id_of(epoch, self.world.tick, self.name), last, data)
        try:
            following.seq = await self.bus.append(entry)
        except RefusedError:
            return None
        except BusError:  # if the log has it, it comes as a record
            self._heard = time.monotonic()
            return None
        return entry

    # -- sequencing --------------------------------------------------------------------------------------------

    async def _sequence(self, begin: Entry) -> None:
        """Runs the world until the part is deposed or cancelled."""
        following, loop = self.following, asyncio.get_running_loop()
        following.close()
        replica = following.replica if following.replica.epoch else None
        self.core = core = WorldSequencer(self.world, self._rules, self._limits, seed=self._seed, replica=replica)
        self.faults = core.faults
        self._writer = LogWriter(self.name, begin.id)
        self._over = loop.create_future()
        await self.bus.receive(self._receive)
        rate = self.scene.tick_rate
        self._ticker = Ticker(rate, self._tick, self._broken, lambda ring: best_alarm(loop, ring), self.faults)
        self.takeover_s = time.monotonic() - self._heard
        logger.info(
            "runs the world from tick %d on, epoch %d, %.0f ms after the newest record",
            self.world.tick,
            core.epoch,
            1e3 * self.takeover_s,
        )
        self.leads.set()
        await self._over

    def _receive(self, data: bytes) -> None:
        assert self.core is not None
        try:
            self.core.receive(batch_of(data), time.monotonic())
        except Exception:
            self.faults.report("receiving a batch")

    def _tick(self, deadline: float, now: float) -> None:
        core, writer = self.core, self._writer
        assert core is not None
        assert writer is not None
        if writer.full:
            self.still += 1
            return
        self.latest = now
        self._send([writer.add(core.epoch, self.world.tick + 1, core.tick(now))])

    def _send(self, entries: list[Entry]) -> None:
        for entry in entries:
            task = asyncio.get_running_loop().create_task(self._append(entry))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _append(self, entry: Entry) -> None:
        writer = self._writer
        assert writer is not None
        try:
            self.following.seq = max(self.following.seq, await self.bus.append(entry))
            writer.accepted(entry)
        except RefusedError as refusal:
            try:
                self._send(writer.refused(entry, refusal.last))
            except (DeposedError, LostError) as error:
                self._end(str(error))
        except BusError:
            await asyncio.sleep(RETRY_S)
            self._send(writer.unanswered(entry))

    def _broken(self) -> None:
        self._end("too many ticks in a row have failed")

    def _end(self, reason: str) -> None:
        if self._ticker is not None:
            self._ticker.stop()
        if self._over is not None and not self._over.done():
            self._over.set_exception(PartError(reason))
