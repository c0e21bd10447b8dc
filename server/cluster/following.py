"""Following a log: a replica that begins with a checkpoint and takes every record after it."""

import asyncio
import logging
import time

from server.cluster.bus import Bus, PurgedError, Reader, Stored
from server.journal.recorded_world import RecordedWorld
from server.players.persisted_state import PersistedState
from server.scale import checkpoint
from server.scale.replica import Replica
from server.scale.wire import Record, record_of
from server.scale.writer import EMPTY

PROGRESS_S = 2.0
"""Seconds between two lines of the log about the progress."""
WAIT_S = 1.0
"""Seconds that one wait for a record takes at most."""
ATTEMPTS = 5
"""Attempts to load a checkpoint before its log is gone again."""

logger = logging.getLogger(__name__)


class Following:
    """The replica of one part, and its place in the log.

    Args:
        bus: the bus.
        fresh: a new world of the scene with its terrain.
    """

    def __init__(self, bus: Bus, fresh: RecordedWorld) -> None:
        self._bus, self._fresh = bus, fresh
        self.replica = Replica(fresh, PersistedState())
        self.seq, self.last = 0, EMPTY
        """Sequence number and id of the newest record in the replica."""
        self.target = 0
        """Sequence number that the replica has to reach before the part is ready."""
        self.reader: Reader | None = None

    async def catch_up(self) -> None:
        """Loads the newest checkpoint and takes all records after it.

        Raises:
            BusError: the bus does not answer.
            DivergedError: a record gives another world here than there.
            PurgedError: checkpoints are made faster than this part takes the records.
        """
        for attempt in range(ATTEMPTS):
            try:
                await self._load()
                await self._take_all()
                return
            except PurgedError:
                if attempt == ATTEMPTS - 1:
                    raise
                self.close()

    async def next(self, wait_s: float) -> Stored | None:
        """Returns the next record; None: there was none within the time.

        Raises:
            PurgedError: the log does not have it any more.
            CancelledError: the stream was closed. A timeout at the same moment may hide that the task was cancelled.
        """
        if self.reader is None:
            raise asyncio.CancelledError
        return await self.reader.take(wait_s)

    def take(self, stored: Stored) -> Record:
        """Returns the record in a stored one, and notes that the replica has it."""
        self.seq, self.last = stored.seq, stored.id
        return record_of(stored.data)

    def close(self) -> None:
        """Ends the stream of records."""
        if self.reader is not None:
            self.reader.close()
            self.reader = None

    async def _load(self) -> None:
        found = await self._bus.checkpoint()
        if found is not None:
            began = time.monotonic()
            world = RecordedWorld(self._fresh.scene, compiled=self._fresh.compiled)
            world.restore(self._fresh)
            self.replica, self.last = checkpoint.decoded(found.data, world)
            self.seq = found.seq
            logger.info(
                "checkpoint of tick %d: %d bytes, loaded in %.2f s",
                self.replica.world.tick,
                len(found.data),
                time.monotonic() - began,
            )
        self.reader = await self._bus.follow(self.seq + 1)
        self.target = (await self._bus.end())[0]

    async def _take_all(self) -> None:
        began = reported = time.monotonic()
        first, rate = self.replica.world.tick, self._fresh.scene.tick_rate
        while self.seq < self.target:
            stored = await self.next(WAIT_S)
            if stored is not None:
                self.replica.take(self.take(stored))
                self.replica.settle()
            now = time.monotonic()
            if now - reported >= PROGRESS_S or (self.seq == self.target and self.target):
                reported = now
                ticks = self.replica.world.tick - first
                speed = ticks / rate / max(now - began, 1e-3)
                logger.info(
                    "record %d of %d, tick %d: %.0f times real time",
                    self.seq,
                    self.target,
                    self.replica.world.tick,
                    speed,
                )
