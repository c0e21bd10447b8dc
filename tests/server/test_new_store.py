"""The store of a new world, whose thread makes the files: nothing is promised before, and a failure heals."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from server.persistence.checkpoint import Checkpoint
from server.persistence.database import Database, StoreError
from server.persistence.new_store import NewStore
from server.persistence.store import Store
from server.runtime.terrain import TerrainPool
from shared.scene import load_scene
from tests.patience import PATIENCE_S, until

SCENE = load_scene("arena")
POOL = TerrainPool()


def made(folder: Path, created: Callable[[], None] = lambda: None) -> NewStore:
    return NewStore(folder, SCENE, created, game="", power=False, checkpoint_s=60.0, terrain=POOL.of(SCENE))


def test_nothing_is_durable_before_the_files_are_there(tmp_path: Path) -> None:
    may, called = threading.Event(), threading.Event()

    def created() -> None:
        called.set()
        assert may.wait(PATIENCE_S)

    store = made(tmp_path / "a", created)
    assert not (tmp_path / "a" / "world.db").exists()
    store.start(lambda: None)
    store.world.note("a promise")
    store.world.step()
    assert called.wait(PATIENCE_S)
    assert (store.durable_tick, store.world.tick) == (0, 1)
    assert not (tmp_path / "a" / "world.db").exists()
    may.set()
    until(lambda: store.durable_tick == 1)
    store.world.set_block(3, 3, 0, 4)
    store.world.step()
    state = store.world.state_hash()
    assert store.close()
    again = Store(tmp_path / "a", SCENE, terrain=POOL.of(SCENE))
    assert (again.world.state_hash(), again.notes) == (state, [])
    assert again.close()


def test_a_store_that_never_ticked_is_a_world(tmp_path: Path) -> None:
    store = made(tmp_path)
    store.start(lambda: None)
    assert store.close()
    again = Store(tmp_path, SCENE)
    assert again.world.tick == 0
    assert again.close()


@pytest.mark.parametrize("fails", ["created", "database", "save"])
def test_a_disk_that_fails_at_first_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    monkeypatch.setattr("server.persistence.store.RETRY_S", 0.01)
    times: list[str] = []

    def fail_twice(name: str) -> None:
        if name == fails and len(times) < 2:
            times.append(name)
            raise OSError("disk full")

    class Failing(Database):
        def __init__(self, path: Path, *, power: bool = True) -> None:
            fail_twice("database")
            super().__init__(path, power=power)

        def save(self, checkpoint: Checkpoint, scene: bytes, chain: int, game: str) -> None:
            fail_twice("save")
            super().save(checkpoint, scene, chain, game)

    for module in ("new_store", "store"):
        monkeypatch.setattr(f"server.persistence.{module}.Database", Failing)
    announced: list[str] = []

    def created() -> None:
        fail_twice("created")
        announced.append("created")

    store = made(tmp_path, created)
    store.start(lambda: None)
    until(lambda: bool(store.trouble))
    assert store.trouble == "disk full"

    def steps() -> bool:
        store.world.step()
        time.sleep(0.005)
        return not store.trouble

    until(steps)
    assert (announced, len(times)) == (["created"], 2)
    store.world.set_block(3, 3, 0, 4)
    store.world.step()
    state = store.world.state_hash()
    assert store.close()
    again = Store(tmp_path, SCENE)
    assert again.world.state_hash() == state
    assert again.close()


def test_a_disk_that_fails_until_the_end_delays_the_end_no_longer_than_another(tmp_path: Path) -> None:
    def created() -> None:
        raise OSError("disk full")

    store = made(tmp_path, created)
    store.start(lambda: None)
    until(lambda: bool(store.trouble))
    assert not store.close()
    assert not store._thread.is_alive()


def test_a_store_that_is_not_to_be_saved_ends_at_once(tmp_path: Path) -> None:
    store = made(tmp_path)
    store.start(lambda: None)
    store.world.step()
    store.end(save=False)
    store.close()
    assert not store._thread.is_alive()


def test_a_directory_with_a_world_is_not_used(tmp_path: Path) -> None:
    assert Store(tmp_path, SCENE).close()
    with pytest.raises(StoreError, match=r"world\.db: exists already"):
        made(tmp_path)
    assert Store(tmp_path, SCENE).close()
