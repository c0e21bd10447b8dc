"""A saved world: its state after any end, what is refused, and faults of the disk."""

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import msgpack
import numpy as np
import pytest

from server.persistence import database
from server.persistence import store as stores
from server.persistence.database import StoreError
from server.persistence.store import Store
from shared.blocks import pack
from shared.inputs import Input, make_input
from shared.world import World
from tests import worlds
from tests.patience import until

SCENE = worlds.scene([worlds.floor(0)])
KEPT = {"players": [1, 2], 7: b"\0"}


def keep() -> object:
    return KEPT


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., Store]]:
    """A function that opens stores in `tmp_path / "data"` or elsewhere. Stores that are left open are closed at the
    end."""
    found: list[Store] = []

    def open_one(directory: Path = tmp_path / "data", *, start: bool = True, checkpoint_s: float = 60) -> Store:
        store = Store(directory, SCENE, checkpoint_s=checkpoint_s)
        found.append(store)
        if start:
            store.start(keep)
        return store

    yield open_one
    for store in found:
        store.close()


def play(store: Store, ticks: int, rng: random.Random) -> list[tuple[int, bytes]]:
    """Plays with movers, edits, segments and notes. Returns the tick and the hash after each tick."""
    world, hashes = store.world, []
    for _ in range(ticks):
        if rng.random() < 0.1 and len(world) < 8:
            world.note(["joined", world.spawn("box", (rng.randrange(-9, 9), rng.randrange(-9, 9), 9 + 3 * len(world)))])
        if rng.random() < 0.3:
            x, y = rng.randrange(-20, 20), rng.randrange(-20, 20)
            world.fill((x, y, -1), (x + 2, y + 2, 1), rng.choice((0, 5)), push=True)
        if rng.random() < 0.05:
            cell = rng.choice([(2, 0, 0), (3, 0, 0)])
            if cell in world.blocks:
                world.unload_segment(cell)
            else:
                world.load_segment(cell, world.blocks.segment((0, 0, -1)).reshape(-1))
        ids = world.entities["id"].tolist()
        world.step(
            {entity: Input(rng.randrange(-127, 128), rng.randrange(-127, 128), rng.random() < 0.2) for entity in ids}
        )
        hashes.append((world.tick, world.state_hash()))
    return hashes


def crashed(store: Store, directory: Path) -> Path:
    """Returns a copy of the directory that a process would leave that crashes now, with everything saved."""
    until(lambda: store.durable_tick == store.world.tick)
    return copied(directory / "data", directory / f"crashed-{store.world.tick}")


def copied(directory: Path, copy: Path) -> Path:
    """Copies all files of a store as they are at one moment. Returns the copy.

    It waits until the store's thread does not write, because files from before and after a write never existed
    together.
    """

    def at_rest() -> bool:
        shutil.rmtree(copy, ignore_errors=True)
        try:
            before = written(directory)
            shutil.copytree(directory, copy)
            return written(directory) == before
        except (FileNotFoundError, shutil.Error):
            return False

    until(at_rest)
    return copy


def written(directory: Path) -> dict[str, tuple[int, int]]:
    """Returns the time of the last write and the size of each file."""
    return {path.name: (path.stat().st_mtime_ns, path.stat().st_size) for path in directory.iterdir()}


def test_a_world_comes_back_with_its_hash_after_a_crash_and_after_a_stop(
    opened: Callable[..., Store], tmp_path: Path
) -> None:
    rng = random.Random(3)
    store = opened()
    assert store.restored == (0, store.world.state_hash().hex())
    assert store.kept is None
    for _ in range(3):
        last = play(store, 150, rng)[-1]
        again = opened(crashed(store, tmp_path), start=False)
        assert (again.world.tick, again.world.state_hash()) == last
        assert again.world.next_id == store.world.next_id
        play(again, 1, random.Random(1))
        store.world.step()
        assert store.close()
        store = opened()
        assert (store.restored[0], store.kept, store.notes) == (last[0] + 1, KEPT, [])


def test_inputs_with_an_aim_come_back_after_a_crash(tmp_path: Path) -> None:
    scene = worlds.scene([worlds.floor(0)], aim=True)
    with closing(Store(tmp_path / "data", scene, checkpoint_s=60)) as store:
        store.start(keep)
        rng, entity = random.Random(3), store.world.spawn("box", (0, 0, 0))
        for _ in range(50):
            aim = [rng.uniform(-1, 1) for _ in range(3)]
            store.world.step({entity: make_input(rng.uniform(-1, 1), 1, buttons=rng.randrange(8), aim=aim)})
        after, state = store.world.state_hash(), store.world.state(entity)
        copy = crashed(store, tmp_path)
    with closing(Store(copy, scene, checkpoint_s=60)) as store:
        assert store.world.state(entity) == state
        assert store.world.state_hash() == after


