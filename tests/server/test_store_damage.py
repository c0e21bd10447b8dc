"""A saved world with a changed byte or a missing part: it is named at once, or makes no difference."""

import logging
import random
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from server.persistence import mark
from server.persistence.database import StoreError
from server.persistence.store import Store
from tests.lengths import contained, long
from tests.server.test_store import SCENE, altered, keep, refused
from tests.server.test_store_faults import HEAD, Torn, damaged_copy, found_in

FRAME_HEAD, PAGE = 24, 4096
FRAME = FRAME_HEAD + PAGE


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Torn]:
    """The directory of a server that was killed after 60 ticks, each of which was acknowledged."""
    directory = tmp_path_factory.mktemp("torn")
    store = Store(directory / "data", SCENE)
    store.start(keep)
    yield Torn(store, directory)
    store.close()


def regions(torn: Torn, rng: random.Random) -> Iterator[int]:
    """Yields places in the -wal: the head, and for frames from the first to the last, each field of the head and the
    page."""
    yield from range(HEAD)
    frames = (len(torn.wal) - HEAD) // FRAME
    for frame in sorted({0, 1, frames - 2, frames - 1, *rng.sample(range(frames), 8)}):
        start = HEAD + frame * FRAME
        for field in range(0, FRAME_HEAD, 4):
            yield start + field + rng.randrange(4)
        yield from (start + FRAME_HEAD + at for at in (0, PAGE - 1, rng.randrange(PAGE), rng.randrange(PAGE)))


def flipped(data: bytes, at: int, rng: random.Random) -> bytes:
    changed = bytearray(data)
    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed)


def outcome(directory: Path) -> tuple[int, bytes] | str:
    """Returns tick and hash of the world in a directory, or the reason why it was refused."""
    files = {path.name: path.read_bytes() for path in directory.iterdir() if not path.name.endswith(("-shm", "lock"))}
    try:
        return found_in(directory)
    except StoreError as error:
        assert {name: (directory / name).read_bytes() for name in files} == files
        return str(error)


def test_a_flipped_bit_anywhere_in_the_log_is_named(torn: Torn, tmp_path: Path) -> None:
    rng = random.Random(5)
    for at in regions(torn, rng):
        said = outcome(damaged_copy(torn, tmp_path, "world.db-wal", flipped(torn.wal, at, rng)))
        assert isinstance(said, str), f"byte {at}: {said[0]} of {torn.last} ticks"
        assert "world.db: damaged (" in said
        assert "world.mark" in said or "world.db-wal does not match its check" in said


def test_a_flipped_bit_ahead_of_the_last_two_transactions_is_named_without_a_mark(torn: Torn, tmp_path: Path) -> None:
    rng = random.Random(6)
    last = torn.then[-3][0]
    for at in filter(lambda at: at < last, regions(torn, rng)):
        copy = damaged_copy(torn, tmp_path, "world.db-wal", flipped(torn.wal, at, rng))
        (copy / "world.mark").unlink()
        said = outcome(copy)
        assert isinstance(said, str), f"byte {at}: {said[0]} of {torn.last} ticks"


def test_a_log_that_lost_its_end_is_named(torn: Torn, tmp_path: Path) -> None:
    rng = random.Random(7)
    ends = [end for end, *_ in torn.then[:-1]]
    for size in (0, 1, HEAD, *rng.sample(ends, 10), *(rng.randrange(len(torn.wal)) for _ in range(10))):
        said = outcome(damaged_copy(torn, tmp_path, "world.db-wal", torn.wal[:size]))
        assert isinstance(said, str)
        assert f"was promised to hold tick {torn.last} by world.mark" in said
    copy = damaged_copy(torn, tmp_path, "world.db-wal", b"")
    (copy / "world.db-wal").unlink()
    assert "was promised to hold" in refused(copy)


def test_a_world_that_lost_its_file_is_named(torn: Torn, tmp_path: Path) -> None:
    copy = damaged_copy(torn, tmp_path, "world.db", b"")
    assert "world.db: damaged (it is empty, and world.db-wal is there)" in refused(copy)
    (copy / "world.db-wal").unlink()
    assert "world.db: damaged (it is empty, and world.mark is there)" in refused(copy)
    (copy / "world.db").unlink()
    assert "world.db: damaged (it is missing, and world.mark is there)" in refused(copy)


