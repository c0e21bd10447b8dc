"""A join, a checkpoint or the record of a tick that fails half-way leaves nothing behind."""

import logging
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from server.game import joining
from server.game.roster import Roster
from server.game_api.api import GameApi
from server.persistence import store as stores
from server.persistence.checkpoint import Copy
from server.persistence.database import read
from server.persistence.store import Store
from shared import messages
from shared.messages import Hello, Snapshot, Welcome
from tests.patience import until
from tests.server.test_persisted_state import Stored
from tests.server.test_rules import Recorder
from tests.server.test_store import SCENE, copied, keep, play
from tests.server.test_store_faults import found_in
from tests.tables import FakeLink

ANN = Hello(messages.VERSION, {}, "Ann")


def fails(*args: Any, **given: Any) -> Any:
    raise RuntimeError("a bug")


@pytest.mark.parametrize(
    ("owner", "name", "calls"),
    [
        (GameApi, "set", []),  # before `on_join`
        (Roster, "issue", ["join", "leave"]),
        (joining, "join_welcome", ["join", "leave"]),
    ],
)
def test_a_join_that_fails_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, calls: list[str]
) -> None:
    rules = Recorder()
    table = Stored(tmp_path, rules)
    witness = table.join()
    rules.calls.clear()
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, fails)
        link = table.connect(ANN)
        table.tick()
    assert link.closings == [(messages.INTERNAL, "internal error")]
    assert [what for what, *_ in rules.calls] == calls
    assert table.game.faults.total == 1
    assert list(table.game.players) == [witness.session.entity] == table.game.api.entities()
    assert list(table.game.api.kept.attributes) == []
    assert (link.session.player, link.session.entity, link.session in table.game.sessions) == (None, 0, False)
    table.store._copy_due = True
    table.tick(2)
    until(lambda: table.store.checkpoint_s.count == 1)
    good = table.connect(ANN)
    table.tick(2)
    assert good.got(Welcome)
    assert len(table.game.players) == 2
    table.stop()
    again = Stored(tmp_path)
    assert [player.name for player in again.game.players.values()] == ["", "Ann"]
    again.stop()


def test_a_reconnect_that_fails_may_be_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = Stored(tmp_path)
    link = table.connect(ANN)
    table.tick(2)
    entity, resume = link.session.entity, link.got(Welcome)[0].resume
    link.say(messages.Inputs(table.tick_number + 1, table.tick_number, bytes(3)))
    table.lose(link)

    def back() -> FakeLink:
        found = table.connect(ANN._replace(resume=resume))
        table.tick()
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Roster, "issue", fails)
        back()
    assert back().session.entity == entity
    table.stop()


def stored(directory: Path, keep: Callable[[], Any], checkpoint_s: float = 60.0) -> Store:
    store = Store(directory / "data", SCENE, checkpoint_s=checkpoint_s)
    store.start(keep)
    return store


@pytest.mark.parametrize("where", ["keep", "pack", "copy", "pieces", "save"])
def test_a_checkpoint_that_fails_costs_no_tick_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, where: str
) -> None:
    broken = True

    def kept() -> Any:
        if broken and where == "keep":
            fails()
        return "\ud800" if broken and where == "pack" else "kept"

    monkeypatch.setattr(stores, "RETRY_S", 10 / SCENE.tick_rate)
    if where == "copy":
        monkeypatch.setattr(stores, "Copy", fails)
    elif where == "pieces":
        monkeypatch.setattr(Copy, "pieces", lambda *_: (fails() for _ in range(1)))
    elif where == "save":
        monkeypatch.setattr(stores, "seal_of", fails)
    store = stored(tmp_path, kept, 20 / SCENE.tick_rate)
    rng, last = random.Random(1), (0, b"")
    for _ in range(60):
        last = play(store, 1, rng)[-1]
        until(lambda: store.durable_tick == store.world.tick and store.idle)
    assert (store.trouble, store.checkpoint_s.count) == ("", 0)
    assert store.checkpoints_failed == store.faults.total == store.stats()["checkpoints_failed"]
    assert 3 <= store.checkpoints_failed <= 6
    assert sum("the store has failed in a checkpoint" in record.message for record in caplog.records) == 1
    assert found_in(copied(tmp_path / "data", tmp_path / "copy")) == last
    broken = False
    monkeypatch.undo()
    monkeypatch.setattr(stores, "RETRY_S", 10 / SCENE.tick_rate)
    for _ in range(30):
        last = play(store, 1, rng)[-1]
        until(lambda: store.idle)
    assert store.checkpoint_s.count >= 1
    assert store.close()
    again = Store(tmp_path / "data", SCENE)
    assert ((again.world.tick, again.world.state_hash()), again.kept) == (last, "kept")
    again.close()


@pytest.mark.parametrize("started_ticks", [0, 30])
def test_a_last_checkpoint_that_fails_leaves_all_in_the_log(tmp_path: Path, started_ticks: int) -> None:
    store = stored(tmp_path, fails)
    last = (0, store.world.state_hash())
    if started_ticks:
        last = play(store, started_ticks, random.Random(2))[-1]
    assert store.close()
    assert store.checkpoints_failed == 1
    saved = read(tmp_path / "data" / "world.db")
    assert saved is not None
    assert [record.tick for record in saved.log] == list(range(1, started_ticks + 1))
    assert found_in(tmp_path / "data") == last


def test_a_last_checkpoint_that_fails_in_trouble_is_the_end_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = stored(tmp_path, keep)
    saved = play(store, 5, random.Random(2))[-1]
    until(lambda: store.durable_tick == 5)
    monkeypatch.setattr(store, "_keep", fails)
    monkeypatch.setattr(store, "taken", fails)
    play(store, 5, random.Random(3))
    assert store.trouble == "internal error"
    assert not store.close()
    assert found_in(tmp_path / "data") == saved


def test_a_tick_whose_record_fails_goes_on_and_is_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stores, "RETRY_S", 0.01)
    table = Stored(tmp_path / "data")
    link = table.join()
    with monkeypatch.context() as patch:
        patch.setattr(table.store, "taken", fails)
        table.game.tick(table.now, table.now)
    assert link.got(Snapshot)[-1].tick == table.tick_number
    assert table.store.trouble == "internal error"
    assert table.store.durable_tick < table.tick_number

    def goes_on() -> bool:
        table.game.tick(table.now, table.now)
        return not table.store.trouble

    until(goes_on)
    table.game.api.set_block(3, 3, 3, 5)  # a tick without changes might not be written at once
    table.tick()
    assert [record.levelno for record in caplog.records if "cannot save" in record.message] == [logging.ERROR]
    copy = Store(copied(tmp_path / "data", tmp_path / "copy"), table.game.scene)
    assert copy.restored == (table.tick_number, table.game.world.state_hash().hex())
    copy.close()
    table.stop()


def test_the_log_never_goes_on_behind_a_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint is due while the file still has to be closed. The checkpoint waits until the file is open again."""
    store = stored(tmp_path, keep, 5 / SCENE.tick_rate)
    rng = random.Random(4)
    hashes: dict[int, bytes] = {0: store.world.state_hash()}
    held = store._wake
    for turn in range(12):
        hashes |= dict(play(store, 3, rng))
        with held:
            store._drop("a test")
        hashes |= dict(play(store, 12, rng))
        directory = copied(tmp_path / "data", tmp_path / f"copy-{turn}")
        tick, found = found_in(directory)
        assert found == hashes[tick]
    assert store.close()