def test_notes_come_back_since_the_checkpoint_each_with_its_tick(opened: Callable[..., Store], tmp_path: Path) -> None:
    store = opened()
    store.world.note("before the first")
    store.world.step()
    store.world.step()
    store.world.note({3: [1.5, None]})
    store.world.note("second")
    store.world.step()
    again = opened(crashed(store, tmp_path), start=False)
    assert again.notes == [(1, "before the first"), (3, {3: [1.5, None]}), (3, "second")]
    assert again.kept is None


def test_changes_by_a_restart_are_in_the_log(opened: Callable[..., Store], tmp_path: Path) -> None:
    store = opened()
    ghost = store.world.spawn("box", (0, 0, 0))
    store.world.step()
    second = opened(crashed(store, tmp_path), start=False)
    second.world.remove(ghost)  # as a game does that no longer knows it
    second.start(keep)
    second.world.step()
    until(lambda: second.durable_tick == 2)
    third = tmp_path / "third"
    shutil.copytree(tmp_path / "crashed-1", third)
    assert len(opened(third, start=False).world) == 0


def test_checkpoints_are_exact_while_the_world_goes_on(opened: Callable[..., Store], tmp_path: Path) -> None:
    rng = random.Random(5)
    store = opened(checkpoint_s=5 / SCENE.tick_rate)
    hashes: dict[int, bytes] = {}
    for life in range(12):
        hashes |= dict(play(store, 20, rng))
        copy = crashed(store, tmp_path)
        with closing(sqlite3.connect(copy / "world.db")) as connection:
            (tick, checked) = connection.execute("SELECT tick, hash FROM world").fetchone()
            (first, rows) = connection.execute("SELECT min(tick), count(*) FROM log").fetchone()
        assert checked == hashes[tick] if tick else life == 0
        assert rows == 0 or first == tick + 1
        again = opened(copy, start=False)
        assert again.world.state_hash() == hashes[again.world.tick] == hashes[store.world.tick]
    assert store.checkpoint_s.count > 3


def test_a_large_world_is_hashed_by_its_checkpoints_only(
    opened: Callable[..., Store], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "HASHED_MAX", 1)
    rng = random.Random(5)
    store = opened()
    store.world.spawn("box", (0, 0, 9))
    store.world.spawn("box", (0, 4, 9))
    last = play(store, 40, rng)[-1]
    copy = crashed(store, tmp_path)
    with closing(sqlite3.connect(copy / "world.db")) as connection:
        records = [msgpack.unpackb(row[0]) for row in connection.execute("SELECT record FROM log")]
    assert {len(record) for record in records} == {3}
    again = opened(copy, start=False)
    assert (again.world.tick, again.world.state_hash()) == last


def test_a_directory_belongs_to_one_server(opened: Callable[..., Store], tmp_path: Path) -> None:
    store = opened()
    with pytest.raises(StoreError, match="another server is using it"):
        Store(tmp_path / "data", SCENE)
    assert store.close()
    assert opened(start=False).close()
    assert opened().close()


def contents(directory: Path) -> dict[str, bytes]:
    names = ("world.db", "world.db-wal")
    return {name: (directory / name).read_bytes() for name in names if (directory / name).exists()}


def refused(directory: Path, scene: object = SCENE) -> str:
    """Checks that a directory is refused and stays as it is. Returns the message."""
    before = contents(directory)
    with pytest.raises(StoreError) as error:
        Store(directory, scene)  # type: ignore[arg-type]
    assert contents(directory) == before
    assert "\n" not in str(error.value)
    return str(error.value)


