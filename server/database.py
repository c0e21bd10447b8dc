"""The file of a saved world, in SQLite: its schema, how one schema becomes the next, and what is refused.

    world      one row: the newest checkpoint, without its blocks, and which game it is of (NULL: not known)
    segment    every loaded segment as of that checkpoint; kinds is NULL where they are as the generator makes them
    log        what each tick since then was told: the record that a recording has for it (`server.journal`)

`chain` is the CRC-32 of a record, begun with the one before (the first one: with the checkpoint's), so no record can
be lost, doubled or changed in between. `seal` is a BLAKE2b of the checkpoint's columns but for the states: those and
the segments are what `hash`, the world's own, is about; and but for the game, which may get another name. While a
server runs, anyone may read the file with SQLite.
"""

import contextlib
import hashlib
import sqlite3
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from server.checkpoint import Checkpoint
from shared.checks import Cell

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


def version_of(path: Path) -> int:
    """The schema version of a file; 0 if there is nothing in it.

    Raises:
        StoreError: it is not a saved world, of a newer version, or damaged.
    """
    beside = path.with_name(path.name + "-wal")
    if not path.exists():
        if beside.exists():
            raise damaged(path, f"it is missing, and {beside.name} is there")
        return 0
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
        return int(version)


def read(path: Path) -> Saved | None:
    """All that a file of the newest version holds; None if there is no world in it yet. Nothing is written.

    Raises:
        StoreError: it is damaged.
    """
    with _reading(path) as connection:
        columns = "tick, next_id, states, hash, kept, chain, scene, seal, game"
        row = connection.execute(f"SELECT {columns} FROM world").fetchone()
        segments = connection.execute("SELECT x, y, z, kinds, digest FROM segment ORDER BY z, y, x").fetchall()
        log = [Record(*each) for each in connection.execute("SELECT tick, record, chain FROM log ORDER BY tick")]
        if row is None:
            if segments or log:
                raise damaged(path, "it has no checkpoint")
            return None
        tick, next_id, states, checked, kept, chain, scene, seal, game = row
        checkpoint = Checkpoint(tick, next_id, states, checked, kept, segments, [])
        if seal != _seal(checkpoint, scene, chain):
            raise damaged(path, "the checkpoint does not match its seal")
        found = chain
        for record in log:
            found = chained(record.record, found)
            if found != record.chain:
                raise damaged(path, f"tick {record.tick} of the log does not match its check")
        return Saved(checkpoint, scene, game, chain, log)


class Database:
    """A file that is open for writing; it is made if it is not there, and brought to the newest version if it is older.

    Args:
        power: what has been written survives a power cut, too (one fsync per transaction), not just the process's end.

    Raises:
        sqlite3.Error: it cannot be written. So do all methods; then it has to be opened anew.
    """

    def __init__(self, path: Path, *, power: bool = True) -> None:
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

    def digests(self) -> dict[Cell, int]:
        """The digest of every segment that is saved."""
        rows = self._connection.execute("SELECT x, y, z, digest FROM segment").fetchall()
        return {(x, y, z): digest % (1 << 64) for x, y, z, digest in rows}

    def append(self, records: Iterable[Record]) -> None:
        """Adds to the log, all or nothing."""
        with self._transaction():
            self._connection.executemany("INSERT INTO log VALUES (?, ?, ?)", records)

    def save(self, checkpoint: Checkpoint, scene: bytes, chain: int, game: str) -> None:
        """Replaces the checkpoint, and drops the log up to it, all or nothing."""
        seal = _seal(checkpoint, scene, chain)
        with self._transaction():
            self._connection.execute(
                "INSERT OR REPLACE INTO world VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (*checkpoint[:5], chain, scene, seal, game),
            )
            self._connection.executemany(
                "INSERT OR REPLACE INTO segment VALUES (?, ?, ?, ?, ?)",
                [(*segment[:4], _signed(segment[4])) for segment in checkpoint.segments],
            )
            self._connection.executemany("DELETE FROM segment WHERE x = ? AND y = ? AND z = ?", checkpoint.gone)
            self._connection.execute("DELETE FROM log WHERE tick <= ?", (checkpoint.tick,))
        # The -wal file is emptied: it does not grow on, and the other file is whole without it. A reader puts that off.
        self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()

    def close(self) -> None:
        """Closes it; what has been written, is."""
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


def _signed(digest: int) -> int:
    """64 bits as SQLite holds them."""
    return digest - (digest >> 63 << 64)


def _seal(checkpoint: Checkpoint, scene: bytes, chain: int) -> bytes:
    digest = hashlib.blake2b(struct.pack("<qqQ", checkpoint.tick, checkpoint.next_id, chain), digest_size=16)
    for part in (checkpoint.hash, checkpoint.kept, scene):
        digest.update(struct.pack("<Q", len(part)))
        digest.update(part)
    return digest.digest()
