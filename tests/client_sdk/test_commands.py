"""Tests of the commands of a client that have no answer yet."""

from client_sdk.commands import SentCommands
from shared.snapshot import VERDICT


def test_a_command_is_not_for_an_earlier_tick_than_one_before_it() -> None:
    commands = SentCommands()
    assert commands.tick(7) == 7
    for tick in (7, 30, 30):
        commands.file(commands.command(tick, 0.0, "go", None))
    assert commands.tick(12) == 30, "the server would carry it out after the others, which wait for tick 30"
    assert commands.tick(31) == 31
    commands.answer(VERDICT.pack(1, 0))
    assert commands.tick(12) == 30
    commands.answer(VERDICT.pack(3, 0) + VERDICT.pack(2, 0))
    assert commands.tick(12) == 12
    commands.file(commands.command(30, 0.0, "go", None))
    commands.give_up("gone")
    assert commands.tick(12) == 12
