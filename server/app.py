"""The composition root: makes a server from settings, runs it until a signal, and shuts it down."""

import asyncio
import contextlib
import dataclasses
import errno
import os
import signal
import ssl
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import structlog
from prometheus_client.core import Metric

from server import describe
from server.auth.access import authenticator, operator_token, tls_context
from server.config.options import SettingsError, nearest
from server.config.settings import Settings, parse
from server.game import Game
from server.net.addresses import bracketed, reachable
from server.net.admission import Admission
from server.net.gateway import Events, Gateway
from server.observability.histogram import Histogram
from server.observability.live import Live
from server.observability.metrics import metrics_page
from server.observability.pages import Page, PageRequest, Pages, json_page, line, ready_page
from server.persistence.database import StoreError
from server.persistence.store import Store
from server.rules import Rules, RulesError, load_rules, prepared
from server.runtime import healthcheck, log, reload
from server.runtime.event_loop import (
    announce_compiling,
    freeze,
    leave,
    loop_factory,
    on_signals,
    raise_descriptors,
    rss_mb,
    signals,
)
from server.runtime.keeping import recorded, saved
from server.runtime.tasks import Tasks
from server.runtime.terrain import TerrainPool
from server.runtime.ticker import Ticker, best_alarm
from server.runtime.warmup import warm_up
from server.runtime.watchdog import Watchdog
from shared import kernels
from shared.checks import SceneError
from shared.scene import load_scene

if TYPE_CHECKING:
    from server.hosting.hosting import Hosting
    from server.worlds.kinds import Kind

READY_S = 1.0
"""Seconds. The server is ready if a tick began within this time."""


def _token(arguments: Sequence[str]) -> int:
    from server.auth import tokens  # its library takes a tenth of a server's start

    return tokens.main(arguments)


def _worlds(arguments: Sequence[str]) -> int:
    from server.hosting import command  # a server with one world does not need it

    return command.main(arguments)


COMMANDS = {"token": _token, "check": healthcheck.main, "describe": describe.main, "worlds": _worlds}
"""Functions of the other commands of `sovereign-server`, by name."""
STOP_S = 1.5
"""Seconds that the shutdown waits for peers to finish closing. With the wait for the disk it takes less than 5 s."""

STARTING = line(503, "the server is starting", retry_after="1")

logger = structlog.stdlib.get_logger("server")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a server until a signal, or runs another command. Returns the exit code.

    Args:
        arguments: the command line without the program's name; None: that of this process.
    """
    for number in signals():
        signal.signal(number, leave)  # until the event loop takes over
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments and not arguments[0].startswith("-"):
            return command(arguments[0])(arguments[1:])
        settings = parse(arguments)
        if isinstance(settings, str):
            print(settings, end="")
            return 0
        return reload.serve(settings, arguments) if settings.reload else run(settings)
    except (SettingsError, SceneError, StoreError, RulesError) as error:
        print("error:", *str(error).split(), file=sys.stderr)
        return 2


def command(name: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a command other than the server itself; it takes arguments and returns the exit code.

    Raises:
        SettingsError: there is no such command.
    """
    if name not in COMMANDS:
        *others, last = COMMANDS
        there = f"{', '.join(others)} and {last}"
        raise SettingsError(
            f"{name!r}: no such command{nearest(name, COMMANDS)}; the commands are {there}; "
            "to start a server, give only flags (--help)"
        )
    return COMMANDS[name]


def run(settings: Settings) -> int:
    """Serves the default world, and many others if the settings declare kinds, until a signal. Returns the exit code.

    Raises:
        RulesError: the rules cannot be used.
        SceneError: the scene cannot be used.
        SettingsError: the address or one of the files cannot be used.
        StoreError: the saved world cannot be used.
    """
    log.set_up(settings.log_level, settings.log_format, sys.stderr)
    authenticate = authenticator(settings)
    rules = Rules() if settings.game is None else load_rules(settings.game, settings.options)
    scene = load_scene(settings.scene if "scene" in settings.origins else rules.scene or settings.scene)
    if settings.tick_rate is not None:
        scene = dataclasses.replace(scene, tick_rate=settings.tick_rate)
    if settings.reach is not None:
        scene = dataclasses.replace(scene, reach=settings.reach)
    scene = prepared(rules, scene)
    kinds, token = {}, operator_token(settings.operator_token_file, os.environ)
    if settings.worlds:
        from server.hosting.declared import declared_kinds  # a server with one world does not need its libraries

        kinds = declared_kinds(settings)
    kernels.force(settings.kernel)
    if settings.kernel == kernels.AUTO and kernels.trouble():
        logger.warning("the physics is slower, or has to be compiled", kernel=kernels.describe())
    with kernels.compiling(lambda: announce_compiling(sys.stderr)):
        terrain = TerrainPool()
        world = warm_up(scene, terrain.world(scene) if kinds else None)
        for other in {kind.scene.fingerprint: kind.scene for kind in kinds.values()}.values():
            warm_up(other, terrain.world(other))
    with asyncio.Runner(loop_factory=loop_factory()) as runner, contextlib.ExitStack() as stack:
        store = None
        if settings.data is not None:
            store = stack.enter_context(saved(scene, settings))
            world = store.world
        if settings.record is not None:
            world = stack.enter_context(recorded(scene, settings.record, world))
        game = Game(
            scene,
            limits=settings.limits,
            world=world,
            saves=store,
            rules=rules,
            seed=settings.seed,
            authenticate=authenticate,
        )
        more = Declared(kinds, terrain, token) if kinds else None
        return runner.run(Server(settings, game, store, more).serve())


