"""A lobby: players walk in a hall, and those who step into the ring there play a duel in a world of its own.

    sovereign-server --config lobby.toml        # the file: docs/worlds.md

The hall is the default world. Each duel is a world of the kind *duel*, which begins when two players stand in the ring,
and ends when one of them has won. Then both are back in the hall, with their victories. A client may ask for a duel
itself: `Client.match(url, "duel")`.
"""

from typing import Any

from sovereign_netcode.client_sdk.bots import Random
from sovereign_netcode.server import Player, Rules, WorldsError
from sovereign_netcode.shared.inputs import Input, make_input
from sovereign_netcode.shared.world import World

RING = ((28.0, 28.0, 0.0), (36.0, 36.0, 31.0))
"""Corners of the ring, in blocks."""
RIM, RIM_KIND = ((27, 27), (36, 27), (27, 36), (36, 36)), 5
"""Blocks (x, y) of the posts around the ring, and their kind."""
STOMPS = 3
"""Number of stomps that win a duel."""
DUEL_S, ALONE_S = 60.0, 30.0
"""Longest duel, and longest wait for the opponent, in seconds."""


class Hall(Rules):
    """The rules of the hall.

    Attributes: "name", "score" (duels won). Shared: "duels" (number of duels that are being played).
    """

    scene = "meadow"

    def bot_policy(self, random: Any) -> "Walker":
        return Walker(random)

    def on_start(self) -> None:
        game = self.game
        game.add_zone("ring", *RING)
        for x, y in RIM:
            ground = next((z for z in range(31, -1, -1) if game.block(x, y, z)), 0)
            for z in range(ground + 1, min(ground + 4, 31)):
                game.set_block(x, y, z, RIM_KIND)

    def on_join(self, player: Player) -> None:
        handed = player.handed or {}
        self.game.set(player.entity, "score", handed.get("won", 0))

    def on_tick(self) -> None:
        game = self.game
        ready = [game.players[entity] for entity in game.inside("ring") if entity in game.players]
        ready = [player for player in ready if player.session is not None]
        for a, b in zip(ready[::2], ready[1::2], strict=False):
            try:
                duel = game.worlds.create("duel", of=f"{a.name} and {b.name}"[:64])
            except WorldsError:
                break  # too many duels: they wait in the ring
            for player in (a, b):
                game.send_away(player, duel, {"won": game.get(player.entity, "score", 0)}, "a duel")
        if game.tick % game.ticks(1) == 0:
            game.share("duels", len(game.worlds.entries("duel")))


class Duel(Rules):
    """The rules of a duel: who lands on the other's head gets a point.

    Attributes: "name", "score" (stomps), "won" (duels won before). Shared: "ends" (the tick at which the duel ends).
    """

    scene = "meadow"

    def bot_policy(self, random: Any) -> "Walker":
        return Walker(random)

    def on_join(self, player: Player) -> None:
        game = self.game
        game.set(player.entity, "score", 0)
        game.set(player.entity, "won", (player.handed or {}).get("won", 0))
        if len(game.players) == 2:
            game.worlds.lock()
            game.share("ends", game.tick + game.ticks(DUEL_S))
        else:
            game.after(ALONE_S, "give_up")

    def give_up(self) -> None:
        """Ends a duel without an opponent."""
        if "ends" not in self.game.shared:
            self.game.share("ends", self.game.tick)

    def on_contact(self, a: int, b: int) -> None:
        game = self.game
        above, below = sorted((a, b), key=lambda entity: -game.position(entity)[2])
        if game.position(above)[2] - game.position(below)[2] > 1.0:
            game.set(above, "score", game.get(above, "score", 0) + 1)
            game.throw(above, (0.0, 0.0, 9.0))

    def on_leave(self, player: Player) -> None:
        if "ends" in self.game.shared:
            self.game.share("ends", self.game.tick)  # the other one has won

    def on_tick(self) -> None:
        game = self.game
        if "ends" not in game.shared or not game.players:
            return
        scores = {entity: game.get(entity, "score", 0) for entity in game.players}
        if game.tick < game.shared["ends"] and max(scores.values()) < STOMPS:
            return
        best = [entity for entity, score in scores.items() if score == max(scores.values())]
        for entity, player in tuple(game.players.items()):
            won = best == [entity]
            total = game.get(entity, "won", 0) + won
            game.send_away(player, "", {"won": total}, "you won the duel" if won else "the duel is over")


class Walker:
    """A client's policy that walks to the ring, or to the middle of a duel, and jumps now and then."""

    def __init__(self, random: Random) -> None:
        self._random = random

    def __call__(self, world: World, me: int) -> Input:
        x, y, _ = world.position(me)
        east, north = self._near(32.0) - x, self._near(32.0) - y
        return make_input(east, north, jump=self._random.random() < 0.1)

    def _near(self, place: float) -> float:
        return place + 6.0 * (self._random.random() - 0.5)
