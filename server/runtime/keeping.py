"""The files of the default world: its store, and the recording of it."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from server.config.options import SettingsError
from server.config.settings import Settings
from server.journal.recorded_world import RecordedWorld
from server.persistence.store import Store
from server.runtime.structured import structlog
from shared.scene import Scene

logger = structlog.stdlib.get_logger("server")


@contextlib.contextmanager
def saved(scene: Scene, settings: Settings) -> Iterator[Store]:
    """Opens the store in the directory `settings.data`. Its world is saved completely at the end of the context.

    Raises:
        StoreError: the directory or the world in it cannot be used.
    """
    assert settings.data is not None
    power = settings.durability == "power"
    store = Store(settings.data, scene, game=settings.game or "", power=power, checkpoint_s=settings.checkpoint_s)
    tick, state_hash = store.restored
    found = tick > 0 or store.kept is not None
    logger.info("restored" if found else "a new world", directory=settings.data, tick=tick, state_hash=state_hash)
    try:
        yield store
    finally:
        store.close()


@contextlib.contextmanager
def recorded(scene: Scene, path: str, world: RecordedWorld | None = None) -> Iterator[RecordedWorld]:
    """Records the changes of a world into a new file. The recording ends with the context.

    Args:
        path: of the file.
        world: the world to record; None: a new one with the terrain of the scene.

    Raises:
        SettingsError: the file exists or cannot be written.
    """
    try:
        file = Path(path).open("xb")  # noqa: SIM115 - closing may fail on a full disk, which has been logged by then
    except FileExistsError:
        raise SettingsError(f"record = {path!r}: exists already, and a recording is never overwritten") from None
    except OSError as error:
        raise SettingsError(f"record = {path!r}: cannot be written ({error.strerror or error})") from error
    if world is None:
        world = RecordedWorld(scene)
        world.load_terrain()
    try:
        world.record(file, lambda error: logger.error("recording has ended", path=path, error=str(error)))
        yield world
        world.end_recording()
    finally:
        with contextlib.suppress(OSError):
            file.close()
