"""A client judges its shots ahead: by the same rays, among what it draws."""

import random
from typing import Any

import pytest

from client_sdk.core import Core
from client_sdk.drawn import Drawn
from client_sdk.events import Answered
from client_sdk.netsim.links import PRESETS
from server.config.limits import Limits
from server.players.player import Player
from server.rules import Rules
from shared.inputs import Input
from shared.scene import load_scene
from sovereign_netcode.playtest import Match, wander
from tests.lengths import long_but

EYE = (0.0, 0.0, 1.5)
SHOTS_PER_TICK = 0.3
LOOK_BACK_S = Limits().rewind_s
"""A shot at what was drawn longer ago is judged by the oldest world that the server keeps, in seconds."""


class Range(Rules):
    """Rules that answer a shot with whether it hit an entity first."""

    def on_command(self, player: Player, name: str, payload: Any) -> bool:
        origin, way = payload
        hits = self.game.rewound(player).ray(origin, way, 64)
        return bool(hits) and hits[0].entity is not None


@pytest.mark.parametrize("link", long_but(["typical"], ["lan", "regional", "typical", "wifi"]))
def test_the_server_confirms_a_hit_that_the_client_has_judged_ahead(link: str) -> None:
    """Holds where the server looks back far enough; on `far` the others are drawn longer ago than that."""
    match = Match(load_scene("arena"), seed=9, rules=Range())
    guesses: dict[tuple[int, int], bool] = {}

    def shoots(core: Core, rng: random.Random) -> Input:
        player = next(each for each in match.players if each.core is core)
        view = core.view(player.local)
        if view.me is not None and view.others and rng.random() < SHOTS_PER_TICK:
            assert core.prediction is not None
            assert core.scene is not None
            if core.prediction.next_order - view.seen > LOOK_BACK_S * core.scene.tick_rate:
                return wander(core, rng)
            x, y, z = (part + eye for part, eye in zip(view.me.position, EYE, strict=True))
            target = rng.choice(view.others).position
            way = (target[0] - x + rng.uniform(-1, 1), target[1] - y, target[2] + 1 - z)
            hits = Drawn(view, core.scene, core.prediction).ray((x, y, z), way, 64)
            number = core.command("shoot", [(x, y, z), way])
            guesses[core.entity, number] = bool(hits) and hits[0].entity is not None
        return wander(core, rng)

    for _ in range(3):
        match.join(shoots, PRESETS[link])
    match.run(12)
    answers = {
        (player.core.entity, event.number): event.done
        for player in match.players
        for event in player.events
        if isinstance(event, Answered)
    }
    assert len(answers) > 100
    assert 0.1 < sum(answers.values()) / len(answers) < 0.9
    assert {key: guesses[key] for key in answers} == answers
