"""Tasks of the event loop that the rules of a game need, such as fetching a player's data from a database."""

import asyncio
from collections.abc import Coroutine
from typing import Any

from server.game.loading import Done


class Tasks:
    """The runner of a game's coroutines on an event loop.

    Args:
        loop: the event loop, which also runs the ticks.
        longest_s: longest time of a coroutine, in seconds; then it is cancelled.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, longest_s: float) -> None:
        self._loop, self._longest_s = loop, longest_s
        self._running: set[asyncio.Task[Any]] = set()

    def run(self, coroutine: Coroutine[Any, Any, Any], done: Done) -> None:
        """Starts a coroutine, and calls `done` with its result or its exception."""
        task = self._loop.create_task(asyncio.wait_for(coroutine, self._longest_s))
        self._running.add(task)

        def finished(task: asyncio.Task[Any]) -> None:
            self._running.discard(task)
            if not task.cancelled():
                error = task.exception()
                done(None if error is not None else task.result(), error)

        task.add_done_callback(finished)

    def stop(self) -> None:
        """Cancels all coroutines; their functions are not called."""
        for task in self._running:
            task.cancel()
