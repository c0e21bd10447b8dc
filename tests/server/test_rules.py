"""Rules of a game: hooks, what they may do, what clients get, and that failing rules stop nobody."""

from dataclasses import replace
from typing import Any

import msgpack
import pytest

from server.config.limits import Limits
from server.game_api.values import ATTRIBUTES_MAX
from server.players.player import Player
from server.replication.flow_control import FlowControl
from server.rules import Rules, RulesError, load_rules
from shared import messages
from shared.checks import SceneError
from shared.inputs import NEUTRAL
from shared.messages import Command, Happened, Hello, Inputs, NextHappened, Shared, Snapshot, Welcome
from tests.tables import HELLO, FakeLink, Table, gone, order, whole
from tests.worlds import scene


class Recorder(Rules):
    """Rules that record the calls of their hooks."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def on_start(self) -> None:
        self.calls.append(("start",))

    def on_join(self, player: Player) -> None:
        self.calls.append(("join", player.entity, player.name, player.entity in self.game))

    def on_leave(self, player: Player) -> None:
        self.calls.append(("leave", player.entity, player.entity in self.game))

    def on_command(self, player: Player, name: str, payload: Any) -> bool | None:
        self.calls.append(("command", player.entity, name, payload))
        return name != "no"

    def on_contact(self, a: int, b: int) -> None:
        self.calls.append(("contact", a, b, self.game.tick))

    def on_fell_out(self, entity: int) -> bool | None:
        self.calls.append(("fell", entity))
        return None

    def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool:
        return kind != 7


@pytest.fixture
def rules() -> Recorder:
    return Recorder()


@pytest.fixture
def table(rules: Recorder) -> Table:
    return Table(rules=rules)


def attributes(link: FakeLink) -> dict[int, Any]:
    """Returns the attributes that a client knows from all its snapshots."""
    known: dict[int, Any] = {}
    for snapshot in link.got(Snapshot):
        for part in snapshot.segments:
            said = whole(part)[9]
            known.update(zip(said[::2], said[1::2], strict=True))
    return known


def verdict(link: FakeLink, number: int) -> int:
    (found,) = (
        snapshot.verdicts[at + 4]
        for snapshot in link.got(Snapshot)
        for at in range(0, len(snapshot.verdicts), 5)
        if int.from_bytes(snapshot.verdicts[at : at + 4], "little") == number
    )
    return int(found)


def test_join_and_leave_hooks_run_while_the_entity_exists(table: Table, rules: Recorder) -> None:
    link = table.connect(Hello(messages.VERSION, {}, "Ann"))
    table.tick()
    table.lose(link)
    table.tick()
    assert rules.calls == [("start",), ("join", 1, "Ann", True), ("leave", 1, True)]


def test_commands_come_with_their_data_and_are_answered(table: Table, rules: Recorder) -> None:
    link = table.join()
    table.tick(16)  # the edits of two seconds
    data = {"at": [1, 2.5, None], "why": "because"}
    link.say(
        Command(1, 0, 0.0, "yes", msgpack.packb(data)),
        Command(2, 0, 0.0, "no", msgpack.packb(None)),
        Command(3, 0, 0.0, "yes", b"\xc1"),
        order(4, 0, 18, 16, 1, 7),
        order(5, 0, 18, 16, 1, 6),
    )
    table.tick()
    assert [call for call in rules.calls if call[0] == "command"] == [
        ("command", 1, "yes", data),
        ("command", 1, "no", None),
    ]
    answers = [messages.DONE, messages.FORBIDDEN, messages.INVALID, messages.FORBIDDEN, messages.DONE]
    assert [verdict(link, number) for number in range(1, 6)] == answers
    assert table.game.world.blocks.get(18, 16, 1) == 6


def test_without_rules_a_command_is_not_possible() -> None:
    table = Table()
    link = table.join()
    link.say(Command(1, 0, 0.0, "fly", msgpack.packb(None)))
    table.tick()
    assert verdict(link, 1) == messages.INVALID


def test_a_contact_is_reported_once_when_it_begins(table: Table, rules: Recorder) -> None:
    game = table.game.api
    table.tick()
    a, b = game.spawn("runner", (10.0, 16.0, 1.0)), game.spawn("runner", (12.0, 16.0, 1.0))
    table.tick(2)
    assert not [call for call in rules.calls if call[0] == "contact"]
    game.steer(a, 1, 0)
    table.tick(40)  # walks against the other one and goes on
    ((_, *pair, begun),) = [call for call in rules.calls if call[0] == "contact"]
    assert pair == [a, b]
    assert game.position(a)[0] == 11.375
    game.steer(a, -1, 0)
    table.tick(10)
    game.steer(a, 1, 0)
    table.tick(20)
    contacts = [call for call in rules.calls if call[0] == "contact"]
    assert len(contacts) == 2
    assert contacts[1][3] > begun + 10


def test_a_contact_is_not_missed_in_a_tick_with_a_join(table: Table, rules: Recorder) -> None:
    game = table.game.api
    table.tick()
    a, b = game.spawn("runner", (10.0, 16.0, 1.0)), game.spawn("runner", (12.0, 16.0, 1.0))
    game.steer(a, 1, 0)
    while not game.touching(a):
        table.tick()
    table.join()  # the record of the step is written before its contacts are looked for
    assert [call[:3] for call in rules.calls if call[0] == "contact"] == [("contact", a, b)]


def test_touching_returns_contacts_however_long_they_last(table: Table) -> None:
    game = table.game.api
    a, b, c = (game.spawn("runner", (x, 16.0, 1.0)) for x in (10.0, 11.0, 10.0 - 0.625))
    assert (game.touching(a), game.touching(b), game.touching(c)) == ([c], [], [a])
    game.steer(a, 1, 0)
    table.tick(40)
    assert (game.touching(a), game.touching(b), game.touching(c)) == ([b], [a], [])
    with pytest.raises(KeyError):
        game.touching(99)


def test_an_entity_that_falls_out_is_handled_by_the_rules_or_returns(table: Table, rules: Recorder) -> None:
    link = table.join()
    table.game.world.place(link.session.entity, (16.0, 16.0, -3.0))
    table.tick(2)
    assert ("fell", 1) in rules.calls
    assert table.game.world.position(1)[2] >= 1.0


def test_attributes_reach_all_clients_that_see_the_entity_and_change(table: Table) -> None:
    early = table.connect(Hello(messages.VERSION, {}, "Ann"))
    table.tick()
    game = table.game.api
    npc = game.spawn("runner", (10.0, 16.0, 1.0), mood="calm")
    table.tick()
    late = table.connect(Hello(messages.VERSION, {}, ""))
    table.tick()
    assert attributes(early) == attributes(late) == {1: {"name": "Ann"}, npc: {"mood": "calm"}}
    count = len(early.got(Snapshot))
    game.set(npc, "mood", "calm")  # no change
    table.tick()
    assert not any(whole(part)[9] for snapshot in early.got(Snapshot)[count:] for part in snapshot.segments)
    game.set(npc, "mood", None)
    game.set(npc, "hunger", 0.5)
    table.tick()
    assert attributes(early)[npc] == attributes(late)[npc] == {"hunger": 0.5}
    assert (game.get(npc, "hunger"), game.get(npc, "mood", "none")) == (0.5, "none")


def test_an_entity_that_comes_into_view_brings_its_attributes() -> None:
    table = Table(size=(4, 1, 1), fill=[[0, 0, 0, 128, 32, 1, 1]], spawns=((16.0, 16.0, 1.0),))
    link = table.join()
    game = table.game.api
    far = game.spawn("runner", (112.0, 16.0, 1.0), team="red")
    table.tick(2)
    assert far not in attributes(link)
    game.place(far, (63.0, 16.0, 1.0))
    table.tick()
    assert attributes(link)[far] == {"team": "red"}


@pytest.mark.parametrize("wide", [False, True])
def test_attributes_of_a_crowd_are_spread_over_messages_and_all_arrive(
    wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if wide:
        monkeypatch.setattr(FlowControl, "room", lambda *_: 1 << 30)
    table = Table(size=(3, 3, 1), fill=[[0, 0, 0, 96, 96, 1, 1]], spawns=((48.0, 48.0, 1.0),))
    game = table.game.api
    rich: dict[str, Any] = {f"a{n}": "x" * 90 for n in range(ATTRIBUTES_MAX)}
    for segment in range(9):
        x, y = 32 * (segment % 3), 32 * (segment // 3)
        for place in range(70):
            game.spawn("runner", (x + 3.0 + 2 * (place % 10), y + 3.0 + 2 * (place // 10), 1.0), **rich)
    early = table.join()  # the link checks the length of a message
    table.tick(60)
    game.set(1, "a0", "news")
    late = table.join()
    table.tick(60)
    for link in (early, late):
        assert {entity: len(values) for entity, values in attributes(link).items()} == dict.fromkeys(range(1, 631), 32)
        assert attributes(link)[1]["a0"] == "news"
    assert table.game.faults.total == 0


def test_events_reach_their_players_once(table: Table) -> None:
    ann, bob = table.join(), table.join()
    game = table.game.api
    game.send("all", {"n": 1})
    game.send("ann", [2], to=game.players[ann.session.entity])
    game.send("none", to=[])
    table.tick(3)
    tick = table.tick_number - 2
    assert ann.got(Happened) == [
        Happened(tick, "all", msgpack.packb({"n": 1})),
        Happened(tick, "ann", msgpack.packb([2])),
    ]
    assert bob.got(Happened) == [Happened(tick, "all", msgpack.packb({"n": 1}))]


def test_events_wait_for_a_slow_client_and_the_oldest_of_too_many_are_dropped_and_counted() -> None:
    table = Table(Limits(outbox_max=5), rules=Rules())
    link = table.join()
    link.waiting = 1 << 20
    for n in range(5):
        table.game.api.send("n", n)
        table.tick()
    assert not link.got(Happened)
    link.waiting = 0
    table.tick()
    assert [msgpack.unpackb(happened.payload) for happened in link.got(Happened)] == list(range(5))
    link.waiting = 1 << 20
    link.sent.clear()
    for n in range(7):
        table.game.api.send("n", n)
        table.tick()
    link.waiting = 0
    table.tick()
    assert not link.closings
    assert link.got(NextHappened) == [NextHappened(7)], "five events from before, and two"
    assert [msgpack.unpackb(happened.payload) for happened in link.got(Happened)] == list(range(2, 7))
    assert link.sent.index(NextHappened(7)) < link.sent.index(link.got(Happened)[0])
    assert table.game.counters.events_dropped == 2


def test_events_to_a_reconnecting_player_are_sent_after_the_reconnect_and_lost_ones_are_counted() -> None:
    table = Table(rules=Rules(), resume_s=9.0)
    link = table.join()
    link.say(Inputs(0, table.tick_number, b""))
    game = table.game.api
    game.send("lost on its way")
    table.tick()
    table.lose(link)
    table.tick(2)
    game.send("away")
    game.send("to another", to=[])
    table.tick(2)
    again = table.connect(HELLO._replace(resume=link.got(Welcome)[-1].resume))
    table.tick(3)
    game.send("back")
    table.tick(2)
    assert again.got(NextHappened) == [NextHappened(1)]
    assert [happened.name for happened in again.got(Happened)] == ["away", "back"]
    assert again.sent.index(NextHappened(1)) < again.sent.index(again.got(Happened)[0])


def test_no_events_are_kept_for_an_in_process_player() -> None:
    table = Table(rules=Rules())
    link = table.join()
    player = link.session.player
    assert player is not None
    player.inputs.override = NEUTRAL
    table.game.api.send("n")
    table.tick()
    assert len(player.outbox) == 0
    assert not link.got(Happened)


def test_shared_values_reach_all_clients_and_later_ones(table: Table) -> None:
    early = table.join()
    game = table.game.api
    game.share("left_s", 60)
    game.share("winner", "Ann")
    table.tick()
    game.share("left_s", 59)
    game.share("winner", None)
    table.tick()
    game.share("left_s", 59)
    table.tick()
    late = table.join()
    assert early.got(Shared) == [Shared({"left_s": 60, "winner": "Ann"}), Shared({"left_s": 59})]
    assert late.got(Shared) == [Shared({"left_s": 59})]
    assert dict(game.shared) == {"left_s": 59}


def test_a_list_that_is_changed_in_place_is_sent_when_it_is_set_again(table: Table) -> None:
    link, game = table.join(), table.game.api
    bag = ["key"]
    game.set(1, "bag", bag)
    game.share("teams", {"red": [1]})
    table.tick()
    bag.append("lamp")
    game.shared["teams"]["red"].append(2)
    assert (game.get(1, "bag"), game.shared["teams"]) == (["key"], {"red": [1]})
    table.tick()
    game.set(1, "bag", bag)
    mine = game.get(1, "bag")
    mine.append("rope")
    game.set(1, "bag", mine)
    teams = dict(game.shared)["teams"]
    teams["red"].append(2)
    game.share("teams", teams)
    table.tick()
    assert attributes(link)[1]["bag"] == ["key", "lamp", "rope"]
    assert link.got(Shared)[-1] == Shared({"teams": {"red": [1, 2]}})
    assert game.get(1, "bag") == ["key", "lamp", "rope"]


def test_values_that_only_python_holds_equal_are_sent(table: Table) -> None:
    link, game = table.join(), table.game.api
    for value in ([1], [True], [1.0], (1.0,)):
        game.share("value", value)
        table.tick()
    values = [shared.values["value"] for shared in link.got(Shared)]
    assert [(value, type(value[0])) for value in values] == [([1], int), ([True], bool), ([1.0], float)]


def test_too_long_values_are_refused_by_name(table: Table) -> None:
    game = table.game.api
    npc = game.spawn("runner", (10.0, 16.0, 1.0))
    for value, why in (("x" * 300, "bytes"), (object(), "MessagePack"), ({1: 2}, "MessagePack")):
        with pytest.raises(SceneError, match=f"mood.*{why}"):
            game.set(npc, "mood", value)
    for n in range(ATTRIBUTES_MAX):
        game.set(npc, f"a{n}", n)
    with pytest.raises(SceneError, match="32 values"):
        game.set(npc, "one more", 1)
    with pytest.raises(SceneError, match="name"):
        game.share("n" * 33, 1)
    with pytest.raises(SceneError, match="send"):
        game.send("big", "x" * 2000)
    with pytest.raises(KeyError):
        game.set(99, "mood", 1)
    before = len(table.game.world)
    with pytest.raises(SceneError, match="mood"):
        game.spawn("runner", (20.0, 16.0, 1.0), mood=object())
    too_many: dict[str, Any] = {f"a{n}": n for n in range(ATTRIBUTES_MAX + 1)}
    with pytest.raises(SceneError, match="32 values"):
        game.spawn("runner", (20.0, 16.0, 1.0), **too_many)
    assert len(table.game.world) == before


def test_rules_cannot_steer_or_remove_players(table: Table) -> None:
    table.join()
    with pytest.raises(SceneError, match="player"):
        table.game.api.steer(1, 1, 0)
    with pytest.raises(SceneError, match="player"):
        table.game.api.remove(1)


class Tidy(Rules):
    def on_leave(self, player: Player) -> None:
        self.game.remove(player.entity)


def test_rules_may_remove_a_leaving_player() -> None:
    table = Table(rules=Tidy())
    first, second = table.join(), table.join()
    table.lose(first)
    table.tick()
    assert gone(second.got(Snapshot)[-1]) == [1]
    assert list(table.game.players) == [2]
    assert table.game.counters.rules_failed == 0


class Broken(Rules):
    def on_join(self, *arguments: object) -> None:
        raise RuntimeError("on purpose")

    on_leave = on_tick = on_start = on_command = on_contact = on_fell_out = can_edit = on_join  # type: ignore[assignment]


def test_rules_that_raise_are_counted_and_logged_and_stop_nothing(caplog: pytest.LogCaptureFixture) -> None:
    table = Table(rules=Broken())
    link = table.join()
    table.tick(10)
    link.say(Command(1, 0, 0.0, "any", msgpack.packb(None)), order(2, 0, 18, 16, 1, 5))
    table.tick()
    assert (verdict(link, 1), verdict(link, 2)) == (messages.FAILED, messages.FORBIDDEN)
    table.lose(link)
    table.tick()
    assert len(table.game.world) == 0
    assert table.game.counters.rules_failed > 12
    for hook in ("on_join", "no. 1 at", "no. 10 at"):  # one failure of each hook, and then ever fewer log lines
        assert hook in caplog.text
    assert len(caplog.records) < 10
    assert "on purpose" in caplog.text


class Misspelled(Rules):
    def on_comand(self) -> None: ...


def test_randomness_is_the_same_in_the_same_tick() -> None:
    drawn = []
    for ticks in (5, 5, 6):
        table = Table()
        table.tick(ticks)
        drawn.append([table.game.api.random.random() for _ in range(3)])
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_scene_gets_a_template_more() -> None:
    before = scene()
    after = before.with_template("frozen", walk_speed=0.0, jump_speed=0.0)
    assert [template.name for template in after.templates] == [*(t.name for t in before.templates), "frozen"]
    assert after.templates[-1].box_size == before.templates[before.index_of[before.player]].box_size
    for like, changes, why in (
        ("nobody", {}, "like"),
        (None, {"speed": 1}, "speed"),
        (None, {"walk_speed": -1}, "walk"),
    ):
        with pytest.raises(SceneError, match=why):
            before.with_template("frozen", like, **changes)
    with pytest.raises(SceneError, match="same name"):
        after.with_template("frozen")


def test_a_template_of_a_scene_is_changed() -> None:
    before = scene().with_template("frozen", walk_speed=0.0)
    after = before.with_changes("person", friction=12.0)
    player, frozen = after.templates[after.template("person")], after.templates[after.template("frozen")]
    assert player == replace(before.templates[before.template("person")], friction=12.0)
    assert frozen == before.templates[before.template("frozen")]
    for name, changes, why in (("nobody", {}, "nobody"), ("person", {"speed": 1}, "speed")):
        with pytest.raises(SceneError, match=why):
            before.with_changes(name, **changes)


def test_a_scene_gets_further_buttons() -> None:
    after = scene().with_buttons("dash").with_buttons("fire", aim=True)
    assert after.buttons == (*scene().buttons, "dash", "fire")
    assert after.with_buttons("duck").aim
    assert not scene().with_buttons("dash").aim
    with pytest.raises(SceneError, match="twice"):
        after.with_buttons("dash")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("tag", "module:Class"), ("no_such_module:Tag", "No module"), ("server.rules:", "module:Class"),
        ("tests.server.test_rules:Nobody", "no attribute"),
        ("tests.server.test_rules:Misspelled", "on_comand is no hook"),
        ("tests.server.test_rules:Table", "subclass"),
    ],
)  # fmt: skip
def test_rules_that_cannot_be_loaded_say_why(name: str, why: str) -> None:
    with pytest.raises(RulesError, match=why):
        load_rules(name)


def test_rules_are_loaded_by_name() -> None:
    assert type(load_rules("server.rules:Rules")) is Rules
