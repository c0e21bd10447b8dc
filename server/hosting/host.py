"""The host of the worlds of one process: makes their games, runs their ticks, and keeps their files.

Theory of operation. Each world has a ticker of its own, and the deadlines are spread over the tick's time. All tickers
share one timer (`server.runtime.alarm`); a timer for each would take 30 us of each tick. A tick that takes longer than
the time between two delays other worlds by its own time at most, because its world then waits as long, and they catch
up. A world that rests has no alarm. A world of which `FAILURES_MAX` ticks in a row have failed ends alone. Terrain is
generated once for each scene, before the first world needs it. Threads make the files of new worlds, and close and
remove those of worlds that have ended, because a disk may be slow. Only a saved world that comes back is read at once.
"""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from zlib import crc32

from server.config.settings import Settings
from server.game import Game
from server.game.game import SEED_MAX
from server.game.loading import Runner
from server.hosting.files import SavedWorld, WorldFiles
from server.hosting.phases import Phases
from server.hosting.running import NamedTick, OwnedTick, RunningWorld, new_recording
from server.persistence.new_store import NewStore
from server.persistence.store import Store
from server.runtime.alarm import SharedTimer, best_alarm
from server.runtime.log import WORLD
from server.runtime.terrain import TerrainPool
from server.runtime.ticker import FAILURES_MAX, Ticker
from server.worlds.hosted import HostedWorld
from server.worlds.kinds import Kind, WorldsError
from server.worlds.worlds import Worlds

THREADS = 8
"""Number of threads that close and remove files of worlds that have ended."""

OVERRUN = "the world %s: %d ticks in a second took longer than the time between two (longest ever: %.0f ms)"

logger = logging.getLogger(__name__)


