"""The database of a saved world, in SQLite: its schema, migrations, and checks.

    world      one row: the newest checkpoint without its blocks, and the name of its game (NULL: unknown)
    segment    every loaded segment at that checkpoint; kinds is NULL if the blocks are as generated
    log        the record of each tick since then, as in a recording (`server.journal`)

`chain` is the CRC-32 of a record, begun with the chain of the record before (the first one: with the checkpoint's). So
no record can be lost, doubled or changed unnoticed, except at the end. `server.persistence.mark` and
`server.persistence.wal` detect a loss at the end. `seal` is a BLAKE2b hash of the checkpoint's columns except for two:
the states, because the world's own `hash` is over them and the segments; and the game, whose name may change. While a
server runs, other programs may read the file with SQLite.
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
"""Identifier of the application in the header of the file: the bytes "SNW1"."""

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
    (  # drops the column `digest`; from here on `hash` is of another kind, which its length tells
        """CREATE TABLE segments (
            x INTEGER NOT NULL, y INTEGER NOT NULL, z INTEGER NOT NULL, kinds BLOB, PRIMARY KEY (x, y, z))""",
        "INSERT INTO segments SELECT x, y, z, kinds FROM segment",
        "DROP TABLE segment",
        "ALTER TABLE segments RENAME TO segment",
    ),
]
"""Statements that migrate schema version n to n + 1, as entry n. Version 0 is an empty file."""


class StoreError(ValueError):
    """Saved data that cannot be used. The message names the file and the remedy. The file has not been changed."""


class Record(NamedTuple):
    """One row of the log: a tick, its packed record, and the chain after it."""

    tick: int
    record: bytes
    chain: int


def chained(record: bytes, chain: int) -> int:
    """Returns the chain after a record.

    Args:
        record: the record.
        chain: the chain before it.
    """
    return zlib.crc32(record, chain)


def damaged(path: Path, reason: object) -> StoreError:
    """Returns the error for a file whose content is not as it was written."""
    return StoreError(
        f"{path}: damaged ({reason}). It has been left as it is: put a backup of its directory in its place, or move "
        "it away to begin a new world"
    )


class Saved(NamedTuple):
    """The content of a file."""

    checkpoint: Checkpoint
    scene: bytes
    game: str | None
    chain: int
    log: list[Record]


def mark_of(path: Path) -> Path:
    """Returns the path of the mark that belongs to a database."""
    return path.with_suffix(".mark")


def version_of(path: Path) -> int:
    """Returns the schema version of a file after a check for damage; 0 if it does not exist or is empty.

    Raises:
        StoreError: the file is not a saved world, has a newer version, or is damaged.
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
                f"{path}: has schema version {version}, but this program supports versions up to {len(MIGRATIONS)}. It "
                "has been left as it is: use the program that wrote it, or a newer one"
            )
        (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise damaged(path, found)
        reason = wal.damage(path) if promised is None or promised.binding else ""
        if reason:
            raise damaged(path, reason)
        return int(version)


def read(path: Path) -> Saved | None:
    """Reads a file of the newest schema version. Returns None if it has no world yet. Writes nothing.

    Raises:
        StoreError: the file is damaged.
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
    """A database that is open for writing. It is created if it does not exist, and migrated if it is older.

    Args:
        path: the file.
        power: whether transactions survive a power cut (by one fsync each), or only the end of the process.

    Raises:
        sqlite3.Error: the file cannot be written. All methods raise it, too; after that, open the file again.
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
        """Returns the seal of the checkpoint; empty if there is none."""
        row = self._connection.execute("SELECT seal FROM world").fetchone()
        return b"" if row is None else bytes(row[0])

    def segments(self) -> list[Cell]:
        """Returns the indices of all saved segments."""
        return self._connection.execute("SELECT x, y, z FROM segment").fetchall()

    def append(self, records: Sequence[Record]) -> None:
        """Adds records to the log in one transaction."""
        with self._transaction():
            self._connection.executemany("INSERT INTO log VALUES (?, ?, ?)", records)
        self._mark.write(records[-1].tick, records[-1].chain)

    def save(self, checkpoint: Checkpoint, scene: bytes, chain: int, game: str) -> None:
        """Replaces the checkpoint and drops the log up to its tick, in one transaction.

        Args:
            checkpoint: the checkpoint.
            scene: the packed table of the scene.
            chain: the chain at the checkpoint's tick.
            game: the name of the game.
        """
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
        # Empties the -wal file: it does not grow, and the database is complete without it. A reader delays this.
        self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()

    def close(self) -> None:
        """Closes the file. All finished transactions stay."""
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
            if self._connection.in_transaction:  # SQLite itself ends the transaction after some errors
                with contextlib.suppress(sqlite3.Error):
                    self._connection.execute("ROLLBACK")
            raise


def _promised(path: Path) -> Mark | None:
    """Returns the mark beside a database; None if there is none.

    Raises:
        StoreError: the mark cannot be read, or is damaged.
    """
    beside = mark_of(path)
    try:
        return mark.read(beside)
    except OSError as error:
        raise StoreError(f"{beside}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise damaged(beside, error) from error


def _check_end(path: Path, saved: Saved) -> None:
    """Checks that the log of a file reaches as far as its mark.

    Raises:
        StoreError: the log has lost its end, although the mark rules out a power cut as the cause.
    """
    promised = _promised(path)
    if promised is None:
        logger.warning("%s: has no %s, so a missing end of it cannot be detected", path, mark_of(path).name)
        return
    chains = {record.tick: record.chain for record in saved.log} | {saved.checkpoint.tick: saved.chain}
    reason = promised.against(max(chains), chains)
    if reason and promised.binding:
        raise damaged(path, f"{reason} by {mark_of(path).name}")
    if reason:
        logger.warning("%s: %s; the machine was restarted since, and durability was 'process'", path, reason)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """Opens a connection that changes neither the file nor its -wal, and sees the same state throughout."""
    # Without a -wal the file is complete; without `immutable` SQLite would create a -wal.
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
        if error.sqlite_errorcode == sqlite3.SQLITE_ERROR:  # there is no such table or column
            raise damaged(path, error) from error
        raise StoreError(f"{path}: cannot be read ({error}). Check the disk and the file's permissions") from error
    except (sqlite3.Error, TypeError, ValueError, struct.error) as error:  # a column of another type, or not UTF-8
        raise damaged(path, error) from error


def seal_of(checkpoint: Checkpoint, scene: bytes, chain: int) -> bytes:
    """Returns the seal: a hash of a checkpoint, of the packed scene and of the chain at the checkpoint's tick."""
    digest = hashlib.blake2b(struct.pack("<qqQ", checkpoint.tick, checkpoint.next_id, chain), digest_size=16)
    for part in (checkpoint.hash, checkpoint.kept, scene):
        digest.update(struct.pack("<Q", len(part)))
        digest.update(part)
    return digest.digest()
