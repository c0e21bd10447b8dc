"""Many worlds in one server process: their directory, their host, and what the gateway and the pages need of them."""

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any

from server.config.hosts import is_loopback, network_of
from server.config.options import SettingsError
from server.config.settings import Settings
from server.game import Game
from server.hosting.host import WorldHost
from server.hosting.operators import Operators
from server.hosting.pages import WorldPages
from server.observability.errors import FaultReporter
from server.observability.pages import Page, PageRequest, line
from server.runtime.tasks import Tasks
from server.runtime.terrain import TerrainPool
from server.worlds.directory import STOPPING
from server.worlds.host import Way
from server.worlds.kinds import Kind, WorldsError
from server.worlds.worlds import Worlds, name_in

LOOK_S = 0.1
"""Seconds between two looks at the worlds: who gets a seat, which rest, which end."""
FILES_LOOKS = 10
"""Number of such looks between two at what is to be saved beside the stores."""
TOO_OFTEN = "too many requests for a world from your address; wait some seconds"
"""Reason for a client whose address asks for worlds too often."""

logger = logging.getLogger(__name__)


class Hosting:
    """The worlds of a server process beside its default world. It begins in the event loop that runs the ticks.

    Args:
        settings: the settings.
        kinds: the kinds of worlds.
        terrain: the terrain that worlds share.
        default: the game of the default world.
        tasks: runs coroutines of rules.
        token: the token of operators; empty: there is none.
        faults: where exceptions in our own code are reported.
        stop: ends the server, with a reason.
        host_of, worlds_of: classes of the host and of the worlds.

    Raises:
        SettingsError: the directory of the data cannot be used.
    """

    def __init__(
        self,
        settings: Settings,
        kinds: Mapping[str, Kind],
        terrain: TerrainPool,
        default: Game,
        tasks: Tasks,
        *,
        token: str,
        faults: FaultReporter,
        stop: Callable[[str], None],
        host_of: type[WorldHost] = WorldHost,
        worlds_of: type[Worlds] = Worlds,
    ) -> None:
        self._settings, self._stop, self._faults = settings, stop, faults
        self._loop = asyncio.get_running_loop()
        authenticate = default.joining.authenticate
        try:
            self.host = host_of(settings, terrain, self._loop, tasks.run, authenticate)
        except OSError as error:
            raise SettingsError(f"data = {settings.data!r}: cannot be used ({error.strerror or error})") from error
        self.worlds = self.host.worlds = worlds_of(
            kinds,
            settings.limits,
            self.host,
            default=default,
            authenticate=authenticate,
            faults=faults,
            run=tasks.run,
        )
        self.worlds.now = time.monotonic()
        self.pages = WorldPages(self.worlds, self.host, live=settings.page)
        self._operators = Operators(self.worlds, self.host, token, self.drain)
        self._timer: asyncio.TimerHandle | None = None
        self._drained_at: float | None = None
        self._looks = 0
        self.looked: Callable[[], None] = lambda: None
        """Called after each look at the worlds."""

    def start(self) -> None:
        """Begins the saved worlds and those that the settings name, and looks after all worlds from now on."""
        self.host.restore(self.worlds.kinds)
        self.begin_named()
        self.look()

    def begin_named(self) -> None:
        """Begins the worlds that the settings name."""
        for kind, found in self._settings.worlds.items():
            for number in range(1, found.start + 1):
                name = kind if number == 1 else f"{kind}-{number}"
                try:
                    if self._known(name):
                        self.worlds.get(name).stays = True
                    else:
                        self.worlds.create(kind, name=name, stays=True)
                except WorldsError as error:
                    logger.error("%s", error)

    def look(self) -> None:
        """Looks after all worlds from now on."""
        self._look_after()

    def route(self, target: str, address: str) -> Way | Page:
        """Returns what the target of a WebSocket's request leads to, or the page that refuses it.

        Args:
            target: path and query.
            address: address of the client.
        """
        limits = self._settings.limits
        if self.worlds.alone and self.worlds.draining and name_in(target) in ("match", "create"):
            retry = str(max(1, round(self._settings.restart_s)))
            return line(HTTPStatus.SERVICE_UNAVAILABLE, STOPPING, retry_after=retry)
        exempt = limits.loopback_exempt and is_loopback(address)
        if not exempt and not self.worlds.may_ask(target, network_of(address)):
            return line(HTTPStatus.TOO_MANY_REQUESTS, TOO_OFTEN, retry_after="2")
        found = self.worlds.route(target)
        return line(HTTPStatus.NOT_FOUND, found) if isinstance(found, str) else found

    def page(self, request: PageRequest) -> Page | None:
        """Returns the answer to a request for a page; None: it is not one of the worlds' pages."""
        return self._operators.get(request) or (self.pages.get(request) if request.method == "GET" else None)

    def drain(self, within_s: float | None = None) -> None:
        """Makes no new worlds, waits until nobody is in a world any more, and then ends the server.

        Args:
            within_s: maximum time in seconds; None: that of the settings.
        """
        seconds = self._settings.drain_s if within_s is None else within_s
        self._drained_at = self._loop.time() + seconds
        if not self.worlds.draining:
            self.worlds.draining = True
            self.worlds.lobby.shut_down(STOPPING, self._settings.restart_s)
            logger.info("draining: %d worlds may go on for at most %g s", len(self.worlds.worlds), seconds)

    def stats(self) -> dict[str, Any]:
        """Returns the figures of all worlds for `/stats`."""
        return self.worlds.stats()

    def shut_down(self, reason: str, wait: float) -> None:
        """Stops all ticks and closes all connections of the worlds. Arguments as for `Worlds.shut_down`."""
        if self._timer is not None:
            self._timer.cancel()
        self.worlds.shut_down(reason, wait)
        self.host.stop()

    def _known(self, name: str) -> bool:
        return name in self.worlds.worlds or name in self.worlds.asleep

    def _look_after(self) -> None:
        self._timer = self._loop.call_later(LOOK_S, self._look_after)
        try:
            self.worlds.tick(time.monotonic())
            self.looked()
            self._looks += 1
            if self._looks % FILES_LOOKS == 0:
                self.host.look_after()
            if self._drained_at is not None:
                self._look_whether_drained(self._drained_at)
        except Exception:
            self._faults.report("looking after the worlds")

    def _look_whether_drained(self, until: float) -> None:
        """Ends the server if nobody is in a world any more, or the time is over."""
        busy = sum(not world.empty for world in self.worlds.worlds.values())
        if not busy:
            self._stop("drained")
        elif self._loop.time() >= until:
            self._stop(f"drained, with players in {busy} worlds")