def altered(directory: Path, *statements: str) -> None:
    with closing(sqlite3.connect(directory / "world.db", isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)


def test_an_unusable_directory_is_refused_and_left_as_it_is(opened: Callable[..., Store], tmp_path: Path) -> None:
    store = opened()
    play(store, 60, random.Random(1))
    good = crashed(store, tmp_path)
    altered(good, "PRAGMA user_version")  # the log is in the database file now
    path = str(good / "world.db")

    def bad(name: str, *statements: str) -> Path:
        shutil.copytree(good, tmp_path / name)
        altered(tmp_path / name, *statements)
        return tmp_path / name

    newest = len(database.MIGRATIONS)
    said = refused(bad("newer", f"PRAGMA user_version = {newest + 1}"))
    assert f"world.db: has schema version {newest + 1}, but this program supports versions up to {newest}" in said
    assert "newer one" in said
    assert "not a saved world" in refused(bad("foreign", "PRAGMA application_id = 1"))
    for name, statement in {
        "gap": "DELETE FROM log WHERE tick = 7",
        "end": "UPDATE log SET record = x'c0' WHERE tick = 60",
        "kept": "UPDATE world SET kept = x'01'",
        "states": "UPDATE world SET states = zeroblob(96)",
        "short": "UPDATE world SET states = x'01'",
        "type": "UPDATE world SET states = 'text'",
        "empty": "DELETE FROM world",
        "segment": "UPDATE segment SET kinds = x'00' WHERE z = 0",
        "fewer": "DELETE FROM segment WHERE z = 0",
        "blocks": f"UPDATE segment SET kinds = x'{pack(np.ones(32768, np.uint8)).hex()}' WHERE z = 0",
    }.items():
        said = refused(bad(name, statement))
        assert "world.db: damaged (" in said, name
        assert "put a backup of its directory in its place" in said
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "world.db").write_text("no database" * 100)
    assert "damaged (file is not a database)" in refused(tmp_path / "text")
    shutil.copytree(good, tmp_path / "halved")
    with (tmp_path / "halved" / "world.db").open("r+b") as file:
        file.truncate(8192)
    assert "damaged" in refused(tmp_path / "halved")
    (tmp_path / "lost").mkdir()
    (tmp_path / "lost" / "world.db-wal").write_bytes(b"\1" * 100)
    assert "it is missing, and world.db-wal is there" in refused(tmp_path / "lost")
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be used"):
        Store(tmp_path / "file", SCENE)
    said = refused(good, worlds.scene([worlds.floor(0)], gravity=9.0, tick_rate=32))
    assert "saved with another scene (different: gravity, tick_rate)" in said
    assert path in said
    assert opened(good).world.tick == 60


def test_a_replay_with_another_result_says_what_to_do(
    opened: Callable[..., Store], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = opened()
    play(store, 40, random.Random(1))
    copy = crashed(store, tmp_path)
    step = World.step
    monkeypatch.setattr(World, "step", lambda world, inputs: step(world, {} if world.tick == 30 else inputs))
    assert "the replay of its log gives another world than was saved (tick 31: the entities" in refused(copy)


def test_a_world_belongs_to_its_game(tmp_path: Path) -> None:
    def opens(game: str, directory: Path = tmp_path) -> bool:
        return Store(directory, SCENE, game=game).close()

    assert opens("tag:Tag")
    assert opens("tag:Tag")
    with pytest.raises(StoreError, match=r"was saved by a server of the game tag:Tag, and this is .* of the game a:B"):
        opens("a:B")
    with pytest.raises(StoreError, match=r"was saved by a server of the game tag:Tag, and this is .* without a game"):
        opens("")
    assert opens("", tmp_path / "plain")
    with pytest.raises(StoreError, match=r"was saved by a server without a game, and this is .* of the game a:B"):
        opens("a:B", tmp_path / "plain")
    altered(tmp_path, "UPDATE world SET game = 'tags:Tag'")  # as docs/server.md describes it for a game with a new name
    assert opens("tags:Tag")


def test_a_world_of_the_first_schema_takes_the_game_that_comes(tmp_path: Path) -> None:
    assert Store(tmp_path, SCENE).close()
    altered(tmp_path, "ALTER TABLE world DROP COLUMN game", "PRAGMA user_version = 1")
    store = Store(tmp_path, SCENE, game="a:B")
    store.start(keep)
    store.world.step()
    assert store.close()
    with pytest.raises(StoreError, match="was saved by a server of the game a:B"):
        Store(tmp_path, SCENE)


def test_an_older_schema_is_migrated(
    opened: Callable[..., Store], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = opened()
    last = play(store, 60, random.Random(1))[-1]
    assert store.close()
    step = ("ALTER TABLE log ADD COLUMN extra INTEGER", "UPDATE segment SET x = x")
    monkeypatch.setattr(database, "MIGRATIONS", [*database.MIGRATIONS, step])
    again = opened(start=False)
    assert (again.world.tick, again.world.state_hash()) == last
    again.close()
    with closing(sqlite3.connect(tmp_path / "data" / "world.db")) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (len(database.MIGRATIONS),)
        assert [row[1] for row in connection.execute("PRAGMA table_info(log)")][-1] == "extra"


def test_a_migration_that_fails_changes_nothing(
    opened: Callable[..., Store], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert opened().close()
    step = ("ALTER TABLE log ADD COLUMN extra INTEGER", "UPDATE nowhere SET x = x")
    monkeypatch.setattr(database, "MIGRATIONS", [*database.MIGRATIONS, step])
    assert "cannot be written (no such table: nowhere)" in refused(tmp_path / "data")
    monkeypatch.undo()
    assert opened().world.tick == 0