class WorldHost:
    """The host of the worlds of one process.

    Args:
        settings: the settings.
        terrain: the terrain that worlds share.
        loop: the event loop, which runs the ticks.
        run: runs coroutines of rules.
        authenticate: returns the subject of a client's token, as for `Game`.

    Raises:
        OSError: the directory of the data cannot be used.
    """

    worlds: Worlds
    """The worlds."""

    def __init__(
        self,
        settings: Settings,
        terrain: TerrainPool,
        loop: asyncio.AbstractEventLoop,
        run: Runner,
        authenticate: Callable[[str], str] | None,
    ) -> None:
        self._settings, self._terrain, self._loop, self._run = settings, terrain, loop, run
        self._authenticate = authenticate
        self.running: dict[str, RunningWorld] = {}
        """Worlds by name."""
        self._phases = Phases()
        self._timer = SharedTimer(lambda ring: best_alarm(loop, ring))
        self._power = settings.durability == "power"
        shared = settings.fleet is not None
        self.files = (
            None if settings.data is None else WorldFiles(Path(settings.data), durable=self._power, shared=shared)
        )
        """Directories of saved worlds; None: none are saved."""
        self.owned: Callable[[str], bool] | None = None
        """Whether this process has a world; None: no other process can take it."""
        self._saved: dict[str, SavedWorld] = {}  # what `world.json` is to have, by name
        self._writing = threading.Lock()  # held while a `world.json` is written or its directory is removed
        self._threads = ThreadPoolExecutor(THREADS, "files")
        self._closing: dict[str, Future[None]] = {}
        self._failed: set[str] = set()

    # -- what the worlds call ----------------------------------------------------------------------------------

    def begin(self, world: HostedWorld) -> Game:
        """Returns the game of a new world.

        Raises:
            WorldsError: it cannot be made.
        """
        closing = self._closing.get(world.name)
        if closing is not None:  # a world of this name has just ended
            closing.result()
        before = self._saved.get(world.name)
        if before is not None:
            world.locked = before.locked
        token = WORLD.set(world.name)
        try:
            with contextlib.ExitStack() as undo:
                running = self._begun(world, undo)
                undo.pop_all()
        except (OSError, ValueError) as error:
            raise WorldsError(f"the world {world.name!r} cannot be made: {' '.join(str(error).split())}") from error
        finally:
            WORLD.reset(token)
        self.running[world.name] = running
        return running.game

    def wake(self, world: HostedWorld) -> None:
        """Starts the ticks of a world."""
        self.running[world.name].ticker.resume(self._phases.take(world.name))

    def rest(self, world: HostedWorld) -> None:
        """Stops the ticks of a world."""
        self.running[world.name].ticker.stop()
        self._phases.give(world.name)

    def ended(self, world: HostedWorld, *, keep: bool) -> None:
        """Closes the files of a world that has ended. Removes them, unless `keep` is true or the world has failed."""
        name = world.name
        running = self.running.pop(name)
        running.ticker.stop()
        running.end_recording()
        failed = name in self._failed
        self._failed.discard(name)
        logger.info("world ended: %s (%s)", name, world.ending)
        if running.store is None or self.files is None:
            return
        if keep:
            self._write(world, asleep=True)
        else:
            self._saved.pop(name, None)
        running.store.end(save=keep or failed)
        self._closing[name] = self._threads.submit(self._close, name, running.store, keep, failed)

    # -- what the server calls ---------------------------------------------------------------------------------

    def restore(self, kinds: Mapping[str, Kind]) -> None:
        """Begins all saved worlds. Those that cannot be used are logged and left as they are."""
        for name, saved in () if self.files is None else self.files.saved():
            kind = kinds.get(saved.kind)
            if kind is None:
                logger.error("the saved world %s is of the kind %s, which is not declared", name, saved.kind)
                continue
            self._saved[name] = saved
            try:
                if saved.asleep:
                    self.worlds.remember(name, kind, saved.properties, saved.code)
                else:
                    self.worlds.restore(name, kind, saved.properties, saved.code)
            except WorldsError as error:
                logger.error("%s", error)
                del self._saved[name]

    def look_after(self) -> None:
        """Saves what has changed beside the stores, and reports worlds with long ticks. Call it each second."""
        for name, running in self.running.items():
            if count := running.overran():
                longest_ms = 1e3 * running.ticker.work.max_s
                logger.warning(OVERRUN, name, count, longest_ms)
        for name in [name for name, closing in self._closing.items() if closing.done()]:
            del self._closing[name]
        if self.files is not None:
            for name, running in self.running.items():
                if self.owned is None or self.owned(name):
                    self._write(running.world)

    def trouble(self) -> str:
        """Returns the reason why worlds cannot be saved; empty if they can."""
        for name, running in self.running.items():
            if running.store is not None and running.store.trouble:
                return f"cannot save the world {name}: {running.store.trouble}"
        return ""

    def stop(self) -> None:
        """Stops all ticks."""
        for running in self.running.values():
            running.ticker.stop()

    def close(self) -> None:
        """Saves all worlds and closes their files. They come back at the next start."""
        stores = []
        for running in self.running.values():
            running.end_recording()
            if running.store is not None:
                running.store.end()
                stores.append(running.store)
        with ThreadPoolExecutor(max(len(stores), 1)) as threads:  # all at once: a disk that hangs hinders them all
            for store in stores:
                threads.submit(store.close)
        self._threads.shutdown(wait=True)

    # -- inside ------------------------------------------------------------------------------------------------

    def _begun(self, world: HostedWorld, undo: contextlib.ExitStack) -> RunningWorld:
        """Makes the game of a world and what is around it. `undo` gets what releases them if it fails."""
        settings, kind = self._settings, world.kind
        rules = kind.rules()
        store = None
        if self.files is not None:
            store = self._opened(world, self.files, undo)
        game = Game(
            kind.scene,
            limits=settings.limits,
            world=self._terrain.world(kind.scene) if store is None else store.world,
            saves=store,
            rules=rules,
            seed=(settings.seed + crc32(world.name.encode())) & SEED_MAX,
            authenticate=self._authenticate,
        )
        game.joining.run = self._run
        ticker = Ticker(
            kind.scene.tick_rate,
            NamedTick(world.name, game) if self.owned is None else OwnedTick(world.name, game, self.owned),
            lambda: self._broken(world),
            self._timer.alarm,
            game.faults,
            paused=True,
            yields=True,
        )
        running = RunningWorld(world, game, ticker)
        folder = settings.worlds[kind.name].record
        if folder is not None:
            running.recording = new_recording(Path(folder), world.name)
            game.world.record(running.recording, lambda error: logger.error("a recording has ended: %s", error))
        if store is not None:
            if self.owned is not None:
                store.owned = partial(self.owned, world.name)
            store.start(game.keep)
            running.store = store
        return running

    def _opened(self, world: HostedWorld, files: WorldFiles, undo: contextlib.ExitStack) -> Store:
        """Opens the store of a world."""
        settings, scene, name = self._settings, world.kind.scene, world.name
        folder, game = files.of(name), settings.worlds[world.kind.name].game or ""
        terrain, checkpoint_s = self._terrain.of(scene), settings.checkpoint_s
        if name in self._saved:
            self._write(world)
            store = Store(folder, scene, game=game, power=self._power, checkpoint_s=checkpoint_s, terrain=terrain)
        else:
            undo.callback(self._discard, name)
            self._saved[name] = _state_of(world)
            store = NewStore(
                folder,
                scene,
                lambda: self._write_file(name),
                game=game,
                power=self._power,
                checkpoint_s=checkpoint_s,
                terrain=terrain,
            )
        undo.callback(store.close)
        undo.callback(store.end, save=False)
        return store

    def _broken(self, world: HostedWorld) -> None:
        """Ends a world whose ticks fail. Its data are set aside."""
        reason = f"{FAILURES_MAX} ticks in a row have failed"
        logger.error("the world %s ends: %s", world.name, reason)
        self._failed.add(world.name)
        self.worlds.end(world.name, reason)

    def _write(self, world: HostedWorld, *, asleep: bool = False) -> None:
        """Writes `world.json` in another thread if it has changed."""
        new = _state_of(world, asleep=asleep)
        if self._saved.get(world.name) != new:
            self._saved[world.name] = new
            self._threads.submit(self._write_in_thread, world.name)

    def _write_in_thread(self, name: str) -> None:
        try:
            self._write_file(name)
        except OSError as error:
            logger.error("cannot save the world %s: %s", name, error)

    def _write_file(self, name: str) -> None:
        """Writes the newest state of a world into its `world.json`, unless it has ended meanwhile."""
        assert self.files is not None
        with self._writing:
            saved = self._saved.get(name)
            if saved is not None:
                self.files.write(name, saved)

    def _discard(self, name: str) -> None:
        """Removes the files of a world that could not be made."""
        assert self.files is not None
        self._saved.pop(name, None)
        self.files.remove(name)

    def _close(self, name: str, store: Store, keep: bool, failed: bool) -> None:
        """Closes the files of a world in a thread. Removes them or sets them aside, if they are not kept."""
        assert self.files is not None
        try:
            store.close()
            if failed:
                logger.error("the data of the world %s are in %s now", name, self.files.set_aside(name))
            elif not keep:
                with self._writing:
                    self.files.remove(name)
        except Exception:
            logger.exception("closing the files of the world %s", name)


def _state_of(world: HostedWorld, *, asleep: bool = False) -> SavedWorld:
    """Returns what `world.json` of a world is to have."""
    return SavedWorld(world.kind.name, dict(world.properties), world.code, world.locked, asleep)
