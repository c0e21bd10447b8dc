"""A saved world when the disk fails: torn and garbled files, no room, no answer, and a fault in our own code."""

import logging
import random
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from server.persistence import database
from server.persistence import store as stores
from server.persistence.database import Database, StoreError
from server.persistence.store import Store
from tests.lengths import contained, long
from tests.patience import PATIENCE_S, until
from tests.server.test_store import SCENE, copied, crashed, keep, play

HEAD = 32
"""Bytes of the head of a -wal file."""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    found = Store(tmp_path / "data", SCENE)
    found.start(keep)
    yield found
    found.close()


def found_in(directory: Path) -> tuple[int, bytes]:
    """Returns tick and hash of the world in a directory, which is then removed."""
    again = Store(directory, SCENE)
    try:
        return again.world.tick, again.world.state_hash()
    finally:
        again.close()
        shutil.rmtree(directory)


class Torn:
    """A directory as a crash leaves it, and the durable ticks by the size of the log."""

    def __init__(self, store: Store, directory: Path) -> None:
        self.hashes = {0: store.world.state_hash()}
        data = directory / "data"
        self.then: list[tuple[int, int, bytes]] = [(HEAD, 0, (data / "world.mark").read_bytes())]
        """After each tick: the size of the -wal, the tick, and the mark."""
        rng = random.Random(7)
        for _ in range(60):
            self.hashes |= dict(play(store, 1, rng))
            until(lambda: store.durable_tick == store.world.tick)
            size, mark = (data / "world.db-wal").stat().st_size, (data / "world.mark").read_bytes()
            self.then.append((size, store.world.tick, mark))
        self.last = store.world.tick
        self.good = crashed(store, directory)
        self.wal = (self.good / "world.db-wal").read_bytes()

    def whole(self, size: int) -> int:
        """Returns the newest tick that was reported as durable when the -wal had this size."""
        return max(tick for end, tick, _ in self.then if end <= size)

    def mark(self, tick: int) -> bytes:
        """Returns the mark as it was after a tick."""
        return next(mark for _, at, mark in self.then if at == tick)


def damaged_copy(torn: Torn, tmp_path: Path, name: str, data: bytes) -> Path:
    copy = tmp_path / "torn"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(torn.good, copy)
    (copy / name).write_bytes(data)
    return copy


def test_a_crash_at_any_byte_of_the_log_keeps_all_that_was_durable_by_then(store: Store, tmp_path: Path) -> None:
    torn = Torn(store, tmp_path)
    assert torn.then[-1][:2] == (len(torn.wal), torn.last)
    rng = random.Random(1)
    ends = [end + more for end, *_ in torn.then[1:] for more in (-1, 0)]
    for size in [0, 1, HEAD - 1, HEAD, *rng.sample(ends, 20), *(rng.randrange(len(torn.wal)) for _ in range(20))]:
        tick = torn.whole(size) if size >= HEAD else 0
        behind = rng.choice((b"", bytes(5000), rng.randbytes(5000)))  # frames that were not written yet
        copy = damaged_copy(torn, tmp_path, "world.db-wal", torn.wal[:size] + (behind if size > HEAD else b""))
        promised = rng.choice((tick, rng.randrange(tick + 1)))  # after a power cut, the mark may be an older one
        (copy / "world.mark").write_bytes(torn.mark(promised))
        assert found_in(copy) == (tick, torn.hashes[tick])


