"""Tests of the directories of worlds that several processes share, and of a store whose world may be taken over."""

import time
from pathlib import Path

import pytest

from server.hosting.files import SavedWorld, WorldFiles
from server.persistence.store import Store
from shared.scene import load_scene
from tests.patience import PATIENCE_S

FLAT = load_scene("flat")
SAVED = SavedWorld("arena", {"mode": "a"}, "", False, False)


def until_saved(store: Store) -> bool:
    """Waits until all that the store has got is durable, or cannot be saved. Returns whether it is durable."""
    deadline = time.monotonic() + PATIENCE_S
    while store.durable_tick < store.world.tick and not store.trouble:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return not store.trouble


def test_a_copy_has_all_that_counted_and_nothing_that_is_written_later(tmp_path: Path) -> None:
    files = WorldFiles(tmp_path, durable=False, shared=True)
    files.write("arena-1", SAVED)
    owned = True
    store = Store(files.of("arena-1"), FLAT, power=False)
    store.owned = lambda: owned
    store.start(lambda: None)
    entity = store.world.spawn("player", (5.0, 5.0, 20.0))
    store.world.step()
    assert until_saved(store)
    files.copy("arena-1", "arena-1@12")
    saved = store.world.tick, store.world.state_hash()
    owned = False
    store.world.remove(entity)
    store.world.step()
    assert not until_saved(store)
    assert store.trouble == "this process has lost its lease"
    assert store.durable_tick <= saved[0]
    files.folders["arena-1"] = "arena-1@12"
    assert files.read("arena-1") == SAVED
    taken = Store(files.of("arena-1"), FLAT, power=False)
    assert (taken.world.tick, taken.world.state_hash()) == saved
    taken.close()
    store.end(save=False)
    store.close()


def test_the_newest_directory_counts_and_only_former_ones_are_removed(tmp_path: Path) -> None:
    files = WorldFiles(tmp_path, durable=False, shared=True)
    for folder in ("arena-1", "arena-1@7", "arena-1@12", "arena-1@100", "arena-10", "else"):
        files.write(folder, SAVED._replace(code=folder.upper()))
    (tmp_path / "worlds" / "arena-1@200").mkdir()
    (tmp_path / "worlds" / "no name").mkdir()
    (tmp_path / "worlds" / "else" / "world.json").write_text("[]", "utf-8")
    newest = {name: folder for name, (folder, _) in files.newest().items()}
    assert newest == {"arena-1": "arena-1@100", "arena-10": "arena-10"}
    files.remove_former("arena-1", "arena-1@12")
    left = {path.name for path in (tmp_path / "worlds").iterdir() if not path.name.startswith(".")}
    assert left == {"arena-1@12", "arena-1@100", "arena-1@200", "arena-10", "else", "no name"}


def test_nothing_is_left_of_a_world_that_has_ended(tmp_path: Path) -> None:
    files = WorldFiles(tmp_path, durable=False, shared=True)
    for folder in ("arena-1", "arena-1@7", "arena-1@12", "arena-12"):
        files.write(folder, SAVED)
    files.folders["arena-1"] = "arena-1@12"
    files.remove("arena-1")
    assert [*files.newest()] == ["arena-12"], "otherwise it would come back at the start of the next process"


def test_another_process_that_starts_leaves_worlds_that_begin_alone(tmp_path: Path) -> None:
    (tmp_path / "worlds" / "arena-1").mkdir(parents=True)
    WorldFiles(tmp_path, durable=False, shared=True)
    assert (tmp_path / "worlds" / "arena-1").exists()
    WorldFiles(tmp_path, durable=False)
    assert not (tmp_path / "worlds" / "arena-1").exists()


def test_a_copy_that_fails_is_no_world(tmp_path: Path) -> None:
    files = WorldFiles(tmp_path, durable=False, shared=True)
    with pytest.raises(OSError, match=r"world\.json"):
        files.copy("nowhere", "nowhere@3")
    assert files.newest() == {}
