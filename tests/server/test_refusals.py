"""Refusals of commands and edits with a reason: on the wire, after a lost connection or a restart, at the client."""

from pathlib import Path
from typing import Any

import msgpack
import pytest

from client_sdk.events import Answered
from server.players.persisted_state import restored, whole
from server.players.player import SETTLED_MAX, Player
from server.rules import Rules
from shared import messages
from shared.messages import Command, Hello, Inputs, Refusal, Welcome
from sovereign_netcode.playtest import Link, Match
from sovereign_netcode.playtest.match import wander
from tests.server.test_persisted_state import Stored
from tests.server.test_rules import verdict
from tests.tables import HELLO, FakeLink, Table, order
from tests.worlds import scene


class Fussy(Rules):
    """Rules that refuse in every way."""

    def on_command(self, player: Player, name: str, payload: Any) -> bool | str | None:
        return payload if name == "echo" else name

    def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool | str:
        return f"no {kind} here" if kind > 5 else kind < 5


def commands(*payloads: Any, first: int = 1) -> list[Command]:
    return [Command(first + at, 0, 0.0, "echo", msgpack.packb(each)) for at, each in enumerate(payloads)]


def in_order(link: FakeLink) -> list[str]:
    """Returns the kinds of messages of the latest tick in which one was sent."""
    return [type(message).__name__ for message in link.sent]


def test_a_text_refuses_a_command_and_is_sent_ahead_of_the_verdict() -> None:
    table = Table(rules=Fussy())
    link = table.join()
    table.tick(4)
    link.sent.clear()
    link.say(*commands("too far", True, False, None, ""))
    table.tick()
    assert link.got(Refusal) == [Refusal(1, "too far")]
    assert in_order(link) == ["Refusal", "Snapshot"]
    expected = [messages.FORBIDDEN, messages.DONE, messages.FORBIDDEN, messages.DONE, messages.FORBIDDEN]
    assert [verdict(link, number) for number in range(1, 6)] == expected
    link.sent.clear()
    table.tick(3)
    assert set(in_order(link)) == {"Snapshot"}


def test_a_text_refuses_an_edit() -> None:
    table = Table(rules=Fussy())
    link = table.join()
    table.tick(32)
    link.say(order(1, 0, 18, 16, 1, 7), order(2, 0, 18, 16, 1, 5), order(3, 0, 18, 16, 1, 4))
    table.tick()
    assert link.got(Refusal) == [Refusal(1, "no 7 here")]
    assert [verdict(link, n) for n in (1, 2, 3)] == [messages.FORBIDDEN, messages.FORBIDDEN, messages.DONE]
    assert table.game.world.blocks.get(18, 16, 1) == 4


@pytest.mark.parametrize(("given", "sent"), [("x" * 501, "x" * 500), ("\ud800?", "??"), ("é" * 500, "é" * 500)])
def test_every_text_can_be_sent(given: str, sent: str) -> None:
    class Odd(Rules):
        def on_command(self, player: Player, name: str, payload: Any) -> str:
            return given

    table = Table(rules=Odd())
    link = table.join()
    link.say(*commands(None))
    table.tick()
    assert link.got(Refusal) == [Refusal(1, sent)]


def test_a_reason_is_sent_again_with_its_verdict() -> None:
    table = Table(rules=Fussy(), resume_s=5.0)
    link = table.join()
    link.say(Inputs(table.tick_number + 1, table.tick_number, bytes(3)), *commands("no wood"))
    table.lose(link)  # before the tick that answers it
    table.tick()
    again = table.connect(Hello(messages.VERSION, {}, "", resume=link.got(Welcome)[0].resume))
    table.tick()
    assert (again.got(Refusal), verdict(again, 1)) == ([Refusal(1, "no wood")], messages.FORBIDDEN)
    again.sent.clear()
    again.say(*commands("no wood"))
    table.tick()
    assert (again.got(Refusal), verdict(again, 1)) == ([Refusal(1, "no wood")], messages.FORBIDDEN)


def test_reasons_are_bounded_with_their_verdicts() -> None:
    player = Player(1)
    for number in range(SETTLED_MAX + 5):
        player.settle(number, messages.FORBIDDEN, f"{number}")
    assert list(player.reasons) == list(player.settled) == list(range(5, SETTLED_MAX + 5))


def test_a_reason_survives_a_restart(tmp_path: Path) -> None:
    first = Stored(tmp_path, Fussy())
    link = first.connect(HELLO)
    first.tick(2)
    link.say(Inputs(first.tick_number + 1, first.tick_number, bytes(3)), *commands("no wood", True))
    first.tick(2)
    first.stop()
    second = Stored(tmp_path, Fussy())
    again = second.connect(Hello(messages.VERSION, {}, "", resume=link.got(Welcome)[-1].resume))
    second.tick()
    again.say(*commands("no wood", True))
    second.tick()
    assert again.got(Refusal) == [Refusal(1, "no wood")]
    second.stop()


def test_notes_hold_reasons() -> None:
    notes: list[list[Any]] = [
        ["player", 1, "Ann", "", [b"1"]], ["answered", 1, 3, 0], ["answered", 1, 4, 5, "no wood"],
    ]  # fmt: skip
    kept = restored(notes)
    assert (kept.players[1].settled, kept.players[1].reasons) == ({3: 0, 4: 5}, {4: "no wood"})
    again = restored(whole(kept))
    assert (again.players[1].settled, again.players[1].reasons) == ({3: 0, 4: 5}, {4: "no wood"})


def test_the_client_gets_the_reason_with_the_result() -> None:
    match = Match(scene([[0, 0, 0, 32, 32, 1, 1]], origin=(0, 0, 0), size=(1, 1, 1)), seed=1, rules=Fussy())
    player = match.join(wander, Link(0.05))
    match.run_until(lambda: player.core.state == "playing", 5)
    numbers = [player.core.command("echo", each) for each in ("no wood", True, False)]
    match.run(1)
    answers = [event for event in player.events if isinstance(event, Answered)]
    assert answers == [
        Answered(numbers[0], False, "no wood"),
        Answered(numbers[1], True, "done"),
        Answered(numbers[2], False, "not allowed"),
    ]
    assert player.core.stats.divergences == 0
