"""A guard of a game's state, which may change only within a tick, in the thread that ticks."""

import asyncio
import threading
from types import TracebackType


class OutOfTurnError(RuntimeError):
    """An attempt to change a game from another thread, or from a callback of an event loop between ticks."""


class Turn:
    """The right to change a game. A tick holds it, by `with turn:`.

    Between ticks the thread that ticks has the right, too, if it runs no event loop: a test or a program that calls
    `tick` itself cannot interfere with a tick. Before the first tick, that is the thread in which the game was made.
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
        """Checks that the caller has the right.

        Args:
            what: name of the method that was called, for the error.

        Raises:
            OutOfTurnError: the caller does not have the right.
        """
        if threading.get_ident() != self._thread:
            where = f"from thread {threading.current_thread().name!r}, which is not the one that ticks"
        elif self._depth == 0 and asyncio._get_running_loop() is not None:
            where = "from a callback of the event loop, between two ticks"
        else:
            return
        raise OutOfTurnError(f"{what}: called {where}; pass it to the next tick by game.soon(game.{what}, ...)")
