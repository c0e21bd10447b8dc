"""Announcements of predicted turns are given once; and clients without the right behaviours are refused by name."""

import pytest

from client_sdk import Client, Loopback
from client_sdk.core import Core
from client_sdk.events import Announced, Left, Withdrawn
from client_sdk.prediction.announcements import Announcements
from server.game import Game
from server.rules import Rules
from shared.behaviours import Behaviour, field
from shared.body import Body
from shared.checks import SceneError
from shared.inputs import Input
from shared.messages import Bye, decode_from_client
from shared.payloads import pack_value
from shared.turns import Announcement
from sovereign_netcode.playtest import Link, Match
from tests.behaving import BUTTONS, CLASSES, Acrobat, Crate, Playground, Presser, Shot, scene

DASH, FIRE = (1 << BUTTONS.index(name) for name in ("dash", "fire"))
Given = list[tuple[str, int, object]]


def event(name: str, data: object = None, entity: int = 1) -> Announcement:
    return Announcement(entity, name, pack_value(data))


def given(announcements: Announcements) -> Given:
    """Returns the new events of the program: "+" or "-", the number, and the name or the data."""
    return [
        ("+", each.number, each.data if each.data is not None else each.name)
        if isinstance(each, Announced)
        else ("-", each.number, each.name)
        for each in announcements.take()
    ]


def replay(announcements: Announcements, tick: int, final: bool, *again: tuple[int, Announcement]) -> Given:
    """Replays the ticks after `tick`, in which these events are announced."""
    announcements.begin(tick, final)
    for at, each in again:
        announcements.add(at, each)
    announcements.end()
    return given(announcements)


def predicted(*events: tuple[int, Announcement]) -> Announcements:
    """Returns announcements of a prediction, which the program has got."""
    announcements = Announcements(32)
    for at, each in events:
        announcements.add(at, each)
    given(announcements)
    return announcements


def test_each_event_has_a_number_of_its_own_and_its_data() -> None:
    announcements = Announcements(32)
    announcements.add(5, event("dash", {"left": 3}))
    announcements.add(5, event("dash"))
    announcements.add(6, event("shot", [1, 2], 4))
    assert given(announcements) == [("+", 1, {"left": 3}), ("+", 2, "dash"), ("+", 3, [1, 2])]
    assert given(announcements) == []


def test_a_replay_that_announces_the_same_gives_nothing_however_often() -> None:
    events = [(5, event("dash")), (5, event("dash")), (7, event("shot"))]
    announcements = predicted(*events)
    for _ in range(5):
        assert replay(announcements, 4, True, *events) == []


def test_an_event_that_moves_a_little_is_the_same_and_one_far_away_is_another() -> None:
    announcements = predicted((5, event("dash")))
    assert replay(announcements, 4, True, (8, event("dash"))) == []
    assert replay(announcements, 4, True, (13, event("dash"))) == []
    assert replay(announcements, 4, True, (30, event("dash"))) == [("+", 2, "dash"), ("-", 1, "dash")]


def test_the_nearest_event_is_taken_and_the_others_are_withdrawn() -> None:
    announcements = predicted((5, event("dash")), (9, event("dash")))
    assert replay(announcements, 4, True, (8, event("dash"))) == [("-", 1, "dash")]
    assert replay(announcements, 4, True, (8, event("dash"))) == []
    assert replay(announcements, 4, True) == [("-", 2, "dash")]


def test_events_of_other_entities_and_names_are_others() -> None:
    announcements = predicted((5, event("dash")))
    assert replay(announcements, 4, True, (5, event("dash", entity=2)), (5, event("duck"))) == [
        ("+", 2, "dash"), ("+", 3, "duck"), ("-", 1, "dash"),
    ]  # fmt: skip


def test_a_confirmed_event_is_never_withdrawn() -> None:
    announcements = predicted((5, event("dash")), (6, event("shot")))
    announcements.confirm(5)
    assert replay(announcements, 5, True) == [("-", 2, "shot")]
    announcements = predicted((5, event("dash")), (6, event("shot")))
    assert replay(announcements, 6, True) == []


def test_events_of_ticks_that_were_wrong_are_withdrawn() -> None:
    announcements = predicted((5, event("dash")), (6, event("shot")))
    assert replay(announcements, 6, False) == [("-", 1, "dash"), ("-", 2, "shot")]


def test_data_that_differ_in_a_replay_are_no_reason_to_give_an_event_twice() -> None:
    announcements = predicted((5, event("dash", 3)))
    assert replay(announcements, 4, True, (5, event("dash", 4))) == []


