"""The course of the race, and the behaviour of bots. One function steers the server's own cars and bots that are
clients."""

import math
from collections.abc import Mapping
from typing import Any

from sovereign_netcode.client_sdk.bots import Random
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.inputs import Input, make_input
from sovereign_netcode.shared.world import World

GATES = ((56.0, 6.0), (56.0, 58.0), (8.0, 58.0), (8.0, 6.0))
"""Middles of the gates in the order in which cars pass them, in blocks."""
GATE_REACH = 7.0
"""Distance from the middle of a gate, along x and along y, within which a car passes it, in blocks."""
PADS = ((32, 5), (56, 32), (32, 58), (8, 32))
"""Blocks in the middle of the pads, in the floor."""


def passes(place: Vec, gate: int) -> bool:
    """Returns whether a car is in a gate."""
    x, y = GATES[gate]
    return abs(place[0] - x) <= GATE_REACH and abs(place[1] - y) <= GATE_REACH


def drive(place: Vec, velocity: Vec, gate: int, fuel: int) -> tuple[float, float, bool]:
    """Returns a direction (east, north) and whether to boost, for a car on its way to a gate.

    Args:
        place: the position of the car.
        velocity: its velocity.
        gate: number of the next gate.
        fuel: its fuel.
    """
    x, y = (a - b for a, b in zip(GATES[gate], place, strict=False))
    far = math.hypot(x, y) or 1.0
    wanted = min(12.0, 0.8 * far + 3.0)  # slower ahead of the corner
    x, y = wanted * x / far - 0.8 * velocity[0], wanted * y / far - 0.8 * velocity[1]
    length = math.hypot(x, y) or 1.0
    return x / length, y / length, far > 22 and fuel > 8


class RacePlayer:
    """A client's policy that races: `AsyncClient.connect(url, before_update=Bot(RacePlayer()), ...)`."""

    def __init__(self, random: Random | None = None) -> None:
        self._attributes: Mapping[int, Mapping[str, Any]] = {}

    def learn(self, attributes: Mapping[int, Mapping[str, Any]]) -> None:
        """Takes the attributes of all entities, which say what gate is next."""
        self._attributes = attributes

    def __call__(self, world: World, me: int) -> Input:
        gate = self._attributes.get(me, {}).get("gate", 0)
        x, y, boost = drive(world.position(me), world.velocity(me), gate, world.field(me, "fuel"))
        return make_input(x, y, buttons=world.scene.buttons_bits({"boost": boost}))
