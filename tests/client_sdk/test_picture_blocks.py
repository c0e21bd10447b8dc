"""A picture's needs besides positions: blocks, the segments that have changed, and where entities look."""

import numpy as np
import pytest

from client_sdk.client import Client
from client_sdk.loopback import Loopback
from server.game import Game
from server.players.player import Player
from server.rules import Rules
from shared.checks import SceneError
from shared.scene import load_scene


class NoEdits(Rules):
    """Rules that refuse edits of kind 9."""

    def can_edit(self, player: Player, x: int, y: int, z: int, kind: int) -> bool:
        return kind != 9


class Play:
    """A client within the program, and its clock."""

    def __init__(self, scene: str = "flat") -> None:
        self.client: Client = Loopback(Game(load_scene(scene), rules=NoEdits())).join("Ann")
        self.now = 0.0

    def run(self, seconds: float, x: float = 0.0, y: float = 0.0) -> None:
        until = self.now + seconds
        while self.now < until:
            self.client.poll(self.now)
            self.client.set_input(x, y)
            self.client.update(self.now)
            self.now += 1 / 60

    def facing(self) -> tuple[float, float]:
        me = self.client.view(self.now).me
        assert me is not None
        return me.facing


def test_the_first_look_has_all_segments_and_the_next_one_only_changes() -> None:
    play = Play()
    assert play.client.blocks_changed() == set()
    assert play.client.block(64, 64, 0) is None
    play.run(3)
    assert play.client.core.prediction is not None
    assert play.client.blocks_changed() == set(play.client.core.prediction.predicted.blocks) != set()
    assert play.client.blocks_changed() == set()
    me = play.client.view(play.now).me
    assert me is not None
    x, y, z = (int(part) for part in me.position)
    play.client.edit(x + 2, y, z, 5)
    play.client.edit(x + 3, y, z, 9)
    play.run(0.05)
    own = {(x // 32, y // 32, z // 32)}
    assert play.client.blocks_changed() == own
    assert (play.client.block(x + 2, y, z), play.client.block(x + 3, y, z)) == (5, 9)
    play.run(1)
    assert play.client.blocks_changed() == own, "the refused block has gone"
    assert (play.client.block(x + 2, y, z), play.client.block(x + 3, y, z)) == (5, 0)
    assert play.client.segment((x // 32, y // 32, z // 32))[z % 32, y % 32, (x + 2) % 32] == 5


def test_a_segment_that_is_not_loaded_is_air() -> None:
    play = Play()
    assert not play.client.segment((0, 0, 0)).any()
    assert play.client.segment((0, 0, 0)).shape == (32, 32, 32)
    play.run(2)
    assert play.client.core.prediction is not None
    (own, *_) = sorted(play.client.core.prediction.predicted.blocks)
    loaded = play.client.segment(own)
    assert np.count_nonzero(loaded) > 0
    loaded[:] = 0
    assert play.client.segment(own).any(), "a copy was returned"
    with pytest.raises(SceneError, match=r"1\.5"):
        play.client.block(1.5, 0, 0)  # type: ignore[arg-type]


def test_an_entity_looks_where_it_last_walked() -> None:
    play = Play()
    play.run(2)
    assert play.facing() == (1.0, 0.0)
    play.run(0.5, 0, -1)
    assert play.facing() == (0.0, -1.0)
    play.run(0.5)
    assert play.facing() == (0.0, -1.0)
    play.run(0.3, -3, 4)
    assert play.facing() == pytest.approx((-0.6, 0.8), abs=0.01)