def test_all_that_a_program_is_told_over_a_bad_link_adds_up_to_what_the_server_did() -> None:
    match = Match(scene(()), 4, rules=Playground())
    player = match.join(Presser(), Link(0.1, 0.05))
    match.run_until(lambda: player.core.state == "playing", 20)
    for _ in range(30):
        match.run(0.5)
        player.suspend(0.2)
    numbers = [each.number for each in player.events if isinstance(each, Announced)]
    gone = [each.number for each in player.events if isinstance(each, Withdrawn)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(set(gone)) == len(gone)
    assert set(gone) <= set(numbers)
    assert len(numbers) > 20


class Caster(Behaviour):
    templates = ("player",)
    mana = field(bits=8, start=1)

    def turn(self, me: Body) -> None:
        if me.pressed("dash"):
            me.announce("dash")
        if me.pressed("fire") and me.mana:
            me.announce("cast")


class Drained(Rules):
    """Rules that take all mana away at a tick."""

    behaviours = (Caster,)
    at = 1 << 30

    def on_tick(self) -> None:
        for entity in self.game.players if self.game.tick == self.at else ():
            self.game.set_field(entity, "mana", 0)


def test_snapshots_that_come_at_once_withdraw_only_what_came_after_the_first_difference() -> None:
    rules = Drained()
    match = Match(scene(()), 1, rules=rules)
    presses: list[int] = []
    player = match.join(lambda core, rng: Input(0, 0, presses.pop(0) if presses else 0), Link(0.1, 0.0))
    match.run_until(lambda: player.core.state == "playing", 20)
    match.run(1)
    prediction = player.core.prediction
    assert prediction is not None
    first = prediction.predicted.tick + 1
    rules.at = first + 2
    presses += [DASH, 0, 0, FIRE]
    match.run_until(lambda: not presses, 5)
    match.run(1 / 32)
    player.suspend(0.5)
    match.run(3)
    said = [(each.name, each.tick - first) for each in player.events if isinstance(each, Announced)]
    gone = [each.name for each in player.events if isinstance(each, Withdrawn)]
    assert [name for name, _ in said] == ["dash", "cast"]
    assert gone == ["cast"]


# -- wrong classes -------------------------------------------------------------------------------------------

OTHER = type("Crate", (Crate,), {"turns": field(bits=39)})


@pytest.mark.parametrize(
    ("classes", "text"),
    [
        ((), "the game needs the class Acrobat; pass it as behaviours=[...]"),
        ((Acrobat, Shot), "the game needs the class Crate"),
        ((Acrobat, Shot, OTHER), "the class Crate differs from the server's"),
    ],
)
def test_a_client_without_the_right_classes_leaves_and_names_the_class(
    classes: tuple[type[Behaviour], ...], text: str
) -> None:
    match = Match(scene(()), 1, rules=Playground())
    core = Core(behaviours=classes)
    player = match.join(lambda core, rng: Input(), Link(), core)
    sent: list[bytes] = []
    send = player.up.send

    def also(message: bytes) -> None:
        sent.append(message)
        send(message)

    player.up.send = also  # type: ignore[method-assign]
    match.run(2)
    left = [each for each in player.events if isinstance(each, Left)]
    assert len(left) == 1
    assert text in left[0].reason
    assert core.state == "closed"
    last = decode_from_client(sent[-1], 9)
    assert isinstance(last, Bye)  # so the server keeps no seat for the player
    assert text in last.reason


def test_a_client_may_have_more_classes_than_the_game_needs() -> None:
    match = Match(scene((Crate,)), 1)
    player = match.join(lambda core, rng: Input(), Link(), Core(behaviours=CLASSES))
    match.run(2)
    assert player.core.state == "playing"


@pytest.mark.parametrize("classes", [(int,), Acrobat, None, (Acrobat, Acrobat), ("Acrobat",), (Acrobat(),)])
def test_arguments_that_are_no_classes_of_behaviours_are_refused(classes: object) -> None:
    with pytest.raises(SceneError, match="behaviours"):
        Core(behaviours=classes)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="behaviours"):
        Client.connect("ws://localhost:1", behaviours=classes)  # type: ignore[arg-type]


def test_a_loopback_has_the_classes_of_its_rules() -> None:
    class Rest(Rules):
        behaviours = CLASSES

    client = Loopback(Game(scene(()), rules=Rest())).join("Ann")
    for tick in range(64):
        client.poll(tick / 32)
        client.update(tick / 32)
    view = client.view(2.0)
    assert view.me is not None
    assert view.me.fields["stamina"] == 200
