"""A server: its gateway, its pages and its ticks, from the start to the shutdown."""

import asyncio
import contextlib
import errno
import os
import ssl
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from prometheus_client.core import Metric

from server.auth.access import tls_context
from server.config.options import SettingsError
from server.config.settings import Settings
from server.game import Game
from server.journal.recorded_world import RecordedWorld
from server.net.addresses import bracketed, reachable
from server.net.admission import Admission
from server.net.gateway import Events, Gateway
from server.observability.errors import FaultReporter
from server.observability.histogram import Histogram
from server.observability.live import Live
from server.observability.metrics import metrics_page
from server.observability.pages import Page, PageRequest, Pages, json_page, line, ready_page
from server.persistence.store import Store
from server.play.play import PlayPages
from server.players.persisted_state import PersistedState
from server.players.player import Player
from server.runtime.alarm import best_alarm
from server.runtime.event_loop import freeze, on_signals, raise_descriptors, rss_mb
from server.runtime.structured import structlog
from server.runtime.tasks import Tasks
from server.runtime.terrain import TerrainPool
from server.runtime.ticker import Ticker
from server.runtime.watchdog import Watchdog
from shared.scene import Scene

if TYPE_CHECKING:
    from server.hosting.hosting import Hosting
    from server.worlds.kinds import Kind

READY_S = 1.0
"""Seconds. The server is ready if a tick began within this time."""
STOP_S = 1.5
"""Seconds that the shutdown waits for peers to finish closing. With the wait for the disk it takes less than 5 s."""

STARTING = line(503, "the server is starting", retry_after="1")

logger = structlog.stdlib.get_logger("server")


class Declared(NamedTuple):
    """The declared kinds of worlds, the terrain that worlds share, and the token of operators (empty: none)."""

    kinds: "Mapping[str, Kind]"
    terrain: TerrainPool
    token: str


class Served(Protocol):
    """A game, or a part of a world on many processes, as a server serves it."""

    faults: FaultReporter
    scene: Scene

    @property
    def world(self) -> RecordedWorld:
        """The world."""
        ...

    @property
    def kept(self) -> PersistedState:
        """The persisted state."""
        ...

    @property
    def players(self) -> dict[int, Player]:
        """Players by entity."""
        ...

    def stats(self) -> dict[str, Any]:
        """Returns figures for `/stats`."""
        ...

    def shut_down(self, reason: str, wait: float) -> None:
        """Closes all connections."""

    def open(self, link: Any, now: float) -> Any:
        """Handles an open WebSocket."""

    def receive(self, session: Any, data: bytes, now: float) -> None:
        """Handles one message."""

    def lost(self, session: Any, now: float) -> None:
        """Handles the end of a WebSocket."""


