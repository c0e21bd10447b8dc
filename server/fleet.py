"""A server that is one of a fleet: its worlds, and the keys of the bus that join it to the others."""

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Mapping

from server.auth.tokens import time_of_day
from server.cluster.bus import Bus, BusError, ConflictError
from server.config.options import SettingsError
from server.config.settings import Settings
from server.extras import install
from server.game import Game
from server.hosting.fleet_host import FleetWorldHost
from server.net.addresses import bracketed, reachable
from server.play.play import PlayPages
from server.runtime.tasks import Tasks
from server.serving import Declared, Server
from server.worlds.fleet import Fleet
from server.worlds.fleet_entries import WorldEntry
from server.worlds.fleet_view import Failed, Result, Value
from server.worlds.fleet_worlds import FleetWorlds
from server.worlds.lease import Request

ANSWER_S = 3.0
"""Seconds after which a request to the bus counts as unanswered."""
AGAIN_S = 0.5
"""Seconds between two attempts to watch the keys."""
END_S = 2.0
"""Seconds that the shutdown waits until the worlds are given up."""
SIGNS = "abcdefghijkmnpqrstuvwxyz23456789"
"""Characters of the identifiers of processes."""
KEY_BYTES = 32
"""Size of the key of the seats."""

logger = logging.getLogger(__name__)


class FleetServer(Server):
    """A server of a fleet. Arguments as for `Server`, and `bus` and `key`, the key of the seats."""

    def __init__(
        self,
        settings: Settings,
        game: Game,
        declared: Declared,
        play: PlayPages | None,
        *,
        bus: Bus,
        key: bytes,
        keys: Mapping[str, Value],
    ) -> None:
        self._bus, self._key, self._keys = bus, key, keys
        self._port, self._begun = 0, False
        self._requests: set[asyncio.Task[None]] = set()
        self._watching: asyncio.Task[None] | None = None
        super().__init__(settings, game, None, declared, play)

    def _begin(self, loop: asyncio.AbstractEventLoop, tasks: Tasks, port: int) -> None:
        self._port = port
        super()._begin(loop, tasks, port)

    def _host(self, declared: Declared, tasks: Tasks) -> None:
        settings = self.settings
        hosting = self._new_hosting(declared, tasks, host_of=FleetWorldHost, worlds_of=FleetWorlds)
        worlds, host = hosting.worlds, hosting.host
        assert isinstance(worlds, FleetWorlds)
        assert isinstance(host, FleetWorldHost)
        assert settings.fleet is not None
        secure = "" if settings.tls_cert is None else "s"
        url = settings.public_url or f"ws{secure}://{bracketed(reachable(settings.host))}:{self._port}"
        worlds.join(settings.fleet, url, host, key=self._key, clock=clock, wall=time_of_day, token=token)
        host.owned = worlds.owns
        self._fleet_worlds = worlds
        for name, value in self._keys.items():
            worlds.fleet.news(name, value, clock())
        hosting.looked = self._looked
        hosting.look()
        self._watching = asyncio.get_running_loop().create_task(self._watch())
        self._watching.add_done_callback(self._watched)

    @property
    def _fleet(self) -> Fleet:
        return self._fleet_worlds.fleet

    def unready(self) -> str:
        return super().unready() or ("" if self._fleet.holds(clock()) else "the bus of the fleet does not answer")

    # -- the keys ----------------------------------------------------------------------------------------------

    def _looked(self) -> None:
        """Sends what the fleet asks. Begins the worlds that are saved or named once this process has a lease."""
        if not self._begun and self._fleet.holds(clock()):
            self._begun = True
            self._begin_worlds()
        self._send()

    def _send(self) -> None:
        """Sends the requests of the fleet."""
        requests, self._fleet.requests = self._fleet.requests, []
        for request in requests:
            task = asyncio.get_running_loop().create_task(self._ask(request))
            self._requests.add(task)
            task.add_done_callback(self._requests.discard)

    async def _ask(self, request: Request) -> None:
        result: Result
        try:
            result = await asyncio.wait_for(self._result(request), ANSWER_S)
        except ConflictError:
            result = Failed(True)
        except (BusError, TimeoutError):
            result = Failed(False)
        try:
            self._fleet.answered(request, result, clock())
            self._send()
        except Exception:
            self.faults.report("an answer of the bus")

    async def _result(self, request: Request) -> Result:
        if request.what == "put":
            return await self._bus.put(request.key, request.value, request.revision)
        if request.what == "get":
            found = await self._bus.get(request.key)
            return None if found is None else Value(*found)
        await self._bus.delete(request.key, request.revision)
        return None

    async def _watch(self) -> None:
        """Takes all changes of the keys."""
        while True:
            try:
                async for key, found in self._bus.watch(self._fleet.prefix):
                    self._fleet.news(key, None if found is None else Value(*found), clock())
                    self._send()
            except BusError as error:
                logger.warning("the keys of the fleet cannot be watched: %s", error)
            await asyncio.sleep(AGAIN_S)

    def _watched(self, watching: asyncio.Task[None]) -> None:
        """Ends the server if the keys are not watched any more, because of a fault of ours."""
        if not watching.cancelled() and (error := watching.exception()) is not None:
            logger.error("the fleet has failed", exc_info=error)
            self._end("the fleet has failed", 1)

    def _begin_worlds(self) -> None:
        """Adds saved worlds that the fleet does not know, and those that the settings name."""
        assert self.hosting is not None
        files = self.hosting.host.files
        for name, (folder, saved) in ({} if files is None else files.newest()).items():
            if not self._fleet.taken(name) and saved.kind in self._fleet_worlds.kinds:
                entry = WorldEntry("", saved.kind, saved.properties, saved.code, folder, asleep=saved.asleep)
                self._fleet.give(name, "", entry)
        for kind, found in self.settings.worlds.items():
            for number in range(1, found.start + 1):
                name = kind if number == 1 else f"{kind}-{number}"
                if not self._fleet.taken(name):
                    self._fleet.give(name, self._fleet.place(kind), WorldEntry("", kind, {}, stays=True))

    # -- the end -----------------------------------------------------------------------------------------------

    async def _drain(self) -> None:
        await super()._drain()
        fleet = self._fleet
        self._fleet_worlds.release()
        until = clock() + END_S
        while fleet.busy and clock() < until:
            fleet.tick(clock())
            self._send()
            await asyncio.sleep(0.02)
        fleet.leave()
        self._send()
        if self._watching is not None:
            self._watching.cancel()
        if self._requests:
            await asyncio.wait(self._requests, timeout=1.0)


