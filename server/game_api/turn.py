"""A guard for a game's state: it changes within a tick, in the thread that ticks, and nowhere else."""

import asyncio
import threading
from types import TracebackType


class OutOfTurnError(RuntimeError):
    """The state of a game was to be changed from another thread, or from a callback of an event loop between ticks."""


class Turn:
    """The right to change a game. It is held within `with turn:`, which is what a tick does.

    Between ticks the thread that ticks has it, too, where no event loop runs: a test or a program that calls `tick`
    itself knows where it stands. Before the first tick that is the thread in which the game was made.
    """

    def __init__(self) -> None:
        self._thread = threading.get_ident()
        self._depth = 0

    def __enter__(self) -> None:
        self._thread = threading.get_ident()
        self._depth += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._depth -= 1

    def check(self, what: str) -> None:
        """Refuses to go on where the right is not held.

        Args:
            what: the method that was called, for the error.

        Raises:
            OutOfTurnError: it is not held here.
        """
        if threading.get_ident() != self._thread:
            where = f"from thread {threading.current_thread().name!r}, which is not the one that ticks"
        elif self._depth == 0 and asyncio._get_running_loop() is not None:
            where = "from a callback of the event loop, between two ticks"
        else:
            return
        raise OutOfTurnError(f"{what}: called {where}; hand it to the next tick by game.soon(game.{what}, ...)")