@pytest.mark.parametrize("turns", [*contained(48), *long(150)])
def test_a_garbled_file_is_refused_or_makes_no_difference(store: Store, tmp_path: Path, turns: int) -> None:
    torn = Torn(store, tmp_path)
    shutil.copytree(torn.good, tmp_path / "whole")
    with sqlite3.connect(tmp_path / "whole" / "world.db") as connection:
        assert connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0] == 0
    connection.close()
    torn.good = tmp_path / "whole"
    data = (torn.good / "world.db").read_bytes()
    rng, refused = random.Random(3), 0
    for turn in range(turns):
        broken = bytearray(data)
        at = rng.randrange(len(data))
        if turn % 3 == 0:
            broken[at] ^= 1 << rng.randrange(8)
        elif turn % 3 == 1:
            broken[at // 512 * 512 :][:512] = b""
            broken[at // 512 * 512 : at // 512 * 512] = rng.randbytes(512)
        else:
            del broken[at:]
        copy = damaged_copy(torn, tmp_path, "world.db", bytes(broken))
        try:
            found = found_in(copy)
        except StoreError:
            refused += 1
            assert (copy / "world.db").read_bytes() == broken
            shutil.rmtree(copy)
        else:
            assert found == (torn.last, torn.hashes[torn.last])
    assert refused > 2 / 3 * turns


class Disk:
    """The disk of all databases of a test. It can fail, hang or be full."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.error: Exception | None = None
        self.free = threading.Event()
        self.free.set()
        self.pages = 0
        disk = self

        class OnDisk(Database):
            def __init__(self, path: Path, *, power: bool = True) -> None:
                super().__init__(path, power=power)
                if disk.pages:
                    self._run(f"PRAGMA max_page_count = {disk.pages}")

            def append(self, records: Any) -> None:
                disk.touched()
                super().append(records)

            def save(self, checkpoint: Any, scene: bytes, chain: int, game: str) -> None:
                disk.touched()
                super().save(checkpoint, scene, chain, game)

        monkeypatch.setattr(stores, "Database", OnDisk)
        monkeypatch.setattr(stores, "RETRY_S", 0.01)

    def touched(self) -> None:
        assert self.free.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def stepping(store: Store, rng: random.Random, condition: Callable[[], bool]) -> None:
    """Plays until a condition holds."""

    def play_on() -> bool:
        play(store, 1, rng)
        return condition()

    until(play_on)


FULL = sqlite3.OperationalError("database or disk is full")


def into_trouble(store: Store, disk: Disk, rng: random.Random, error: Exception = FULL) -> tuple[int, bytes]:
    """Plays 30 ticks that are saved, then until the store is in trouble. Returns the last saved tick and hash."""
    saved = play(store, 30, rng)[-1]
    until(lambda: store.durable_tick == 30)
    disk.error = error
    stepping(store, rng, lambda: bool(store.trouble))
    return saved


@pytest.mark.parametrize(
    ("error", "said"), [(FULL, "database or disk is full"), (RuntimeError("a bug"), "internal error")]
)
def test_a_full_disk_is_reported_and_made_up_for_once_there_is_room(
    disk: Disk, store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture, error: Exception, said: str
) -> None:
    rng = random.Random(1)
    saved = into_trouble(store, disk, rng, error)
    assert store.trouble == said
    assert store.stats()["save_trouble"] == said
    play(store, 50, rng)
    assert store.durable_tick == 30  # only ticks up to this one may be reported as durable
    assert found_in(copied(tmp_path / "data", tmp_path / "then")) == saved
    disk.error = None
    stepping(store, rng, lambda: not store.trouble)
    play(store, 20, rng)
    last = play(store, 1, rng)[-1]
    assert found_in(crashed(store, tmp_path)) == last
    told = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert sum("cannot save" in line for line in told) == 1
    assert sum("saving again" in line for line in told) == 1


def test_a_crash_in_the_middle_of_making_up_finds_the_world_before_or_after(
    disk: Disk, store: Store, tmp_path: Path
) -> None:
    rng = random.Random(1)
    saved = into_trouble(store, disk, rng)
    disk.error = None
    disk.free.clear()  # the checkpoint that closes the gap waits
    stepping(store, rng, lambda: not store._gap)
    hashes = dict(play(store, 20, rng))
    assert found_in(copied(tmp_path / "data", tmp_path / "then")) == saved
    assert store.durable_tick == 30
    disk.free.set()
    stepping(store, rng, lambda: not store.trouble)
    hashes |= dict(play(store, 1, rng))
    tick, found = found_in(crashed(store, tmp_path))
    assert found == hashes[tick]


@pytest.mark.slow
def test_a_file_at_its_limit_finds_room_in_the_old_log(disk: Disk, tmp_path: Path) -> None:
    disk.pages = 24
    store = Store(tmp_path / "data", SCENE)
    store.start(keep)
    rng = random.Random(1)
    stepping(store, rng, lambda: bool(store.trouble))
    assert store.trouble == "database or disk is full"
    stepping(store, rng, lambda: not store.trouble)
    last = play(store, 1, rng)[-1]
    assert found_in(crashed(store, tmp_path)) == last
    assert (tmp_path / "data" / "world.db").stat().st_size <= 24 * 4096
    store.close()


def test_a_disk_that_does_not_answer_is_given_up(
    disk: Disk, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "BEHIND_S", 1.0)
    rng = random.Random(1)
    disk.free.clear()
    play(store, SCENE.tick_rate, rng)
    assert store.stats()["save_trouble"] == ""
    play(store, 3 * SCENE.tick_rate, rng)
    assert store.trouble == "the disk is more than 1 s behind"
    assert len(store._records) == 0
    assert store.durable_tick == 0
    disk.free.set()
    stepping(store, rng, lambda: not store.trouble)
    last = play(store, 1, rng)[-1]
    assert found_in(crashed(store, tmp_path)) == last


def test_the_end_of_a_store_in_trouble_tries_once_more(disk: Disk, tmp_path: Path) -> None:
    store = Store(tmp_path / "data", SCENE)
    store.start(keep)
    rng = random.Random(1)
    saved = into_trouble(store, disk, rng)
    assert not store.close()
    assert found_in(copied(tmp_path / "data", tmp_path / "then")) == saved
    store = Store(tmp_path / "data", SCENE)
    store.start(keep)
    disk.error = None
    play(store, 30, rng)
    disk.error = FULL
    stepping(store, rng, lambda: bool(store.trouble))
    last = play(store, 1, rng)[-1]
    disk.error = None
    assert store.close()
    assert found_in(tmp_path / "data") == last


def test_the_log_is_cut_when_it_grows_long(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "LOG_BYTES_MAX", 2000)
    stepping(store, random.Random(1), lambda: store.checkpoint_s.count >= 3)
    until(lambda: store.durable_tick == store.world.tick)  # nothing is being written
    file = Database(store._path)
    assert len(database.read(store._path).log) < 400  # type: ignore[union-attr]
    file.close()