class Serving:
    """The parts of a server around what it serves: gateway, admission, pages, watchdog, signals and shutdown.

    Args:
        settings: the settings.
        served: what it serves.
        routes: whether `_route` decides where a WebSocket leads, and `_page` answers requests for further pages.
        play: the page to play on; None: there is none.
    """

    def __init__(
        self, settings: Settings, served: Served, *, routes: bool = False, play: PlayPages | None = None
    ) -> None:
        self.settings, self.served, self._play = settings, served, play
        self.faults = served.faults
        live = Live(served, self.stats, self._durations).pages() if settings.page else {}
        self.admission = Admission(
            settings.limits,
            Pages(
                {"/readyz": ready_page(self.unready)},
                {
                    "/stats": json_page(self.stats),
                    "/metrics": metrics_page(self.stats, self._durations, self._metrics),
                    **live,
                },
                self.faults.report,
                self._any_page if routes or play else None,
            ),
            figures=settings.figures,
            origins=settings.allowed_origins,
            hosts=(settings.host, *settings.allowed_hosts),
            closing=lambda: settings.restart_s if self.draining else None,
        )
        self.gateway = Gateway(served, self.admission, self.faults, self._route if routes else None)
        self.watchdog: Watchdog | None = None
        self.draining = False
        self.started = time.monotonic()
        self._stop: asyncio.Future[tuple[str, int]] | None = None

    async def serve(self) -> int:
        """Listens and works until a signal or a failure, then closes all connections. Returns the exit code."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._loop_failed)
        self._stop = loop.create_future()
        with on_signals(loop, self._signal):
            address, port = await self._listen(tls_context(self.settings))
            self.watchdog = Watchdog(loop)
            tasks = Tasks(loop, self.settings.limits.load_s)
            self._begin(loop, tasks, port)
            kind = type(loop).__module__.partition(".")[0]
            scene, auth, form = self.served.scene, self.settings.auth, self.served.world.kernel.form
            rate = scene.tick_rate
            logger.info("started", scene=scene.name, tick_rate=rate, loop=kind, auth=auth, kernel=form)
            secure, host = "" if self.settings.tls_cert is None else "s", self.settings.host
            print(f"listening on ws{secure}://{bracketed(host)}:{port}", flush=True)
            if self.settings.page and self.admission.trusted(reachable(address)):
                print(f"live page at http{secure}://{bracketed(reachable(host))}:{port}/", flush=True)
            if self._play is not None and self._play.ready:
                print(f"play in a browser at http{secure}://{bracketed(reachable(host))}:{port}/play", flush=True)
            reason, code = await self._stop
        self.watchdog.stop()
        tasks.stop()
        logger.info("stopping", reason=reason, connections=len(self.gateway.connections))
        await self._drain()
        logger.info("stopped", after_s=round(time.monotonic() - self.started))
        return code

    def _begin(self, loop: asyncio.AbstractEventLoop, tasks: Tasks, port: int) -> None:
        """Begins the work, once the server listens."""
        raise NotImplementedError

    def _end_work(self) -> None:
        """Ends the work, before the connections are closed."""
        raise NotImplementedError

    def _close(self) -> None:
        """Closes what is still open, after all connections."""

    async def _drain(self) -> None:
        """Sends every client the order to reconnect later, and waits at most `STOP_S` until all have closed."""
        self.draining = True
        self._end_work()
        self.served.shut_down("the server is going down", self.settings.restart_s)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.gateway.drained(), STOP_S)
        self.gateway.stop_listening()  # last, so that `/readyz` answers "draining" until the end
        self._close()

    def unready(self) -> str:
        """Returns the reason why this server should get no new players; empty if it is ready."""
        raise NotImplementedError

    def stats(self) -> dict[str, Any]:
        """Returns the figures of `/stats`."""
        return {
            **self.served.stats(),
            **self._figures(),
            "connections": len(self.gateway.connections),
            "refused_at_door": dict(self.admission.refused),
            "internal_errors": self.faults.total,
            "stalls": 0 if self.watchdog is None else self.watchdog.stalls,
            "ready": not self.unready(),
            "uptime_s": round(time.monotonic() - self.started, 3),
            "cpu_s": round(time.process_time(), 3),
            "rss_mb": round(rss_mb(), 1),
            "pid": os.getpid(),
        }

    def _figures(self) -> dict[str, Any]:
        """Returns figures of the work."""
        return {}

    def _durations(self) -> dict[str, Histogram]:
        """Returns histograms by the names of their metrics."""
        return {}

    def _metrics(self) -> Iterator[Metric]:
        """Yields further metrics."""
        yield from ()

    def _any_page(self, request: PageRequest) -> Page | None:
        page = None if self._play is None else self._play.get(request)
        return page or self._page(request)

    def _page(self, request: PageRequest) -> Page | None:
        return None

    def _route(self, target: str, address: str) -> Events | Page:
        return STARTING

    async def _listen(self, tls: ssl.SSLContext | None) -> tuple[str, int]:
        host, port = self.settings.host, self.settings.port
        try:
            return await self.gateway.listen(host, port, tls)
        except (OSError, UnicodeError) as error:  # UnicodeError: the host is not even a host name
            reason = f"cannot listen ({getattr(error, 'strerror', None) or error})"
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                reason = "in use by another program; end that one or choose another --port (0: any free one)"
            raise SettingsError(f"host = {host!r}, port = {port}: {reason}") from error

    def _signal(self, name: str) -> None:
        """Ends the server at a signal."""
        self._end(name, 0)

    def _end(self, reason: str, code: int) -> None:
        if self._stop is not None and not self._stop.done():
            self._stop.set_result((reason, code))

    def _loop_failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Counts and logs a failure in the event loop: an exception of ours, or that no file descriptor is free."""
        error = context.get("exception")
        self.faults.total += 1
        logger.error(context["message"], error=repr(error), exc_info=None if isinstance(error, OSError) else error)


