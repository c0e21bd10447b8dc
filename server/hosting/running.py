"""One of the worlds that run in a process: its game, its ticks, its files and its pages."""

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from server.game import Game
from server.observability.live import Live
from server.persistence.store import Store
from server.runtime.log import WORLD
from server.runtime.ticker import Ticker
from server.worlds.hosted import HostedWorld


class RunningWorld:
    """The parts of a world around its game.

    Attributes:
        store: the store; None: the world is not saved.
        recording: the file of the recording; None: there is none.
    """

    def __init__(self, world: HostedWorld, game: Game, ticker: Ticker) -> None:
        self.world, self.game, self.ticker = world, game, ticker
        self.store: Store | None = None
        self.recording: IO[bytes] | None = None
        self._live: Live | None = None
        self._overruns = 0

    @property
    def live(self) -> Live:
        """The live pages of the world."""
        if self._live is None:
            histograms = {"tick_lateness_seconds": self.ticker.lateness, "tick_work_seconds": self.ticker.work}
            self._live = Live(self.game, self.stats, lambda: histograms)
        return self._live

    def stats(self) -> dict[str, Any]:
        """Returns the figures of the world."""
        own = {"world": self.world.name, "kind": self.world.kind.name, "ticking": self.world.ticking}
        more = {} if self.store is None else self.store.stats()
        errors = {"ticks_overrun": self.ticker.overruns, "internal_errors": self.internal_errors}
        return {**own, **self.game.stats(), **self.ticker.stats(), **more, **errors}

    @property
    def internal_errors(self) -> int:
        """Number of exceptions in our own code."""
        return self.game.faults.total + (0 if self.store is None else self.store.faults.total)

    def overran(self) -> int:
        """Returns the number of ticks since the last call that took longer than the time between two."""
        before, self._overruns = self._overruns, self.ticker.overruns
        return self._overruns - before

    def figures(self) -> dict[str, float]:
        """Returns the figures of the world that `/metrics` shows."""
        ticker = self.ticker
        return {
            "players": self.world.players,
            "entities": len(self.game.world),
            "ticks": ticker.ticks,
            "ticks_late": ticker.ticks_late,
            "ticks_failed": ticker.failures,
            "ticks_overrun": ticker.overruns,
            "skipped_s": ticker.skipped_s,
            "tick_work_s": ticker.work.sum_s,
            "rules_failed": self.game.counters.rules_failed,
            "internal_errors": self.internal_errors,
        }

    def end_recording(self) -> None:
        """Ends the recording, if there is one."""
        if self.recording is not None:
            self.game.world.end_recording()
            with contextlib.suppress(OSError):
                self.recording.close()
            self.recording = None


class NamedTick:
    """The tick of a game, during which lines of the log have the name of its world.

    Args:
        name: name of the world.
        game: the game.
    """

    def __init__(self, name: str, game: Game) -> None:
        self._name, self._tick = name, game.tick

    def __call__(self, deadline: float, now: float) -> None:
        token = WORLD.set(self._name)
        try:
            self._tick(deadline, now)
        finally:
            WORLD.reset(token)


class OwnedTick(NamedTick):
    """The tick of a game that another process may take over. It stands still while this process does not own it.

    Args:
        name: name of the world.
        game: the game.
        owned: returns whether this process owns a world.
    """

    def __init__(self, name: str, game: Game, owned: Callable[[str], bool]) -> None:
        super().__init__(name, game)
        self._owned = owned

    def __call__(self, deadline: float, now: float) -> None:
        if self._owned(self._name):
            super().__call__(deadline, now)


def new_recording(folder: Path, name: str) -> IO[bytes]:
    """Creates the file of a recording: NAME.rec, or NAME-2.rec and so on if there is one.

    Raises:
        OSError: it cannot be created.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        path = folder / (f"{name}.rec" if number == 1 else f"{name}-{number}.rec")
        with contextlib.suppress(FileExistsError):
            return path.open("xb")
    raise AssertionError
