"""Restoring: loads the world that was saved in a directory, or makes a new one."""

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgpack

from server.journal.recorded_world import RecordedWorld
from server.journal.records import NOTE, DivergedError, redo
from server.persistence import checkpoint, database
from server.persistence.checkpoint import Known
from server.persistence.database import Database, Saved, StoreError
from shared.checks import Cell
from shared.scene import Scene
from shared.world import World

logger = logging.getLogger(__name__)


class Note(NamedTuple):
    """A value that was passed to `RecordedWorld.note` before the step of tick `tick`."""

    tick: int
    value: Any


class Loaded(NamedTuple):
    """A restored or new world."""

    world: RecordedWorld
    kept: Any
    """State beside the world that the checkpoint has; None for a new world."""
    notes: list[Note]
    """Notes since the checkpoint, in order."""
    checkpoint_tick: int
    chain: int
    """Chain after the last record of the log."""
    log_bytes: int
    """Size of the log in bytes."""
    saved: dict[Cell, Known | None]
    """Segments of the checkpoint."""


def load(
    path: Path, scene: Scene, game: str = "", *, compiled: bool | None = None, terrain: World | None = None
) -> Loaded:
    """Restores a world from its checkpoint and its log, comparing each tick, or makes and saves a new one.

    Args:
        path: the database.
        scene: the scene; it must be the one with which the world was saved. Only the code of its behaviours may differ,
            if the world was saved by a clean stop.
        game: the name of the game, which must be the same, too; empty: none.
        compiled: whether the kernel is compiled, as for `World`.
        terrain: a world whose terrain is shared, as for `Store`.

    Raises:
        StoreError: the saved world cannot be used. It has not been changed.
        sqlite3.Error: the file cannot be written.
    """
    version = database.version_of(path)
    if 0 < version < len(database.MIGRATIONS):
        Database(path).close()
        logger.info("%s: migrated from schema version %d to %d", path, version, len(database.MIGRATIONS))
    saved = database.read(path) if version else None
    if saved is None:
        return _new(path, scene, game, compiled, terrain)
    if saved.game is not None and saved.game != game:
        raise StoreError(
            f"{path}: was saved by {_served(saved.game)}, and this is {_served(game)}. Start the same game, or use "
            "another directory"
        )
    try:
        former = Scene.from_table(msgpack.unpackb(saved.scene, strict_map_key=False))
        theirs = former.digests
        differ = sorted(name for name in theirs | scene.digests if theirs.get(name) != scene.digests.get(name))
        rewritten = _rewritten(former, scene) if differ == ["behaviours"] else ""
        if rewritten:
            _take_code(path, scene, saved, game, rewritten)
        elif differ:
            raise StoreError(
                f"{path}: was saved with another scene (different: {', '.join(differ)}). Start with the scene that it "
                "was saved with, or use another directory"
            )
        return _replayed(scene, saved, compiled, terrain)
    except StoreError:
        raise
    except DivergedError as error:
        raise StoreError(
            f"{path}: the replay of its log gives another world than was saved ({error}). Start it once with the "
            "version of this program that wrote it, and stop that: then there is nothing to replay"
        ) from error
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise database.damaged(path, error) from error


def _rewritten(former: Scene, scene: Scene) -> str:
    """Returns the names of the behaviours whose code has changed; empty if more of them than the code has changed."""
    before, now = ([replace(entry, digest="x") for entry in each.behaviours] for each in (former, scene))
    if before != now:
        return ""
    pairs = zip(former.behaviours, scene.behaviours, strict=True)
    return ", ".join(entry.name for entry, other in pairs if entry.digest != other.digest)


def _take_code(path: Path, scene: Scene, saved: Saved, game: str, names: str) -> None:
    """Saves the new code of behaviours with a checkpoint that no log follows.

    Raises:
        StoreError: a log follows, which only the former code can replay.
    """
    if saved.log:
        raise StoreError(
            f"{path}: the code of the behaviours {names} has changed, and the last {len(saved.log)} ticks of the saved "
            "world need the former code. Start it once with the former code, and stop that: then there is nothing to "
            "replay"
        )
    logger.warning("%s: the code of the behaviours %s has changed since it was saved", path, names)
    file = Database(path)
    try:
        file.save(saved.checkpoint._replace(segments=[]), msgpack.packb(scene.to_table()), saved.chain, game)
    finally:
        file.close()


def _served(game: str) -> str:
    return f"a server of the game {game}" if game else "a server without a game"


def _new(path: Path, scene: Scene, game: str, compiled: bool | None, terrain: World | None) -> Loaded:
    world, first = checkpoint.generated(scene, compiled=compiled, terrain=terrain)
    file = Database(path)
    try:
        file.save(first, msgpack.packb(scene.to_table()), 0, game)
    finally:
        file.close()
    return Loaded(world, None, [], world.tick, 0, 0, checkpoint.saved_of(world))


def _replayed(scene: Scene, saved: Saved, compiled: bool | None, terrain: World | None) -> Loaded:
    world = checkpoint.restored(scene, saved.checkpoint, compiled=compiled, terrain=terrain)
    known = checkpoint.saved_of(world)  # before the log, because segments that it touches go into the next checkpoint
    notes: list[Note] = []
    chain = saved.chain
    for tick, record, chain in saved.log:  # noqa: B007 - the last chain is used below
        moment = redo(world, msgpack.unpackb(record))
        if world.tick != tick:
            raise ValueError(f"tick {world.tick} is in the log as tick {tick}")
        packed = (call[1] for call in moment.calls if call[0] == NOTE)
        notes += [Note(tick, msgpack.unpackb(value, strict_map_key=False)) for value in packed]
    kept = msgpack.unpackb(saved.checkpoint.kept, strict_map_key=False)
    size = sum(len(record.record) for record in saved.log)
    return Loaded(world, kept, notes, saved.checkpoint.tick, chain, size, known)


def claimed(directory: Path) -> BinaryIO:
    """Reserves a directory for this process. Returns a lock file; closing it, or the end of the process, releases it.

    Raises:
        StoreError: another process has the directory, or it cannot be used.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        file = (directory / "lock").open("ab")
    except OSError as error:
        raise StoreError(f"{directory}: cannot be used ({error.strerror or error})") from error
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise StoreError(f"{directory}: another server is using it") from error
    return file
