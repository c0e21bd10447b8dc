"""A server that ended and was restored from its store, in simulated time: its clients go on in the restored world.

The time of the restored world is behind the one that a client knows, by the time for which there was no server.
"""

import random
from itertools import product
from pathlib import Path

import pytest

from client_sdk.core import Core
from client_sdk.events import Corrected, Diverged, Resumed
from client_sdk.netsim.links import PRESETS, Link
from server.game import Game
from server.persistence.store import Store
from server.worlds.host import Way
from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, Player
from tests.lengths import long
from tests.patience import until

WAYS = ((127, 0), (0, 127), (-127, 0), (0, -127))


def walks(core: Core, rng: random.Random) -> Input:
    """A policy that changes its direction in about every third tick."""
    return Input(*rng.choice(WAYS)) if rng.random() < 0.3 else core.input


class Restored(Match):
    """A match whose world is saved in a directory, and whose server can end and come back."""

    def __init__(self, directory: Path, seed: int) -> None:
        super().__init__(load_scene("flat"), seed)
        self._directory, self.runs = directory, True
        self._load()
        self.on_tick.append(lambda: until(lambda: self.store.durable_tick == self.game.world.tick))

    def _load(self) -> None:
        self.store = Store(self._directory, self.game.scene, power=False)
        self.game = Game(self.game.scene, world=self.store.world, saves=self.store, seed=self.seed)
        self.store.start(self.game.keep)

    def route(self, path: str) -> Way | str:
        return super().route(path) if self.runs else "there is no server"

    def _tick(self) -> None:
        if self.runs:
            super()._tick()

    def end(self) -> None:
        """Ends the server. Its clients get no message."""
        self.runs = False
        for player in self.players:
            player.disconnect()
        assert self.store.close()

    def restore(self) -> None:
        """Starts the server again from its store."""
        self._load()
        self.runs = True
        self._started = int(self.now * self.game.scene.tick_rate) + 1
        self.at(self._started / self.game.scene.tick_rate, self._tick)


def played(directory: Path, seed: int, link: Link, away_s: float, before_s: float = 4) -> tuple[Restored, Player]:
    """Returns a match whose server was away for a time, as soon as its player goes on, and the player."""
    match = Restored(directory, seed)
    player = match.join(walks, link, Core("Ann", patience_s=60))
    match.run_until(lambda: player.core.state == "playing", 30)
    match.run(before_s)
    player.events.clear()
    match.end()
    match.run(away_s)
    match.restore()
    match.run_until(lambda: player.core.state == "playing", 30)
    return match, player


@pytest.mark.parametrize(
    ("seed", "delay_s", "away_s"),
    [
        (1, 0.05, 2.5),
        (2, 0.02, 0.9),
        *long(*product((3, 4), (0.01, 0.1), (1.2, 3, 9))),
    ],
)
def test_a_client_goes_on_at_the_time_of_a_restored_world(
    tmp_path: Path, seed: int, delay_s: float, away_s: float
) -> None:
    match, player = played(tmp_path, seed, Link(delay_s), away_s)
    core, rate = player.core, match.game.scene.tick_rate
    for _ in range(8):
        assert core.prediction
        assert 0 <= core.prediction.predicted.tick - match.game.world.tick <= (delay_s + 0.2) * rate
        match.run(0.25)
    assert [type(event) for event in player.events if isinstance(event, Resumed | Corrected | Diverged)] == [Resumed]
    queue = match.game.players[core.entity].inputs
    assert (queue.refused, queue.late) == (0, 0)
    used, tick = queue.used, match.game.world.tick
    match.run(2)
    assert queue.used - used == match.game.world.tick - tick
    assert match.store.close()


@pytest.mark.parametrize(("seed", "away_s"), [(16, 0.7), *long((30, 0.5), (33, 0.5), (38, 0.5))])
def test_inputs_that_a_restored_server_lacks_are_late_and_no_divergence(
    tmp_path: Path, seed: int, away_s: float
) -> None:
    match, player = played(tmp_path, seed, PRESETS["far"], away_s, before_s=6)
    match.run(2)
    assert {event.cause for event in player.events if isinstance(event, Corrected)} == {"late input"}
    assert not any(isinstance(event, Diverged) for event in player.events)
    assert match.store.close()


def test_inputs_for_the_time_before_a_stop_are_withdrawn_after_a_reconnect() -> None:
    """The server stood still while the client was away, and has inputs for ticks that the client makes again."""
    match = Match(load_scene("flat"), 1)
    player = match.join(walks, Link(0.05), Core("Ann", patience_s=60))
    core = player.core
    match.run_until(lambda: core.state == "playing", 30)
    match.run(4)
    match.run_until(lambda: core.clock.next_ping > player.local + 0.95, 3)
    match._started += 4 * match.game.scene.tick_rate
    match.run(0.8)
    queue = match.game.players[core.entity].inputs
    before = match.game.world.tick
    assert max(queue.waiting) - before > 16
    player.disconnect()
    match.run_until(lambda: core.state == "playing", 30)
    assert core.prediction
    newest = core.prediction.predicted.tick
    match.run(0.06)
    assert max(queue.waiting) <= newest + 3 < before + 32
    player.events.clear()
    match.run(3)
    assert len([event for event in player.events if isinstance(event, Corrected)]) <= 1
