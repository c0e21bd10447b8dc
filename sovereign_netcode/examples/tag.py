"""Tag: the player who is "it" is a little faster and tags another by touching. The least time as "it" wins the round.

    sovereign-server --game sovereign_netcode.examples.tag:Tag

The rules keep no state in Python variables, so a saved game continues where it was. The player who is "it" has another
template (clients predict its speed), scores are attributes, and the end of the round is a shared value.
"""

from typing import Any

from sovereign_netcode.examples.fillers import fill_up
from sovereign_netcode.examples.tag_brain import TagPlayer, wish
from sovereign_netcode.server import Player, Rules
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.scene import Scene
from sovereign_netcode.shared.units import SEGMENT

THINK_TICKS = 4
TRUNK, LEAVES = 5, 6


class Tag(Rules):
    """The rules of tag.

    Attributes: "name", "score" (seconds of not being it), "safe" (the entity cannot be tagged before this tick).
    Shared: "ends" (the tick at which the round ends). Events: "tagged" with {"by", "who"}, "round" with {"winner"}.
    """

    scene = "meadow"
    players_min = 6
    """Least number of entities that play. The server adds runners of its own while fewer players are connected."""
    round_s = 120.0
    safe_s = 2.0

    def prepare(self, scene: Scene) -> Scene:
        return scene.with_template("it", walk_speed=5.75)

    def bot_policy(self, random: Any) -> TagPlayer:
        return TagPlayer(random)

    def on_start(self) -> None:
        self._plant_trees(12)

    def on_join(self, player: Player) -> None:
        self.game.set(player.entity, "score", 0)

    def on_tick(self) -> None:
        game = self.game
        fill_up(game, game.entities(), self.players_min, self._add)
        everybody = game.entities()
        if everybody and not game.entities("it"):
            game.change(game.random.choice(everybody), "it")
        for it in game.entities("it"):
            for other in game.touching(it):
                if game.tick >= game.get(other, "safe", 0):
                    self._hand_over(it, other)
                    break
        if game.tick >= game.shared.get("ends", 0):
            self._next_round(everybody)
        if game.tick % game.ticks(1) == 0:
            for entity in game.entities("player"):
                game.set(entity, "score", game.get(entity, "score", 0) + 1)
        if game.tick % THINK_TICKS == 0:
            self._steer()

    def _hand_over(self, it: int, other: int) -> None:
        game = self.game
        game.change(it, "player")
        game.change(other, "it")
        game.set(it, "safe", game.tick + game.ticks(self.safe_s))
        game.send("tagged", {"by": it, "who": other})

    def _next_round(self, everybody: list[int]) -> None:
        game = self.game
        if "ends" in game.shared and everybody:
            game.send("round", {"winner": max(everybody, key=lambda entity: game.get(entity, "score", 0))})
        game.share("ends", game.tick + game.ticks(self.round_s))
        for entity in everybody:
            game.set(entity, "score", 0)

    def _add(self, place: Vec, name: str) -> None:
        self.game.spawn("player", place, name=name, score=0)

    def _steer(self) -> None:
        game = self.game
        places = {entity: game.position(entity) for entity in game.entities()}
        its = game.entities("it")
        safe = {entity for entity in places if game.tick < game.get(entity, "safe", 0)}
        for entity in places:
            if entity not in game.players:
                x, y, jump = wish(game.scene, entity, game.tick, places, game.velocity(entity), its, safe)
                game.steer(entity, x, y, jump=jump)

    def _plant_trees(self, count: int) -> None:
        game = self.game
        west, south, low = (SEGMENT * part for part in game.scene.origin)
        width, depth, height = (SEGMENT * part for part in game.scene.size)
        for _ in range(count):
            x, y = (int(part) + game.random.randrange(-22, 23) for part in game.random.choice(game.scene.spawns)[:2])
            x, y = min(max(x, west + 1), west + width - 2), min(max(y, south + 1), south + depth - 2)
            top = next((z for z in range(low + height - 1, low - 1, -1) if game.block(x, y, z)), None)
            if top is None or top > low + height - 8 or game.block(x, y, top) == LEAVES:
                continue  # no ground, no room below the top of the world, or a tree
            ground = top + 1
            for z in range(ground, ground + 4):
                game.set_block(x, y, z, TRUNK)
            for i in range(-1, 2):
                for j in range(-1, 2):
                    for k in range(3, 6 if i * j == 0 else 5):
                        if not game.block(x + i, y + j, ground + k):
                            game.set_block(x + i, y + j, ground + k, LEAVES)
