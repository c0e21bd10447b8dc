"""A view is made of what has changed since the one before. It must be the same as one that is made from nothing."""

import random
from dataclasses import replace

import pytest

from client_sdk.core import Core
from client_sdk.view import View
from client_sdk.view_builder import ViewBuilder
from server.rules import Rules
from shared.scene import Scene, Template, load_scene
from shared.world import OverlapError
from sovereign_netcode.playtest import PRESETS, Match, Player, wander


class Everything(Rules):
    """Rules that spawn, remove, place, throw, change and label entities at random."""

    def on_tick(self) -> None:
        game = self.game
        draw, templates = game.random, [template.name for template in game.scene.templates]
        place = draw.uniform(20, 44), draw.uniform(20, 44), draw.uniform(20, 30)
        entities = list(game.entities())
        entity = draw.choice(entities) if entities else 0
        act = draw.choice((0, 0, 1, 2, 2, *[3] * 10, 4, 4))
        try:
            if entity:
                game.throw(entity, (draw.uniform(-9, 9), draw.uniform(-9, 9), 5))
            if act == 0 or not entity:
                game.spawn(draw.choice(templates), place)
            elif act == 1 and entity not in game.players:
                game.remove(entity)
            elif act == 2:
                game.place(entity, place)
            elif act == 3:
                game.change(entity, draw.choice(templates))
            elif act == 4:
                game.set(entity, "label", draw.randrange(3))
        except OverlapError:
            pass  # another entity is there


def scene(shown: str) -> Scene:
    """Returns a scene with two templates beside the player's; the first is shown as `shown`."""
    ball = Template("ball", (-0.3, -0.3, -0.3), (0.6, 0.6, 0.6), solid=False, shown=shown)
    box = Template("box", (-0.6, -0.6, -0.6), (1.2, 1.2, 1.2))
    hills = load_scene("hills")
    return replace(hills, templates=(*hills.templates, ball, box))


def anew(core: Core, now: float) -> View:
    """Returns the view of a builder that has made none before: it has only what is no part of a view."""
    play = core._worlds.play
    assert play is not None
    old, world = play.world.view_builder, play.world
    new = ViewBuilder(world.scene, world.prediction)
    new.interpolation._states = old.interpolation._states
    new.interpolation.delay_ticks = old.interpolation.delay_ticks
    new._delay, new._viewed = old._delay, old._viewed
    new._smoothing, new._facings = old._smoothing, dict(old._facings)
    return new.view(play.timeline, world.clock, now)


def compared(players: list[Player]) -> int:
    """Compares a view of each player with one made from nothing. Returns the number of other entities in them."""
    entities = 0
    for player in players:
        if player.core.state == "playing":
            view = player.core.view(player.local)
            assert view == anew(player.core, player.local)
            assert [other.entity for other in view.others] == sorted({other.entity for other in view.others})
            entities += len(view.others)
    return entities


@pytest.mark.parametrize("shown", ["interpolated", "predicted"])
@pytest.mark.parametrize("link", ["typical", "outage"])
def test_a_view_depends_on_the_present_alone(shown: str, link: str) -> None:
    match = Match(scene(shown), 7, rules=Everything())
    players = [match.join(wander, PRESETS[link]) for _ in range(3)]
    entities, frames = 0, random.Random(3)
    while match.now < 6:
        match.run(frames.choice((0.002, 0.01, 0.03, 0.2)))
        entities += compared(players)
    assert entities > 1000