@pytest.mark.parametrize("every", [*contained(4), *long(1)])
def test_a_flipped_bit_in_the_file_is_named_or_makes_no_difference(torn: Torn, tmp_path: Path, every: int) -> None:
    """The log is in the database file here, as it is after a checkpoint."""
    shutil.copytree(torn.good, tmp_path / "whole")
    with closing(sqlite3.connect(tmp_path / "whole" / "world.db")) as connection:
        assert connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0] == 0
    data = (tmp_path / "whole" / "world.db").read_bytes()
    rng, named = random.Random(8), 0
    pages = [page + at for page in range(0, len(data), PAGE) for at in (0, 3, 9, 101, PAGE - 1, rng.randrange(PAGE))]
    pages = pages[::every]
    for at in [*range(0, 100, every), *pages]:
        shutil.copytree(tmp_path / "whole", tmp_path / "flipped")
        (tmp_path / "flipped" / "world.db").write_bytes(flipped(data, at, rng))
        found = outcome(tmp_path / "flipped")
        assert isinstance(found, str) or found == (torn.last, torn.hashes[torn.last]), f"byte {at}"
        named += isinstance(found, str)
        shutil.rmtree(tmp_path / "flipped", ignore_errors=True)
    assert named > len(pages) / 2


@pytest.mark.parametrize("every", [*contained(9), *long(3)])
def test_a_mark_that_is_damaged_costs_no_world(torn: Torn, tmp_path: Path, every: int) -> None:
    whole = (torn.last, torn.hashes[torn.last])
    good = (torn.good / "world.mark").read_bytes()
    rng = random.Random(9)
    size = mark.SLOT.size + mark.CHECK.size
    for slot in (0, mark.APART):
        for at in (*range(slot, slot + size, every), slot + size + 1):
            assert outcome(damaged_copy(torn, tmp_path, "world.mark", flipped(good, at, rng))) == whole
    for data in (b"", good[:40], bytes(len(good)), rng.randbytes(len(good))):
        assert "world.mark: damaged (it holds no mark)" in refused(damaged_copy(torn, tmp_path, "world.mark", data))


def test_a_world_without_a_mark_is_taken_and_gets_one(
    torn: Torn, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copy = damaged_copy(torn, tmp_path, "world.mark", b"")
    (copy / "world.mark").unlink()
    store = Store(copy, SCENE)
    assert store.restored == (torn.last, torn.hashes[torn.last].hex())
    store.start(keep)
    store.world.step()
    assert store.close()
    (told,) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert "world.db: has no world.mark" in told
    found = mark.read(copy / "world.mark")
    assert found is not None
    assert found.tick == torn.last + 1


def test_the_mark_of_another_world_is_named(torn: Torn, tmp_path: Path) -> None:
    copy = damaged_copy(torn, tmp_path, "world.mark", b"")
    (copy / "world.mark").unlink()
    marks = mark.MarkFile(copy / "world.mark", power=True)
    marks.write(40, 12345)
    marks.close()
    assert "its tick 40 is not the one that was promised by world.mark" in refused(copy)


@pytest.mark.parametrize(("power", "same_boot"), [(True, True), (True, False), (False, True), (False, False)])
def test_only_a_power_cut_without_fsync_may_cost_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, power: bool, same_boot: bool
) -> None:
    boots = {True: b"\1" * 16, False: b"\2" * 16}
    monkeypatch.setattr(mark, "boot", lambda: boots[True])
    store = Store(tmp_path / "data", SCENE, power=power)
    store.start(keep)
    torn = Torn(store, tmp_path)
    store.close()
    size, tick, _ = torn.then[40]
    copy = damaged_copy(torn, tmp_path, "world.db-wal", torn.wal[:size])
    monkeypatch.setattr(mark, "boot", lambda: boots[same_boot])
    found = outcome(copy)
    if power or same_boot:
        assert isinstance(found, str)
    else:
        assert found == (tick, torn.hashes[tick])
        assert "the machine was restarted since" in caplog.text


def test_a_system_that_does_not_report_its_boot_is_trusted_less(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mark, "boot", lambda: mark.UNKNOWN)
    assert mark.Mark(1, 1, 1, True, mark.UNKNOWN).binding
    assert not mark.Mark(1, 1, 1, False, mark.UNKNOWN).binding


def test_a_world_of_schema_version_2_is_brought_to_today(tmp_path: Path) -> None:
    former_world = Path(__file__).parent.parent / "golden" / "former" / "world"
    shutil.copytree(former_world, tmp_path / "data")
    store = Store(tmp_path / "data", SCENE)
    assert (store.world.tick, store.notes[-1]) == (101, (101, "told"))
    hashed = store.world.state_hash()
    store.start(keep)
    assert store.close()
    assert found_in(tmp_path / "data") == (101, hashed)


@pytest.mark.parametrize("column", ["states", "kinds", "record"])
def test_a_damaged_world_of_schema_version_2_is_named(tmp_path: Path, column: str) -> None:
    shutil.copytree(Path(__file__).parent.parent / "golden" / "former" / "world", tmp_path / "data")
    statement: Callable[[], str] = {
        "states": lambda: "UPDATE world SET states = zeroblob(96)",
        "kinds": lambda: "UPDATE segment SET kinds = NULL",
        "record": lambda: "UPDATE log SET record = x'c0' WHERE tick = 60",
    }[column]
    altered(tmp_path / "data", statement())
    with pytest.raises(StoreError, match="damaged"):
        Store(tmp_path / "data", SCENE)