class Server(Serving):
    """A server with one game, and with further worlds if the settings declare kinds.

    Args:
        settings: the settings.
        game: the game of the default world.
        store: the store of the default world; None: it is not saved.
        declared: what further worlds need; None: there are none.
        play: the page to play on; None: there is none.
    """

    def __init__(
        self,
        settings: Settings,
        game: Game,
        store: Store | None = None,
        declared: Declared | None = None,
        play: PlayPages | None = None,
    ) -> None:
        self.game, self.store, self._declared = game, store, declared
        self.hosting: Hosting | None = None
        """The worlds besides the default one, from the start on; None: there are none."""
        self.ticker: Ticker | None = None
        super().__init__(settings, game, routes=declared is not None, play=play)

    def _begin(self, loop: asyncio.AbstractEventLoop, tasks: Tasks, port: int) -> None:
        if self.store is not None:
            self.store.start(self.game.keep)
        self.ticker = Ticker(
            self.game.scene.tick_rate,
            self.game.tick,
            self._broken,
            lambda ring: best_alarm(loop, ring),
            self.faults,
            yields=self._declared is not None,
        )
        self.game.joining.run = tasks.run
        freeze()
        if self._declared is not None:
            self._host(self._declared, tasks)

    def _host(self, declared: Declared, tasks: Tasks) -> None:
        """Begins the worlds besides the default one."""
        self._new_hosting(declared, tasks).start()

    def _new_hosting(self, declared: Declared, tasks: Tasks, **classes: Any) -> "Hosting":
        """Makes `hosting`, with other classes for its parts if they are given, and returns it."""
        from server.hosting.hosting import Hosting

        raise_descriptors()
        self.hosting = Hosting(
            self.settings,
            declared.kinds,
            declared.terrain,
            self.game,
            tasks,
            token=declared.token,
            faults=self.faults,
            stop=lambda reason: self._end(reason, 0),
            **classes,
        )
        return self.hosting

    def _end_work(self) -> None:
        if self.ticker is not None:
            self.ticker.stop()
        if self.hosting is not None:
            self.hosting.shut_down("the server is going down", self.settings.restart_s)

    def _close(self) -> None:
        if self.hosting is not None:
            self.hosting.host.close()

    def unready(self) -> str:
        if self.draining or (self.hosting is not None and self.hosting.worlds.draining):
            return "draining"
        if self.ticker is None:
            return "starting"
        if self.store is not None and self.store.trouble:
            return f"cannot save: {self.store.trouble}"
        if self.hosting is not None and (trouble := self.hosting.host.trouble()):
            return trouble
        age = time.monotonic() - self.ticker.latest
        return f"the last tick began {age:.1f} s ago" if age > READY_S else ""

    def stats(self) -> dict[str, Any]:
        errors = self.faults.total + (0 if self.store is None else self.store.faults.total)
        return {**super().stats(), "internal_errors": errors}

    def _figures(self) -> dict[str, Any]:
        return {
            **({} if self.ticker is None else self.ticker.stats()),
            **({} if self.store is None else self.store.stats()),
            **({} if self.hosting is None else self.hosting.stats()),
        }

    def _durations(self) -> dict[str, Histogram]:
        if self.ticker is None:
            return {}
        return {"tick_lateness_seconds": self.ticker.lateness, "tick_work_seconds": self.ticker.work}

    def _metrics(self) -> Iterator[Metric]:
        if self.hosting is not None:
            yield from self.hosting.pages.metrics()

    def _page(self, request: PageRequest) -> Page | None:
        return None if self.hosting is None else self.hosting.page(request)

    def _route(self, target: str, address: str) -> Events | Page:
        return STARTING if self.hosting is None else self.hosting.route(target, address)

    def _signal(self, name: str) -> None:
        """Ends the server at a signal. Worlds go on for a while if the settings say so."""
        if self.hosting is not None and self.settings.drain_s and not self.hosting.worlds.draining:
            self.hosting.drain()
        else:
            self._end(name, 0)

    def _broken(self) -> None:
        self._end("too many ticks in a row have failed", 1)
