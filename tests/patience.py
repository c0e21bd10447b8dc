"""The time for which a test with real sockets, files or processes waits for what must come, and how it waits."""

import asyncio
import time
from collections.abc import Callable

PATIENCE_S = 60.0
"""Only a fault takes a minute, so a busy machine breaks no test. No test that passes waits until its end."""
LOOK_S = 0.002
"""Seconds between two looks at a condition."""


def until(condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Waits for a condition that another thread or process makes true."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not hold in time"
        time.sleep(LOOK_S)


async def soon(condition: Callable[[], bool]) -> None:
    """Waits for a condition that other tasks of the event loop make true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "the condition did not hold in time"
        await asyncio.sleep(LOOK_S)
