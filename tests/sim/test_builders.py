"""Players that dig and place beside each other: no prediction diverges, and every edit gets its verdict."""

import random

import pytest

from client_sdk.bots import Bot, DigAndPlace
from client_sdk.core import Core
from client_sdk.events import Answered, Diverged
from shared import edits
from shared.inputs import Input
from shared.messages import Command, decode_from_client
from shared.scene import load_scene
from sovereign_netcode.playtest import Link, Match, Player
from tests.lengths import long


class Building:
    """A bot as a policy of a match, until it is stopped."""

    def __init__(self, seed: int) -> None:
        self._bot = Bot(DigAndPlace(random.Random(seed)))
        self.stopped = False

    def __call__(self, core: Core, rng: random.Random) -> Input:
        if not self.stopped:
            self._bot(core)
        return core.input


def ordered(player: Player) -> list[int]:
    """Returns the numbers of the edits that arrive at the server. They are counted on the link, as they are
    delivered."""
    numbers: list[int] = []
    receive = player.up._deliver

    def deliver(message: bytes) -> None:
        command = decode_from_client(message)
        if isinstance(command, Command) and command.name == edits.NAME:
            numbers.append(command.number)
        receive(message)

    player.up._deliver = deliver
    return numbers


LAN, TYPICAL = Link(0.001), Link(0.05, 0.01, 0.01)


@pytest.mark.parametrize(
    ("path", "scene", "seconds"),
    [
        (TYPICAL, "hills", 10),
        *long((TYPICAL, "flat", 20), (TYPICAL, "hills", 20), (LAN, "flat", 20), (LAN, "hills", 20)),
    ],
)
def test_builders_do_not_diverge_and_get_every_verdict(path: Link, scene: str, seconds: float) -> None:
    match = Match(load_scene(scene), 12)
    policies = [Building(seed) for seed in range(5)]
    players = [match.join(policy, path) for policy in policies]
    asked = [ordered(player) for player in players]
    match.run(seconds)
    for policy in policies:
        policy.stopped = True
    match.run(2)
    verdicts = []
    for player, numbers in zip(players, asked, strict=True):
        answers = [event for event in player.events if isinstance(event, Answered)]
        assert [event.number for event in answers] == numbers == list(range(1, len(numbers) + 1))
        assert len(numbers) > 0.75 * seconds
        verdicts += [event.verdict for event in answers]
        assert not [event for event in player.events if isinstance(event, Diverged)]
        assert player.core.stats.divergences == 0
        assert set(player.core.stats.corrections_by_cause) <= {"unknown edit", "other entity", "late input"}
        assert player.core.prediction is not None
        assert not player.core.prediction._edits, "every edit has its verdict"
    assert verdicts.count("done") > len(verdicts) / 2
    assert set(verdicts) <= {"done", "an entity is in the way", "out of reach", "not possible there"}