async def run_fleet(settings: Settings, game: Game, declared: Declared, play: PlayPages | None) -> int:
    """Runs a server of a fleet until a signal. Returns the exit code.

    Raises:
        SettingsError: the bus cannot be used.
    """
    try:
        from server.cluster.nats_bus import NatsBus
    except ModuleNotFoundError as error:
        raise SettingsError(f"fleet = {settings.fleet!r}: needs {error.name}: {install('scale')}") from error
    assert settings.bus is not None
    assert settings.fleet is not None
    try:
        bus = await NatsBus.connect(settings.bus, settings.fleet, replicas=settings.bus_replicas, log=False)
        try:
            key = await shared_key(bus, settings.fleet)
            found = await bus.all(f"fleet.{settings.fleet}.")
            keys = {name: Value(*value) for name, value in found.items()}
            server = FleetServer(settings, game, declared, play, bus=bus, key=key, keys=keys)
            return await server.serve()
        finally:
            await bus.close()
    except BusError as error:
        raise SettingsError(str(error)) from error


async def shared_key(bus: Bus, fleet: str) -> bytes:
    """Returns the key of the seats of a fleet, which its first process makes.

    Raises:
        BusError: the bus does not answer, or the key is not valid.
    """
    name = f"fleet.{fleet}.key"
    found = await bus.get(name)
    if found is None:
        with contextlib.suppress(ConflictError):
            await bus.put(name, secrets.token_bytes(KEY_BYTES), 0)
        found = await bus.get(name)
    if found is None or len(found.value) != KEY_BYTES:
        raise BusError(f"{name}: is no key of {KEY_BYTES} bytes")
    return found.value


def clock() -> float:
    """Returns the time in seconds, of a clock that goes on while the machine is suspended, where there is one."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


def token() -> str:
    """Returns a new random text."""
    return "".join(secrets.choice(SIGNS) for _ in range(24))
