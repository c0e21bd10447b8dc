"""The behaviour of bots in tag. One function steers both the server's own runners and the bots that are clients."""

import math
from collections.abc import Collection, Mapping
from typing import Any

from sovereign_netcode.client_sdk.bots import Random
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.inputs import Input, make_input
from sovereign_netcode.shared.scene import Scene
from sovereign_netcode.shared.units import SEGMENT
from sovereign_netcode.shared.world import World

AFRAID_BLOCKS = 11.0
"""Distance to the player who is "it" below which a bot flees, in blocks."""


def wish(
    scene: Scene,
    me: int,
    tick: int,
    places: Mapping[int, Vec],
    velocity: Vec,
    its: Collection[int],
    safe: Collection[int],
) -> tuple[float, float, bool]:
    """Returns a direction (east, north) and whether to jump.

    An entity that is "it" chases the nearest entity that can be tagged. The others flee from the one that is "it".

    Args:
        me: the entity to steer.
        places: positions of all entities, by entity.
        velocity: the velocity of `me`.
        its: entities that are "it".
        safe: entities that cannot be tagged now.
    """
    here = places[me]
    preys = [place for entity, place in places.items() if entity != me and entity not in safe]
    hunters = [places[entity] for entity in its if entity in places]
    stroll = 2.4 * me + 1.9 * ((tick + 37 * me) // 96)  # a new direction every three seconds, different for each entity
    if me in its and preys:
        x, y = _way(here, min(preys, key=lambda place: math.dist(place, here)))
    elif me not in its and hunters and (way := math.dist(hunters[0], here)) < AFRAID_BLOCKS:
        x, y = _way(hunters[0], here)
        side = 0.0 if way < 4 else 0.5 if me % 2 else -0.5
        x, y = x - side * y, y + side * x  # sideways while there is time: bots that flee straight all end in a corner
    else:
        x, y = 0.6 * math.cos(stroll), 0.6 * math.sin(stroll)
    if me not in its:  # the middle is safer than the edge
        x, y = x - _off_middle(scene, 0, here[0]) ** 3, y - _off_middle(scene, 1, here[1]) ** 3
    blocked = (abs(x) > 0.1 and velocity[0] == 0) or (abs(y) > 0.1 and velocity[1] == 0)
    return x, y, blocked


class TagPlayer:
    """A client's policy that plays tag: `AsyncClient.connect(url, before_update=Bot(TagPlayer()))`."""

    def __init__(self, random: Random | None = None) -> None:
        self._attributes: Mapping[int, Mapping[str, Any]] = {}

    def learn(self, attributes: Mapping[int, Mapping[str, Any]]) -> None:
        """Takes the attributes of all entities, which say who is safe."""
        self._attributes = attributes

    def __call__(self, world: World, me: int) -> Input:
        it = world.scene.index_of.get("it", -1)
        states = world.states()
        places = {entity: world.position(entity) for entity in states[:, 0].tolist()}
        its = states[states[:, 1] == it, 0].tolist()
        safe = {entity for entity, said in self._attributes.items() if world.tick < said.get("safe", 0)}
        x, y, jump = wish(world.scene, me, world.tick, places, world.velocity(me), its, safe)
        return make_input(x, y, jump=jump)


def _off_middle(scene: Scene, axis: int, at: float) -> float:
    """Returns how far a coordinate is from the middle of the scene: 0 in the middle, 1 or -1 at an edge."""
    half = scene.size[axis] * SEGMENT / 2
    return (at - scene.origin[axis] * SEGMENT) / half - 1


def _way(here: Vec, there: Vec) -> tuple[float, float]:
    """Returns the direction from one position to another as a vector of length 1."""
    x, y = there[0] - here[0], there[1] - here[1]
    length = math.hypot(x, y) or 1.0
    return x / length, y / length
