"""A race seen from above: cars accelerate, drift, and boost as long as they have fuel. Five laps win.

    sovereign-server --game sovereign_netcode.examples.race:Race

How a car moves is its template; boosts and fuel are a behaviour (`race_behaviours`). Clients predict both. The rules
count gates and laps, in attributes, so a saved race continues where it was.
"""

import contextlib
from dataclasses import replace
from typing import Any

from sovereign_netcode.examples.fillers import fill_up
from sovereign_netcode.examples.race_behaviours import BEHAVIOURS
from sovereign_netcode.examples.race_brain import GATES, PADS, RacePlayer, drive, passes
from sovereign_netcode.server import Player, Rules
from sovereign_netcode.shared.checks import SceneError, Vec
from sovereign_netcode.shared.scene import Scene
from sovereign_netcode.shared.world import OverlapError

THINK_TICKS = 4
GRID = tuple((14.0 + 4 * (k // 2), 4.0 + 4 * (k % 2), 1.0) for k in range(12))
"""Places at the start."""


class Race(Rules):
    """The rules of the race.

    Attributes: "name", "gate" (number of the next gate), "score" (laps). Events: "lap" with {"who", "laps"}, "won" with
    {"who"}.
    """

    scene = "topdown"
    behaviours = BEHAVIOURS
    keys = {"boost": "space"}  # noqa: RUF012 - nobody changes it
    players_min = 4
    """Least number of cars. The server adds cars of its own while fewer players are connected."""
    laps = 5

    def prepare(self, scene: Scene) -> Scene:
        if scene.name != "topdown":
            raise SceneError(f"scene = {scene.name!r}: the race has its course in the scene 'topdown'")
        scene = replace(scene, spawns=GRID, buttons=("boost",), reach=0.0)
        scene = scene.with_changes("player", walk_speed=10.0, acceleration=9.0, friction=2.5)
        return scene.with_template("boosting", walk_speed=17.0, acceleration=20.0).with_kind("pad", 9)

    def bot_policy(self, random: Any) -> RacePlayer:
        return RacePlayer(random)

    def on_start(self) -> None:
        for x, y in PADS:
            for i in range(-1, 2):
                for j in range(-1, 2):
                    self.game.set_block(x + i, y + j, 0, self.game.kind("pad"))

    def on_join(self, player: Player) -> None:
        self._line_up(player.entity)

    def on_tick(self) -> None:
        game = self.game
        fill_up(game, game.entities(), self.players_min, self._add)
        for car in game.entities():
            if passes(game.position(car), game.get(car, "gate")):
                self._passed(car)
        if game.tick % THINK_TICKS == 0:
            for car in game.entities():
                if car not in game.players:
                    gate, fuel = game.get(car, "gate"), game.field(car, "fuel")
                    x, y, boost = drive(game.position(car), game.velocity(car), gate, fuel)
                    game.steer(car, x, y, buttons={"boost": boost})

    def _passed(self, car: int) -> None:
        """Counts a gate, the lap that ends with it, and the race that ends with that."""
        game = self.game
        gate = (game.get(car, "gate") + 1) % len(GATES)
        game.set(car, "gate", gate)
        if gate:
            return
        laps = game.get(car, "score") + 1
        game.set(car, "score", laps)
        game.send("lap", {"who": car, "laps": laps})
        if laps >= self.laps:
            game.send("won", {"who": car})
            for other in game.entities():
                self._line_up(other)
                with contextlib.suppress(OverlapError):  # it starts from where it is
                    game.place(other, game.random.choice(GRID))
                    game.throw(other, (0.0, 0.0, 0.0))

    def _line_up(self, car: int) -> None:
        self.game.set(car, "gate", 0)
        self.game.set(car, "score", 0)

    def _add(self, place: Vec, name: str) -> None:
        self._line_up(self.game.spawn("player", place, name=name))
