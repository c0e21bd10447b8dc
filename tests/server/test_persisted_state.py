"""After a restart the game goes on: the same players with their tokens, the same attributes and shared values."""

from pathlib import Path
from typing import Any

from server.config.limits import Limits
from server.game import Game
from server.persistence.store import Store
from server.players.persisted_state import restored, whole
from server.rules import Rules
from shared import messages
from shared.messages import Hello, Inputs, Shared, Welcome
from tests.patience import until
from tests.server.test_rules import Recorder, attributes
from tests.tables import FakeLink, Table, gone, order


class Stored(Table):
    """A table whose world is saved in a directory."""

    def __init__(self, directory: Path, rules: Rules | None = None) -> None:
        super().__init__(rules=rules, resume_s=2.0)
        self.store = Store(directory, self.game.scene, power=False)
        self.game = Game(
            self.game.scene,
            limits=Limits(resume_s=2.0),
            compiled=False,
            world=self.store.world,
            saves=self.store,
            rules=rules,
        )
        self.store.start(self.game.keep)

    def tick(self, n: int = 1) -> None:
        """Runs ticks, and waits until each is on disk."""
        for _ in range(n):
            super().tick()
            until(lambda: self.store.durable_tick == self.game.world.tick)

    def stop(self) -> None:
        assert self.store.close()


def played(table: Stored) -> tuple[FakeLink, bytes]:
    """Plays until there are a player with an edit, attributes and shared values. Returns the player's link and
    token."""
    link = table.connect(Hello(messages.VERSION, {}, "Ann"))
    table.tick(64)
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes((127, 0, 0)) * 8), order(7, 0, 18, 16, 1, 5))
    game = table.game.api
    npc = game.spawn("stone", (10.0, 10.0, 1.0), mood="calm")
    game.set(npc, "mood", "cross")
    game.share("score", [1, 2])
    gone = game.spawn("stone", (5.0, 5.0, 1.0), mood="gone")
    table.tick(20)
    game.remove(gone)
    table.tick(20)
    return link, link.got(Welcome)[-1].resume


def goes_on(table: Stored, before: FakeLink, token: bytes, rules: Recorder) -> None:
    """Checks that the game goes on as it was."""
    assert rules.calls == []
    assert table.game.world.blocks.get(18, 16, 1) == 5
    link = table.connect(Hello(messages.VERSION, {}, "", resume=token))
    table.tick(2)
    me = link.session.entity
    assert me == before.session.entity
    assert attributes(link) == {me: {"name": "Ann"}, 2: {"mood": "cross"}}
    assert link.got(Shared) == [Shared({"score": [1, 2]})]
    table.game.api.remove(2)
    table.tick()
    assert 2 in [entity for snapshot in link.got(messages.Snapshot) for entity in gone(snapshot)]
    # A command that was answered before the restart is answered again, and not carried out again.
    link.say(order(7, 0, 18, 16, 1, 0))
    table.tick(2)
    assert table.game.world.blocks.get(18, 16, 1) == 5


def test_a_contact_from_before_a_restart_does_not_begin_again(tmp_path: Path) -> None:
    first, rules = Stored(tmp_path, Recorder()), Recorder()
    a, b = (first.game.api.spawn("runner", (x, 16.0, 1.0)) for x in (10.0, 10.0 - 0.625))
    first.tick(2)
    first.stop()
    second = Stored(tmp_path, rules)
    second.game.api.steer(a, 0, 1)
    second.tick(8)
    assert second.game.world.position(a)[1] > 16.0
    assert second.game.api.touching(a) == [b]
    assert rules.calls == []
    second.stop()


def test_after_a_stop_the_game_goes_on(tmp_path: Path) -> None:
    first = Stored(tmp_path)
    link, token = played(first)
    hashed = first.game.world.state_hash()
    first.stop()
    rules = Recorder()
    again = Stored(tmp_path, rules)
    assert again.game.world.state_hash() == hashed
    goes_on(again, link, token, rules)
    again.stop()


def test_a_player_that_does_not_reconnect_after_a_restart_leaves(tmp_path: Path) -> None:
    first = Stored(tmp_path)
    link, _ = played(first)
    first.stop()
    again = Stored(tmp_path)
    again.now = 1000.0
    again.tick(int(1.9 / again.tick_s))
    assert link.session.entity in again.game.world
    again.tick(int(0.2 / again.tick_s))
    assert link.session.entity not in again.game.world
    again.stop()


def test_a_new_world_begins_and_an_old_one_does_not_begin_again(tmp_path: Path) -> None:
    for expected in ([("start",)], []):
        rules = Recorder()
        table = Stored(tmp_path, rules)
        table.tick(3)
        assert rules.calls == expected
        table.stop()


def test_notes_restore_the_state_that_they_were_made_of() -> None:
    notes: list[list[Any]] = [
        ["player", 1, "Ann", "ann@x", [b"1"]], ["said", 1, {"a": 1}], ["shared", {"x": 1}], ["answered", 1, 4, 0],
        ["player", 2, "", "", [b"2"]], ["answered", 1, 9, 2], ["said", 1, {"b": 2}], ["left", 2],
        ["player", 1, "Ann", "ann@x", [b"1", b"3"]], ["shared", {}], ["said", 5, {}], ["left", 5],
    ]  # fmt: skip
    kept = restored(notes)
    ann = kept.players[1]
    assert (list(kept.players), kept.attributes, kept.shared) == ([1], {1: {"b": 2}}, {})
    assert (ann.name, ann.subject, ann.tokens, ann.settled) == ("Ann", "ann@x", [b"1", b"3"], {4: 0, 9: 2})
    assert (ann.command, ann.verdicts) == (9, [])
    assert whole(restored(whole(kept))) == whole(kept)