class Declared(NamedTuple):
    """The declared kinds of worlds, the terrain that worlds share, and the token of operators (empty: none)."""

    kinds: "Mapping[str, Kind]"
    terrain: TerrainPool
    token: str


class Server:
    """All parts of a running server, with their start and their end.

    Args:
        settings: the settings.
        game: the game of the default world.
        store: the store of the default world; None: it is not saved.
        declared: what further worlds need; None: there are none.
    """

    def __init__(
        self, settings: Settings, game: Game, store: Store | None = None, declared: Declared | None = None
    ) -> None:
        self.settings = settings
        self.hosting: Hosting | None = None
        """The worlds besides the default one, from the start on; None: there are none."""
        self._declared = declared
        self.game = game
        self.store = store
        self.faults = game.faults
        live = Live(game, self.stats, self._durations).pages() if settings.page else {}
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
                self._page if declared else None,
            ),
            figures=settings.figures,
            origins=settings.allowed_origins,
            hosts=(settings.host, *settings.allowed_hosts),
            closing=lambda: settings.restart_s if self.draining else None,
        )
        self.gateway = Gateway(game, self.admission, self.faults, self._route if declared else None)
        self.ticker: Ticker | None = None
        self.watchdog: Watchdog | None = None
        self.draining = False
        self.started = time.monotonic()
        self._stop: asyncio.Future[tuple[str, int]] | None = None

    async def serve(self) -> int:
        """Listens and ticks until a signal or a failure, then closes all connections. Returns the exit code."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._loop_failed)
        self._stop = loop.create_future()
        with on_signals(loop, self._signal):
            address, port = await self._listen(tls_context(self.settings))
            rate = self.game.scene.tick_rate
            if self.store is not None:
                self.store.start(self.game.keep)
            self.ticker = Ticker(
                rate,
                self.game.tick,
                self._broken,
                lambda ring: best_alarm(loop, ring),
                self.faults,
                yields=self._declared is not None,
            )
            self.watchdog = Watchdog(loop)
            tasks = Tasks(loop, self.settings.limits.load_s)
            self.game.joining.run = tasks.run
            freeze()
            if self._declared is not None:
                self._host(self._declared, tasks)
            kind = type(loop).__module__.partition(".")[0]
            scene, auth, form = self.game.scene.name, self.settings.auth, self.game.world.kernel.form
            logger.info("started", scene=scene, tick_rate=rate, loop=kind, auth=auth, kernel=form)
            secure, host = "" if self.settings.tls_cert is None else "s", self.settings.host
            print(f"listening on ws{secure}://{bracketed(host)}:{port}", flush=True)
            if self.settings.page and self.admission.trusted(reachable(address)):
                print(f"live page at http{secure}://{bracketed(reachable(host))}:{port}/", flush=True)
            reason, code = await self._stop
        self.watchdog.stop()
        tasks.stop()
        logger.info("stopping", reason=reason, connections=len(self.gateway.connections))
        await self._drain()
        logger.info("stopped", after_s=round(time.monotonic() - self.started))
        return code

    def _host(self, declared: Declared, tasks: Tasks) -> None:
        """Begins the worlds besides the default one."""
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
        )
        self.hosting.start()

    async def _drain(self) -> None:
        """Sends every client the order to reconnect later, and waits at most `STOP_S` until all have closed."""
        self.draining = True
        if self.ticker is not None:
            self.ticker.stop()
        if self.hosting is not None:
            self.hosting.shut_down("the server is going down", self.settings.restart_s)
        self.game.shut_down("the server is going down", self.settings.restart_s)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.gateway.drained(), STOP_S)
        self.gateway.stop_listening()  # last, so that `/readyz` answers "draining" until the end
        if self.hosting is not None:
            self.hosting.host.close()

    def unready(self) -> str:
        """Returns the reason why this server should get no new players; empty if it is ready."""
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
        """Returns the figures of `/stats`."""
        figures = {} if self.ticker is None else self.ticker.stats()
        return {
            **self.game.stats(),
            **figures,
            **({} if self.store is None else self.store.stats()),
            **({} if self.hosting is None else self.hosting.stats()),
            "connections": len(self.gateway.connections),
            "refused_at_door": dict(self.admission.refused),
            "internal_errors": self.faults.total + (0 if self.store is None else self.store.faults.total),
            "stalls": 0 if self.watchdog is None else self.watchdog.stalls,
            "ready": not self.unready(),
            "uptime_s": round(time.monotonic() - self.started, 3),
            "cpu_s": round(time.process_time(), 3),
            "rss_mb": round(rss_mb(), 1),
            "pid": os.getpid(),
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
        """Ends the server at a signal. Worlds go on for a while if the settings say so."""
        if self.hosting is not None and self.settings.drain_s and not self.hosting.worlds.draining:
            self.hosting.drain()
        else:
            self._end(name, 0)

    def _end(self, reason: str, code: int) -> None:
        if self._stop is not None and not self._stop.done():
            self._stop.set_result((reason, code))

    def _broken(self) -> None:
        self._end("too many ticks in a row have failed", 1)

    def _loop_failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Counts and logs a failure in the event loop: an exception of ours, or that no file descriptor is free."""
        error = context.get("exception")
        self.faults.total += 1
        logger.error(context["message"], error=repr(error), exc_info=None if isinstance(error, OSError) else error)
