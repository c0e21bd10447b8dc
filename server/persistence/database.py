"""The file of a saved world, in SQLite: its schema, how one schema becomes the next, and what is refused.

    world      one row: the newest checkpoint, without its blocks, and which game it is of (NULL: not known)
    segment    every loaded segment as of that checkpoint; kinds is NULL where they are as the generator makes them
    log        what each tick since then was told: the record that a recording has for it (`server.journal`)

`chain` is the CRC-32 of a record, begun with the one before (the first one: with the checkpoint's), so no record can be
lost, doubled or changed in between. That nothing is lost at the end is what `server.persistence.mark` and
`server.persistence.wal` are for. `seal` is a BLAKE2b of the checkpoint's columns but for the states: those and the
segments are what `hash`, the world's own, is about; and but for the game, which may get another name. While a server
runs, anyone may read the file with SQLite.
"""

import contextlib
import hashlib
import logging
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from server.persistence import mark, wal
from server.persistence.checkpoint import Checkpoint
from server.persistence.mark import Mark
from shared.checks import Cell

logger = logging.getLogger(__name__)

APPLICATION_ID = 0x534E5731
"""The bytes "SNW1" in the header of the file."""

MIGRATIONS: list[tuple[str, ...]] = [
    (
        """CREATE TABLE world (
            id INTEGER PRIMARY KEY CHECK (id = 1), tick INTEGER NOT NULL, next_id INTEGER NOT NULL,
            states BLOB NOT NULL, hash BLOB NOT NULL, kept BLOB NOT NULL,
            chain INTEGER NOT NULL, scene BLOB NOT NULL, seal BLOB NOT NULL)""",
        """CREATE TABLE segment (
            x INTEGER NOT NULL, y INTEGER NOT NULL, z INTEGER NOT NULL, kinds BLOB, digest INTEGER NOT NULL,
            PRIMARY KEY (x, y, z))""",
        "CREATE TABLE log (tick INTEGER PRIMARY KEY, record BLOB NOT NULL, chain INTEGER NOT NULL)",
        f"PRAGMA application_id = {APPLICATION_ID}",
    ),
    ("ALTER TABLE world ADD COLUMN game TEXT",),
    (  # without the column `digest`; and `hash` is of another kind from here on, which its length tells
        """CREATE TABLE segments (
            x INTEGER NOT NULL, y INTEGER NOT NULL, z INTEGER NOT NULL, kinds BLOB, PRIMARY KEY (x, y, z))""",
        "INSERT INTO segments SELECT x, y, z, kinds FROM segment",
        "DROP TABLE segment",
        "ALTER TABLE segments RENAME TO segment",
    ),
]
"""Entry n takes schema version n to n + 1; version 0 is an empty file."""


class StoreError(ValueError):
    """Saved data that cannot be used; the message names the file and says what to do. The file is as it was."""


class Record(NamedTuple):
    """What a tick was told, as it lies in the log."""

    tick: int
    record: bytes
    chain: int


def chained(record: bytes, chain: int) -> int:
    """The chain after a record."""
    return zlib.crc32(record, chain)


def damaged(path: Path, reason: object) -> StoreError:
    """The error of a file that is not as it was written."""
    return StoreError(
        f"{path}: damaged ({reason}). It has been left as it is: put a backup of its directory in its place, or move "
        "it away to begin a new world"
    )


class Saved(NamedTuple):
    """What a file holds."""

    checkpoint: Checkpoint
    scene: bytes
    game: str | None
    chain: int
    log: list[Record]


def mark_of(path: Path) -> Path:
    """The file with the mark of a world's file."""
    return path.with_suffix(".mark")


