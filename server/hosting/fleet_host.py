"""The host of the worlds of a process of a fleet: data that move from process to process."""

import logging
from collections.abc import Callable

from server.hosting.host import WorldHost
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import WorldsError

CLOSE_LATER_S = 20.0
"""Seconds after which the files of a world are closed that another process has taken over, because that changes them
while they may be being copied."""

logger = logging.getLogger(__name__)


class FleetWorldHost(WorldHost):
    """The host of the worlds of a process of a fleet. Arguments and errors as for `WorldHost`.

    The data of a world whose process is gone are copied, because that process may be suspended only. A copy has a
    number, which is higher than those of all former ones.
    """

    def folder(self, name: str) -> str:
        """Returns the directory with the data of a world that has begun; empty: it is not saved."""
        return "" if self.files is None else self.files.of(name).name

    def take(self, name: str, folder: str, number: int, done: Callable[[str | None], None]) -> None:
        """Copies the data of a world whose process is gone. Arguments as for `FleetHost.take`."""
        if self.files is None:
            if folder:
                logger.error("the world %s has data, and this server has no directory for them (data)", name)
            done(None if folder else "")
        elif not folder:
            done(f"{name}@{number}")
        else:
            self._threads.submit(self._copy, name, folder, f"{name}@{number}", done)

    def locate(self, name: str, folder: str) -> None:
        """Sets the directory of a world that is about to begin. Arguments as for `FleetHost.locate`.

        Raises:
            WorldsError: its `world.json` cannot be read.
        """
        if self.files is None or not folder:
            return
        self.files.folders[name] = folder
        try:
            saved = self.files.read(name)
        except (OSError, ValueError, TypeError) as error:
            raise WorldsError(f"the world {name!r} cannot be read: {error}") from error
        self._saved.pop(name, None)
        if saved is not None:
            self._saved[name] = saved
            self._threads.submit(self.files.remove_former, name, folder)

    def left(self, world: HostedWorld) -> None:
        """Takes the end of a world that goes on at another process. Nothing more is written."""
        name = world.name
        running = self.running.pop(name)
        running.ticker.stop()
        running.end_recording()
        self._saved.pop(name, None)
        logger.warning("world left: %s (%s)", name, world.ending)
        if running.store is not None:
            running.store.end(save=False)
            self._loop.call_later(CLOSE_LATER_S, running.store.close)

    def closed(self, name: str, done: Callable[[], None]) -> None:
        """Calls a function once the files of a world that has ended are closed."""
        closing = self._closing.get(name)
        if closing is None:
            done()
        else:
            closing.add_done_callback(lambda _: self._loop.call_soon_threadsafe(done))

    def _copy(self, name: str, folder: str, new: str, done: Callable[[str | None], None]) -> None:
        assert self.files is not None
        made: str | None = new
        try:
            self.files.copy(folder, new)
        except OSError as error:
            logger.error("the data of the world %s cannot be copied: %s", name, error)
            made = None
        self._loop.call_soon_threadsafe(done, made)
