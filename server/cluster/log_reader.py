"""The records of a log in order, from a bus that may lose some on their way and has all of them by number."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Protocol

from server.cluster.bus import BusError, Stored

LOOK_S = 0.3
"""Seconds to wait for the answer about the newest record, which is asked for again and again."""
RETRY_S = 0.1
"""Seconds after which missing records are asked for again."""
FETCHED_MAX = 512
"""Maximum number of missing records that are fetched at once."""


class Log(Protocol):
    """The log of a bus."""

    async def end(self) -> tuple[int, str]:
        """Returns number and id of the newest record."""
        ...

    async def fetch(self, first: int, last: int) -> list[Stored]:
        """Returns records by their numbers."""
        ...


class LogReader:
    """The records of a log in order. Missing ones are fetched.

    Args:
        log: the log.
        seq: number of the first record.
    """

    def __init__(self, log: Log, seq: int) -> None:
        self._log, self._next = log, seq
        self._come: dict[int, Stored] = {}
        self._newest = seq - 1
        self._news = asyncio.Event()
        self.on_close: Callable[[], None] = lambda: None
        """Ends the subscription that calls `come`."""

    @property
    def waiting(self) -> int:
        return max(self._newest - self._next + 1, 0)

    async def take(self, wait_s: float) -> Stored | None:
        until = time.monotonic() + wait_s
        while self._next not in self._come:
            if self._newest < self._next:
                self._news.clear()
                try:
                    await asyncio.wait_for(self._news.wait(), max(until - time.monotonic(), 0.001))
                except TimeoutError:
                    await self._look_at_the_end()
            if self._newest >= self._next and self._next not in self._come:
                await self._fetch()
            if time.monotonic() >= until and self._next not in self._come:
                return None
        self._next += 1
        return self._come.pop(self._next - 1)

    def close(self) -> None:
        self.on_close()
        self.on_close = lambda: None

    def come(self, stored: Stored) -> None:
        """Takes a record that the log has accepted."""
        if stored.seq >= self._next:
            self._come[stored.seq] = stored
            self._newest = max(self._newest, stored.seq)
            self._news.set()

    async def _look_at_the_end(self) -> None:
        """Asks for the newest record, because it may have been missed."""
        with contextlib.suppress(BusError, TimeoutError):
            async with asyncio.timeout(LOOK_S):
                self._newest = max(self._newest, (await self._log.end())[0])

    async def _fetch(self) -> None:
        """Fetches the records that are missing before the first one that has come."""
        last = min([*self._come, self._newest + 1]) - 1
        try:
            for stored in await self._log.fetch(self._next, min(last, self._next + FETCHED_MAX - 1)):
                self._come[stored.seq] = stored
        except BusError:
            await asyncio.sleep(RETRY_S)
