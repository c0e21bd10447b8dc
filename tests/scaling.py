"""Helpers for tests of a world on many processes: rules, policies, kills by chance, and what has to hold."""

import random
from collections import Counter
from typing import Any

from client_sdk.core import Core
from client_sdk.events import Answered, Corrected, Diverged, Happened
from client_sdk.netsim.links import Link
from server.players.player import Player
from server.rules import Rules
from server.scale.wire import record_of
from shared.inputs import Input, make_input
from sovereign_netcode.playtest.match import Player as Participant
from sovereign_netcode.playtest.match import Policy, wander
from sovereign_netcode.playtest.scaled import ScaledMatch, Seat

ROUGH = {"jitter_s": 0.003, "stop": (3.0, 0.08), "twice": 0.02}
"""A bus whose messages are late, stop for up to 80 ms about every 3 s, and come twice at times."""
PATH = Link(delay_s=0.03, jitter_s=0.005)


class Tally(Rules):
    """Counts the commands of each player in shared values, and sends an event for each."""

    def on_command(self, player: Player, name: str, data: Any) -> bool:
        self.game.share(player.name, self.game.shared.get(player.name, 0) + 1)
        self.game.set(player.entity, "latest", data)
        self.game.send("did", data, to=player)
        return True


def causes(player: Participant) -> Counter[str]:
    """Returns how many corrections of each cause a player had."""
    return Counter(event.cause for event in player.events if isinstance(event, Corrected))


def hashes_agree(match: ScaledMatch) -> None:
    """Checks that all parts had the same world at the ticks of the log at which they compared it."""
    ticks = [record.tick for record in map(record_of, match.log.records) if record.journal is not None]
    assert match.differ == []
    assert ticks == list(range(1, len(ticks) + 1))
    assert set(match.hashes) == {tick for tick in ticks if tick % match.hash_every == 0} != set()


def asks(sent: Counter[str]) -> Policy:
    """Returns a policy that wanders and sends a command in every fifth tick or so."""

    def policy(core: Core, rng: random.Random) -> Input:
        if rng.random() < 0.2:
            sent[core.name] += 1
            core.command("go", sent[core.name])
        return wander(core, rng)

    return policy


def edits(core: Core, rng: random.Random) -> Input:
    """Wanders, and places and removes blocks."""
    if rng.random() < 0.1:
        assert core.prediction is not None
        x, y, z = core.prediction.predicted.position(core.entity)
        core.edit(int(x) + rng.randint(-2, 2), int(y) + rng.randint(-2, 2), int(z) + 1, rng.randint(0, 1))
    return wander(core, rng)


def torment(match: ScaledMatch, seconds: float, seed: int) -> None:
    """Runs a match and kills an edge or the sequencer every second or two. Replaces each part that was killed.

    Half of them lose what they have sent last: batches that are on their way, and records ahead of the log.
    """
    rng, until = random.Random(seed), match.now + seconds

    def kill() -> None:
        if match.now > until:
            return
        living = [edge for edge in match.edges if edge.alive]
        if rng.random() < 0.4 and len(living) > 1:
            match.add_edge()
            match.kill(rng.choice(living), lossy=rng.random() < 0.5)
        elif match.sequencer.alive:
            match.add_standby()
            match.kill(match.sequencer, lossy=rng.random() < 0.5)
        match.at(match.now + rng.uniform(0.8, 2.5), kill)

    match.at(match.now + rng.random(), kill)
    match.run(seconds)


def roam(match: ScaledMatch, rng: random.Random, seconds: float) -> None:
    """Moves a player to an edge, both by chance, now and again after each time of this length."""

    def move() -> None:
        player = rng.choice(match.players)
        assert isinstance(player, Seat)
        player.move(match.some_edge())
        match.at(match.now + seconds, move)

    match.at(match.now, move)


def calm(match: ScaledMatch, seconds: float = 6.0) -> None:
    """Lets the players do nothing new until everything was answered."""
    for player in match.players:
        player.policy = lambda core, rng: core.input
    match.run(seconds)


def slow_walk(core: Core, rng: random.Random) -> Input:
    """Keeps a direction for a second or so, and places and removes blocks, so that inputs and edits change little."""
    if rng.random() < 0.1:
        assert core.prediction is not None
        x, y, z = core.prediction.predicted.position(core.entity)
        core.edit(int(x) + rng.randint(-2, 2), int(y) + rng.randint(-2, 2), int(z) + 1, rng.randint(0, 1))
    return make_input(rng.uniform(-1, 1), rng.uniform(-1, 1)) if rng.random() < 0.03 else core.input


def played_right(match: ScaledMatch, sent: Counter[str] | None = None) -> None:
    """Checks that nothing was lost or doubled, that no client differs, and that all parts are equal.

    Args:
        match: the match, whose rules are `Tally` if there is a count.
        sent: number of commands by the name of the player; None: there were only edits.
    """
    for player in match.players:
        answered = Counter(event.number for event in player.events if isinstance(event, Answered))
        assert player.core.state == "playing"
        assert set(answered.values()) <= {1}, "each command is answered once"
        if sent is not None:
            name = player.core.name
            assert match.sequencer.core.api.shared.get(name, 0) == sent[name] == len(answered), "and carried out once"
            events = [event.data for event in player.events if isinstance(event, Happened)]
            assert events == sorted(set(events)), "each event comes once, in order"
        assert [event for event in player.events if isinstance(event, Diverged)] == []
        assert [each for each in player.events if isinstance(each, Corrected) and each.cause == "nondeterminism"] == []
    hashes_agree(match)
