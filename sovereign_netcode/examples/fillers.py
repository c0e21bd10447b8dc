"""Players of the server's own in the example games, which play while few players are connected."""

import contextlib
from collections.abc import Callable, Sequence

from sovereign_netcode.server.game_api.api import GameApi
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.world import OverlapError

NAMES = ("Ada", "Bo", "Cleo", "Dag", "Elif", "Finn", "Gus", "Hana", "Ivo", "Juno")


def fill_up(game: GameApi, playing: Sequence[int], least: int, add: Callable[[Vec, str], object]) -> None:
    """Adds or removes the server's own players, so that at least `least` entities play.

    Args:
        game: the game.
        playing: the entities that play; the last ones of the server's own leave first.
        least: least number of them.
        add: spawns a player of the server's own at a position, with a name.
    """
    own = [entity for entity in playing if entity not in game.players]
    for entity in own[max(least - len(game.players), 0) :]:
        game.remove(entity)
    for _ in range(least - len(game.players) - len(own)):
        place = game.random.choice(game.scene.spawns)
        free = [name for name in NAMES if name not in [game.get(entity, "name") for entity in game.entities()]]
        with contextlib.suppress(OverlapError):  # the place is occupied: try again in the next tick
            add(place, game.random.choice(free or NAMES))