def version_of(path: Path) -> int:
    """The schema version of a file; 0 if there is nothing in it.

    Raises:
        StoreError: it is not a saved world, of a newer version, or damaged.
    """
    for beside in (path.with_name(path.name + "-wal"), mark_of(path)):
        if beside.exists() and not (path.exists() and path.stat().st_size):
            raise damaged(path, f"it is {'empty' if path.exists() else 'missing'}, and {beside.name} is there")
    if not path.exists():
        return 0
    promised = _promised(path)
    with _reading(path) as connection:
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        tables = connection.execute("SELECT name FROM sqlite_schema").fetchall()
        if not tables and not application and not version:
            return 0
        if application != APPLICATION_ID:
            raise StoreError(f"{path}: not a saved world, but another SQLite file. It has been left as it is")
        if not 1 <= version <= len(MIGRATIONS):
            raise StoreError(
                f"{path}: in schema version {version}, and this program knows those up to {len(MIGRATIONS)}. It has "
                "been left as it is: use the program that wrote it, or a newer one"
            )
        (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise damaged(path, found)
        reason = wal.damage(path) if promised is None or promised.binding else ""
        if reason:
            raise damaged(path, reason)
        return int(version)


def read(path: Path) -> Saved | None:
    """All that a file of the newest version holds; None if there is no world in it yet. Nothing is written.

    Raises:
        StoreError: it is damaged.
    """
    with _reading(path) as connection:
        columns = "tick, next_id, states, hash, kept, chain, scene, seal, game"
        row = connection.execute(f"SELECT {columns} FROM world").fetchone()
        segments = connection.execute("SELECT x, y, z, kinds FROM segment ORDER BY z, y, x").fetchall()
        log = [Record(*each) for each in connection.execute("SELECT tick, record, chain FROM log ORDER BY tick")]
        if row is None:
            if segments or log:
                raise damaged(path, "it has no checkpoint")
            return None
        tick, next_id, states, checked, kept, chain, scene, seal, game = row
        checkpoint = Checkpoint(tick, next_id, states, checked, kept, segments, [])
        if seal != seal_of(checkpoint, scene, chain):
            raise damaged(path, "the checkpoint does not match its seal")
        found = chain
        for record in log:
            found = chained(record.record, found)
            if found != record.chain:
                raise damaged(path, f"tick {record.tick} of the log does not match its check")
        saved = Saved(checkpoint, scene, game, chain, log)
    _check_end(path, saved)
    return saved


class Database:
    """A file that is open for writing; it is made if it is not there, and brought to the newest version if it is older.

    Args:
        power: what has been written survives a power cut, too (one fsync per transaction), not just the process's end.

    Raises:
        sqlite3.Error: it cannot be written. So do all methods; then it has to be opened anew.
    """

    def __init__(self, path: Path, *, power: bool = True) -> None:
        self._mark = mark.MarkFile(mark_of(path), power=power)
        self._connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        try:
            self._run("PRAGMA journal_mode = WAL", "PRAGMA wal_autocheckpoint = 0", "PRAGMA busy_timeout = 100")
            self._run(f"PRAGMA synchronous = {'FULL' if power else 'NORMAL'}")
            (version,) = self._connection.execute("PRAGMA user_version").fetchone()
            for number in range(version, len(MIGRATIONS)):
                with self._transaction():
                    self._run(*MIGRATIONS[number], f"PRAGMA user_version = {number + 1}")
        except BaseException:
            self.close()
            raise

    def seal(self) -> bytes:
        """The seal of the checkpoint; empty if there is none."""
        row = self._connection.execute("SELECT seal FROM world").fetchone()
        return b"" if row is None else bytes(row[0])

    def segments(self) -> list[Cell]:
        """The index of every segment that is saved."""
        return self._connection.execute("SELECT x, y, z FROM segment").fetchall()

    def append(self, records: Sequence[Record]) -> None:
        """Adds to the log, all or nothing."""
        with self._transaction():
            self._connection.executemany("INSERT INTO log VALUES (?, ?, ?)", records)
        self._mark.write(records[-1].tick, records[-1].chain)

    def save(self, checkpoint: Checkpoint, scene: bytes, chain: int, game: str) -> None:
        """Replaces the checkpoint, and drops the log up to it, all or nothing."""
        seal = seal_of(checkpoint, scene, chain)
        with self._transaction():
            self._connection.execute(
                "INSERT OR REPLACE INTO world VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (*checkpoint[:5], chain, scene, seal, game),
            )
            self._connection.executemany("INSERT OR REPLACE INTO segment VALUES (?, ?, ?, ?)", checkpoint.segments)
            self._connection.executemany("DELETE FROM segment WHERE x = ? AND y = ? AND z = ?", checkpoint.gone)
            self._connection.execute("DELETE FROM log WHERE tick <= ?", (checkpoint.tick,))
            newest = self._connection.execute("SELECT tick, chain FROM log ORDER BY tick DESC LIMIT 1").fetchone()
        self._mark.write(*(newest or (checkpoint.tick, chain)))
        # The -wal file is emptied: it does not grow on, and the other file is whole without it. A reader puts that off.
        self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()

    def close(self) -> None:
        """Closes it; what has been written, is."""
        self._mark.close()
        with contextlib.suppress(sqlite3.Error):
            self._connection.close()

    def _run(self, *statements: str) -> None:
        for statement in statements:
            self._connection.execute(statement).fetchall()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._connection.execute("COMMIT")
        except BaseException:
            if self._connection.in_transaction:  # SQLite ends some by itself
                with contextlib.suppress(sqlite3.Error):
                    self._connection.execute("ROLLBACK")
            raise


def _promised(path: Path) -> Mark | None:
    """The mark beside a file; None if there is none.

    Raises:
        StoreError: it cannot be read, or holds nothing.
    """
    beside = mark_of(path)
    try:
        return mark.read(beside)
    except OSError as error:
        raise StoreError(f"{beside}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise damaged(beside, error) from error


def _check_end(path: Path, saved: Saved) -> None:
    """Raises `StoreError` if a file does not hold what its mark has promised."""
    promised = _promised(path)
    if promised is None:
        logger.warning("%s: has no %s, so nobody can tell whether its end is missing", path, mark_of(path).name)
        return
    chains = {record.tick: record.chain for record in saved.log} | {saved.checkpoint.tick: saved.chain}
    reason = promised.against(max(chains), chains)
    if reason and promised.binding:
        raise damaged(path, f"{reason} by {mark_of(path).name}")
    if reason:
        logger.warning("%s: %s; the machine was started anew since, and durability was 'process'", path, reason)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes neither the file nor what is in its -wal, and sees one state of it throughout."""
    # Without a -wal the file is all there is; not told so, SQLite would make one.
    beside = path.with_name(path.name + "-wal")
    how = "mode=ro" if beside.exists() and beside.stat().st_size else "mode=ro&immutable=1"
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True, isolation_level=None)
        with contextlib.closing(connection):
            connection.execute("BEGIN")
            yield connection
    except StoreError:
        raise
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode == sqlite3.SQLITE_ERROR:  # no such table, or column
            raise damaged(path, error) from error
        raise StoreError(f"{path}: cannot be read ({error}). Look to the disk, and to who may read the file") from error
    except (sqlite3.Error, TypeError, ValueError, struct.error) as error:  # a column of another type, or no UTF-8
        raise damaged(path, error) from error


def seal_of(checkpoint: Checkpoint, scene: bytes, chain: int) -> bytes:
    """The seal of a checkpoint, of the rules it was made under and of the chain at its tick."""
    digest = hashlib.blake2b(struct.pack("<qqQ", checkpoint.tick, checkpoint.next_id, chain), digest_size=16)
    for part in (checkpoint.hash, checkpoint.kept, scene):
        digest.update(struct.pack("<Q", len(part)))
        digest.update(part)
    return digest.digest()
