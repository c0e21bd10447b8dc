"""Dodge: two teams throw slow balls at each other. A player who is hit three times is out for three seconds.

    sovereign-server --game sovereign_netcode.examples.dodge:Dodge

Everything that players do at once, such as dashes, throws and hits, is in `dodge_behaviours`, so clients predict it.
The rules deal out teams, count points, and bring players back. They keep no state in Python variables, so a saved game
continues where it was.
"""

import contextlib
from dataclasses import replace
from typing import Any

from sovereign_netcode.examples.dodge_behaviours import BEHAVIOURS
from sovereign_netcode.examples.dodge_brain import DodgePlayer, wish
from sovereign_netcode.examples.fillers import fill_up
from sovereign_netcode.server import Player, Rules
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.scene import Scene, Template
from sovereign_netcode.shared.units import SEGMENT
from sovereign_netcode.shared.world import OverlapError

THINK_TICKS = 4
TEAMS = ("blue", "yellow")
PLAYERS = ("player", "dashing", "out")
"""Templates of those who play."""
BALL = Template("ball", (-0.2, -0.2, -0.2), (0.4, 0.4, 0.4), solid=False, shown="predicted", gravity=4.0)


class Dodge(Rules):
    """The rules of dodge.

    Attributes: "name", "team" (0 or 1), "score" (hits), "hits" (hits taken, as far as they are counted). Shared: "ends"
    (the tick at which the round ends), "points" (opponents that each team has put out, by its name). Events: "out" with
    {"by", "who"}, "round" with {"winner"}: the name of a team, or "nobody".
    """

    scene = "meadow"
    behaviours = BEHAVIOURS
    keys = {"dash": "left shift", "fire": "left mouse"}  # noqa: RUF012 - nobody changes it
    players_min = 6
    """Least number of entities that play. The server adds players of its own while fewer are connected."""
    round_s = 120.0

    def prepare(self, scene: Scene) -> Scene:
        scene = replace(scene, reach=0.0).with_changes(scene.player, friction=24.0)
        scene = scene.with_buttons("dash", "fire", aim=True)
        scene = scene.with_template("dashing", walk_speed=14.0)
        scene = scene.with_template("out", walk_speed=0.0, jump_speed=0.0)
        return replace(scene, templates=(*scene.templates, BALL))

    def bot_policy(self, random: Any) -> DodgePlayer:
        return DodgePlayer(random)

    def on_start(self) -> None:
        self._next_round()

    def on_join(self, player: Player) -> None:
        self._enlist(player.entity)

    def on_tick(self) -> None:
        game = self.game
        larger = 1 - self._smaller(self._everybody())
        playing = sorted(self._everybody(), key=lambda entity: game.field(entity, "team") == larger)
        fill_up(game, playing, self.players_min, self._add)  # the last ones leave first
        for entity in self._everybody():
            self._count_hits(entity)
        for entity in game.entities("out"):
            if game.tick >= game.field(entity, "until"):
                self._bring_back(entity)
        if game.tick >= game.shared["ends"]:
            points = game.shared["points"]
            best = [team for team in TEAMS if points[team] == max(points.values())]
            game.send("round", {"winner": best[0] if len(best) == 1 else "nobody"})
            self._next_round()
        if game.tick % THINK_TICKS == 0:
            self._steer()

    def _everybody(self) -> list[int]:
        return sorted(entity for template in PLAYERS for entity in self.game.entities(template))

    def _count_hits(self, entity: int) -> None:
        """Gives the thrower a point for each hit that an entity took since the latest tick."""
        game = self.game
        hits = game.field(entity, "hits")
        new = (hits - game.get(entity, "hits", 0)) & 0xFFFF
        if not new:
            return
        game.set(entity, "hits", hits)
        by = game.field(entity, "hit_by")
        if by in game:
            game.set(by, "score", game.get(by, "score", 0) + new)
        if game.template(entity) == "out":
            points = dict(game.shared["points"])
            points[TEAMS[1 - game.field(entity, "team")]] += 1
            game.share("points", points)
            game.send("out", {"by": by, "who": entity})

    def _bring_back(self, entity: int) -> None:
        """Puts an entity on a place of its team, with full health."""
        game = self.game
        with contextlib.suppress(OverlapError):  # the place is occupied: try another one in the next tick
            game.place(entity, game.random.choice(self._places(game.field(entity, "team"))))
            game.throw(entity, (0.0, 0.0, 0.0))
            game.change(entity, "player")
            game.set_field(entity, "health", 3)

    def _places(self, team: int) -> list[Vec]:
        """Returns the spawn points of a team: the western or the eastern half of them."""
        places = sorted(self.game.scene.spawns)
        half = len(places) // 2
        return (places[:half] if team == 0 else places[-half:]) or places

    def _next_round(self) -> None:
        game = self.game
        game.share("ends", game.tick + game.ticks(self.round_s))
        game.share("points", dict.fromkeys(TEAMS, 0))
        for entity in self._everybody():
            game.set(entity, "score", 0)
            self._bring_back(entity)

    def _enlist(self, entity: int) -> None:
        """Puts a new entity into the smaller team."""
        game = self.game
        team = self._smaller([other for other in self._everybody() if other != entity])
        game.set_field(entity, "team", team)
        game.set(entity, "team", team)
        game.set(entity, "score", 0)

    def _smaller(self, entities: list[int]) -> int:
        """Returns the team that fewer of the entities are in."""
        teams = [self.game.field(entity, "team") for entity in entities]
        return int(2 * sum(teams) < len(teams))

    def _add(self, place: Vec, name: str) -> None:
        self._enlist(self.game.spawn("player", place, name=name))

    def _steer(self) -> None:
        game = self.game
        x, y, z = ((a + b / 2) * SEGMENT for a, b in zip(game.scene.origin, game.scene.size, strict=True))
        active, balls = [*game.entities("player"), *game.entities("dashing")], game.entities("ball")
        for entity in active:
            if entity not in game.players:
                made = wish(game, (x, y, z), entity, game.tick, active, balls)
                game.steer(entity, made.x, made.y, buttons=made.buttons, aim=made.aim)
