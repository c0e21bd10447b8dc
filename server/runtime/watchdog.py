"""The watchdog: a thread that logs when the event loop has stalled, with the stack of the main thread.

The loop notes the time ten times per second, and the thread checks it as often. If the thread itself did not run
either, then the process was suspended, or code held the interpreter lock. The CPU time tells which.
"""

import asyncio
import sys
import threading
import time
import traceback

from server.runtime.structured import structlog

BEAT_S = 0.1
"""Seconds between two checks."""
STALL_S = 0.5
"""Seconds without a sign of life after which the loop counts as stalled."""
QUIET_S = 10.0
"""Minimum time between two logged stacks, in seconds. Every stall is counted."""

logger = structlog.stdlib.get_logger(__name__)


class Watchdog:
    """Watches an event loop until `stop`. Create it in the thread that runs the loop.

    Args:
        loop: the event loop.
        stall_s: seconds after which the loop counts as stalled.
        asleep_s: seconds after which the watching thread itself counts as stalled.
        beat_s: seconds between two checks.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        *,
        stall_s: float = STALL_S,
        asleep_s: float = STALL_S,
        beat_s: float = BEAT_S,
    ) -> None:
        self.stalls = 0
        self._loop = loop
        self._stall_s, self._asleep_s, self._beat_s = stall_s, asleep_s, beat_s
        self._main = threading.get_ident()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._latest = time.monotonic()
        self._timer = loop.call_later(beat_s, self._beat)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread."""
        self._timer.cancel()
        self._stopped.set()
        self._thread.join()

    def _beat(self) -> None:
        self._latest = time.monotonic()
        self._timer = self._loop.call_later(self._beat_s, self._beat)

    def _watch(self) -> None:
        woken, cpu = time.monotonic(), time.process_time()
        excused = counted = logged = -1.0  # times at which the loop was last alive: excused, counted and logged
        quiet_until = woken
        while not self._stopped.wait(self._beat_s):
            before, cpu_before = woken, cpu
            woken, cpu = time.monotonic(), time.process_time()
            if woken - before > self._asleep_s:
                self._log_asleep(woken - before, cpu - cpu_before)
                excused = woken  # the loop could not run, either
            latest = max(self._latest, excused)
            if logged >= 0 and latest != logged:
                logger.warning("the event loop goes on", stalled_s=round(latest - logged, 3))
                logged = -1.0
            if woken - latest > self._stall_s and latest != counted:
                self.stalls += 1
                counted = latest
                if woken >= quiet_until:
                    logged, quiet_until = latest, woken + QUIET_S
                    logger.warning("the event loop has stalled", for_s=round(woken - latest, 3), stack=self._stack())

    def _log_asleep(self, seconds: float, cpu_s: float) -> None:
        self.stalls += 1
        if cpu_s > seconds / 2:
            logger.warning("code that held the interpreter has stalled the event loop", for_s=round(seconds, 3))
        else:
            logger.warning("the process was suspended, or got no CPU", for_s=round(seconds, 3))

    def _stack(self) -> str:
        frame = sys._current_frames().get(self._main)
        return "".join(traceback.format_stack(frame)) if frame is not None else ""
