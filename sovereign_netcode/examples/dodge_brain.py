"""The behaviour of bots in dodge. One function steers both the server's own players and the bots that are clients."""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from sovereign_netcode.client_sdk.bots import Random
from sovereign_netcode.shared.checks import Vec
from sovereign_netcode.shared.inputs import Input, make_input
from sovereign_netcode.shared.layout import ID, TEMPLATE
from sovereign_netcode.shared.units import SEGMENT
from sovereign_netcode.shared.world import World

NEAR, FAR = 5.0, 10.0
"""Distances to the nearest opponent, in blocks, below which a bot walks away, and above which it walks closer."""
BALL_SPEED, BALL_GRAVITY = 14.0, 4.0
"""Speed of a thrown ball in blocks/s, and its gravity in blocks/s^2."""


class Wish(NamedTuple):
    """The input that a bot wants: a direction, buttons by name, and an aim or None."""

    x: float
    y: float
    buttons: tuple[str, ...] = ()
    aim: Vec | None = None


class Readable(Protocol):
    """The part of a world, and of the game API, that a bot reads."""

    def position(self, entity: int) -> Vec:
        """Returns the position of an entity in blocks."""

    def velocity(self, entity: int) -> Vec:
        """Returns the velocity of an entity in blocks/s."""

    def field(self, entity: int, name: str) -> int:
        """Returns a field of the behaviour of an entity."""


def wish(world: Readable, middle: Vec, me: int, tick: int, players: Sequence[int], balls: Sequence[int]) -> Wish:
    """Returns the input of a bot: it keeps its distance, throws at the nearest opponent, and avoids balls.

    Args:
        world: the world.
        middle: the middle of the scene.
        me: the entity to steer.
        tick: the tick of the input.
        players: the entities that play.
        balls: the balls in the air.
    """
    here, team = world.position(me), world.field(me, "team")
    foes = [world.position(entity) for entity in players if world.field(entity, "team") != team]
    danger = [ball for ball in balls if world.field(ball, "team") != team and _comes(world, ball, here)]
    side = 1 if (me + tick // 64) % 2 else -1
    if not foes:
        x, y = _way(here, middle)
        return Wish(0.5 * x, 0.5 * y)
    foe = min(foes, key=lambda place: math.dist(place, here))
    distance, (x, y) = math.dist(foe[:2], here[:2]), _way(here, foe)
    ahead = 1.0 if distance > FAR else -1.0 if distance < NEAR else 0.0
    inwards = _way(here, middle)
    walk = ahead * x - 0.8 * side * y + 0.5 * inwards[0], ahead * y + 0.8 * side * x + 0.5 * inwards[1]
    buttons: list[str] = []
    if danger:
        vx, vy, _ = world.velocity(danger[0])
        speed = math.hypot(vx, vy) or 1.0
        walk = -side * vy / speed, side * vx / speed  # across the way of the ball
        buttons.append("dash" if tick >= world.field(me, "ready_at") else "jump")
    elif _blocked(world.velocity(me), walk) and tick % 8 < 4:
        buttons.append("jump")
    aim = None
    if tick >= world.field(me, "loaded_at") and distance < 20 and tick // 8 % 3:
        time = distance / BALL_SPEED
        up = foe[2] - here[2] - 0.3 + BALL_GRAVITY * time * time / 2
        aim = foe[0] - here[0], foe[1] - here[1], up
        buttons.append("fire")
    return Wish(*walk, tuple(buttons), aim)


class DodgePlayer:
    """A client's policy that plays dodge: `AsyncClient.connect(url, before_update=Bot(DodgePlayer()), ...)`."""

    def __init__(self, random: Random | None = None) -> None:
        self._random = random

    def __call__(self, world: World, me: int) -> Input:
        scene = world.scene
        ids, kinds = world.states()[:, ID].tolist(), world.states()[:, TEMPLATE].tolist()
        names = {entity: scene.templates[kind].name for entity, kind in zip(ids, kinds, strict=True)}
        players = [entity for entity, name in names.items() if name in ("player", "dashing")]
        balls = [entity for entity, name in names.items() if name == "ball"]
        low, size = scene.origin, scene.size
        x, y, z = ((a + b / 2) * SEGMENT for a, b in zip(low, size, strict=True))
        made = wish(world, (x, y, z), me, world.tick + 1, players, balls)
        return make_input(made.x, made.y, buttons=scene.buttons_bits(made.buttons), aim=made.aim)


def _comes(world: Readable, ball: int, here: Vec) -> bool:
    """Returns whether a ball is near and flies towards a position."""
    x, y, z = (a - b for a, b in zip(here, world.position(ball), strict=True))
    vx, vy, _ = world.velocity(ball)
    ahead, across = (x * vx + y * vy) / BALL_SPEED, abs(x * vy - y * vx) / BALL_SPEED
    return 0 < ahead < 5 and across < 1 and abs(z) < 3


def _blocked(velocity: Vec, walk: tuple[float, float]) -> bool:
    return any(abs(part) > 0.3 and speed == 0 for part, speed in zip(walk, velocity, strict=False))


def _way(here: Vec, there: Vec) -> tuple[float, float]:
    """Returns the horizontal direction from one position to another as a vector of length 1."""
    x, y = there[0] - here[0], there[1] - here[1]
    length = math.hypot(x, y) or 1.0
    return x / length, y / length
