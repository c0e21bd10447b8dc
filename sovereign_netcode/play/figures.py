"""The drawing of players: small round figures with a shadow, a face in the direction of movement, and a name."""

import functools
import math
from collections.abc import Callable, Sequence

import pygame

from client_sdk.view import EntityView
from shared.checks import Vec
from shared.template import Template
from sovereign_netcode.play.iso import HALF, QUARTER, RISE, Colour, Ground, Point, mixed, project

FINE = 4
"""Factor by which figures are drawn larger and then scaled down, for smooth edges."""
UNIT = HALF / 20
"""Size of the unit in which the parts of a figure are measured, in pixels."""
WIDTH, HEIGHT, FEET = round(40 * UNIT), round(66 * UNIT), round(56 * UNIT)
"""Width and height of a figure's picture, and the distance of the feet from its upper edge, in pixels."""
HIGH = 1.8
"""Height of a figure in the world, in blocks."""
IT: Colour = (232, 64, 58)
WHITE: Colour = (255, 255, 255)
INK: Colour = (22, 28, 44)
SHIELD: Colour = (120, 200, 255)
TONES: tuple[Colour, ...] = (
    (66, 135, 245), (245, 190, 60), (160, 105, 225), (40, 178, 170), (245, 140, 190), (250, 250, 250),
    (70, 90, 130), (150, 215, 245), (120, 80, 60),
)  # fmt: skip
OWN: Colour = (255, 146, 60)
PIP: Colour = (120, 230, 120)
PIPS_MAX, FUEL_MAX, BAR = 10, 96, 48
"""Most pips of health that are drawn, the fuel of a full bar, and the width of the bar in pixels."""
SMALL, LOW = 0.7, 1.2
"""Longest side below which an entity that does not walk is drawn as a ball, and height below which one that walks is
drawn as a car, in blocks."""
CAR_LABEL = round(24 * UNIT)
"""Distance of the name of a car from its position, in pixels."""

Solid = Callable[[int, int, int], int | None]


@functools.cache
def font(size: int, *, bold: bool = False) -> pygame.font.Font:
    """Returns pygame's own font, which looks the same on every machine."""
    made = pygame.font.Font(None, size)
    made.set_bold(bold)
    return made


@functools.lru_cache(512)
def label(text: str, ground: Colour, ink: Colour = WHITE, size: int = 20) -> pygame.Surface:
    """Returns a picture of a name on a rounded plate."""
    words = font(size).render(text, True, ink)
    width, height = words.get_width() + 14, words.get_height() + 6
    large = pygame.Surface((width * 3, height * 3), pygame.SRCALPHA)
    pygame.draw.rect(large, (*ground, 215), large.get_rect(), border_radius=height * 3 // 2)
    plate = pygame.transform.smoothscale(large, (width, height))
    plate.blit(words, (7, 4))
    return plate


@functools.lru_cache(512)
def body(tone: Colour, looks: int, alpha: int = 255) -> pygame.Surface:
    """Returns the picture of a figure.

    Args:
        looks: direction of the face on the screen, in eighths of a turn: 0 is right, 2 is down.
        alpha: opacity, from 0 to 255.
    """
    f = FINE * UNIT
    large = pygame.Surface((WIDTH * FINE, HEIGHT * FINE), pygame.SRCALPHA)
    x, feet, outline = WIDTH * FINE // 2, FEET * FINE, 2 * f
    dark = mixed(tone, 0.45)
    for grown, colour in ((outline, dark), (0, tone)):
        half = 11 * f + grown
        trunk = pygame.Rect(x - half, feet - 30 * f - grown, 2 * half, 34 * f + 2 * grown)
        pygame.draw.rect(large, colour, trunk, border_radius=round(half))
    side = pygame.Surface(large.get_size(), pygame.SRCALPHA)
    pygame.draw.rect(
        side, (*mixed(tone, 0.8), 255), (x + 2 * f, feet - 30 * f, 9 * f, 34 * f), border_radius=round(9 * f)
    )
    large.blit(side, (0, 0))
    head = feet - 36 * f
    skin = mixed(tone, 0.35, (255, 240, 222))
    pygame.draw.circle(large, dark, (x, head), 11 * f + outline)
    pygame.draw.circle(large, skin, (x, head), 11 * f)
    angle = looks * math.pi / 4
    gaze = math.cos(angle), math.sin(angle)
    if gaze[1] > -0.6:  # otherwise the figure is seen from behind
        for eye in (-1, 1):
            at = x + gaze[0] * 6 * f + eye * 4.2 * f * (1 - 0.3 * abs(gaze[0])), head + gaze[1] * 3 * f + 1 * f
            pygame.draw.circle(large, WHITE, at, 2.9 * f)
            pygame.draw.circle(large, INK, (at[0] + gaze[0] * 0.9 * f, at[1] + gaze[1] * 0.7 * f), 1.8 * f)
    small = pygame.transform.smoothscale(large, (WIDTH, HEIGHT))
    small.set_alpha(alpha)
    return small


@functools.lru_cache(64)
def disc(width: int, colour: Colour, alpha: int, ring: int = 0) -> pygame.Surface:
    """Returns the picture of an ellipse on the ground; if `ring` is not 0, only its rim of that width in pixels."""
    size = width, width * QUARTER // HALF
    large = pygame.Surface((size[0] * FINE, size[1] * FINE), pygame.SRCALPHA)
    pygame.draw.ellipse(large, (*colour, alpha), large.get_rect(), ring * FINE)
    return pygame.transform.smoothscale(large, size)


class Actor:
    """A figure and the way in which it is drawn.

    Args:
        figure: the entity in the view.
        template: its template, which decides on its shape: a small one that does not walk is a ball, another one that
            does not a box of its size, a low one that walks a car.
        tone: its colour.
        heading: direction (east, north) in which it last moved.
        it: whether it is "it" in tag.
        own: whether it is the player's own.
        safe: whether it cannot be tagged.
        person: whether it has the box of a player, and so is drawn as one even if it does not walk.
    """

    def __init__(
        self,
        figure: EntityView,
        template: Template,
        tone: Colour,
        heading: Point,
        *,
        it: bool,
        own: bool,
        safe: bool,
        person: bool,
    ) -> None:
        self.figure, self.it, self.own, self.safe = figure, it, own, safe
        self.tone, self.heading = IT if it else tone, heading
        self.size = [abs(side) for side in template.box_size]
        walks = template.walk_speed > 0
        self.ball = not walks and max(self.size) < SMALL
        self.car = walks and self.size[2] < LOW
        self.box = not walks and not self.ball and not person
        self.low = [
            min(offset, offset + side) for offset, side in zip(template.box_offset, template.box_size, strict=True)
        ]
        self.alpha = 255 if walks else 110

    @property
    def depth(self) -> float:
        """Sort key of the drawing order: figures that are further away have a lower value and are drawn first."""
        x, y, z = self.figure.position
        return x - y + z

    def draw(self, target: pygame.Surface, camera: Point, ground: Ground, solid: Solid) -> None:
        """Draws the shadow, the figure, and the blocks that cover it."""
        x, y, z = self.figure.position
        below = ground_below(solid, (x, y, z))
        if self.ball:
            draw_ball(target, camera, (x, y, z), below, self.size[0], self.tone)
            return
        if self.box:
            low = [part + offset for part, offset in zip((x, y, z), self.low, strict=True)]
            draw_box(target, camera, low, [part + side for part, side in zip(low, self.size, strict=True)], self.tone)
            return
        rings = [disc(40 - min(int(2 * (z - below)), 16), (20, 40, 20), 110)]
        rings += [disc(66, IT, 235, 4), disc(50, IT, 90)] if self.it else []
        rings += [disc(62, SHIELD, 235, 3)] if self.safe else []
        rings += [disc(56, WHITE, 235, 2)] if self.own and not self.it else []
        for ring in reversed(rings):
            _centred(target, ring, screen((x, y, below), camera))
        if self.car:
            draw_car(target, camera, (x, y, z), self.heading, self.tone)
            return
        px, py = screen((x, y, z), camera)
        looks = look_of(self.heading)
        box = pygame.Rect(px - WIDTH // 2, py - FEET, WIDTH, HEIGHT)
        clip = target.get_clip()
        target.blit(body(self.tone, looks, self.alpha), box)
        target.set_clip(box.clip(clip))
        if ground.cover(target, camera, (x - 0.3, y - 0.3, z), (x + 0.3, y + 0.3, z + HIGH)):
            target.blit(body(self.tone, looks, 70), box)  # faintly visible through the blocks that cover it
        target.set_clip(clip)

    def draw_name(self, target: pygame.Surface, camera: Point) -> None:
        """Draws the name, and the fields "health" and "fuel" if there are any, over everything else."""
        if self.ball:
            return
        name = str(self.figure.attributes.get("name") or f"#{self.figure.entity}")
        px, py = screen(self.figure.position, camera)
        top = py - (CAR_LABEL if self.car else FEET) - 20
        text = ("You are it!" if self.own else f"{name} is it!") if self.it else name
        plate = label(text, IT if self.it else (60, 130, 60) if self.own else INK)
        target.blit(plate, (px - plate.get_width() // 2, top))
        health = min(self.figure.fields.get("health", 0), PIPS_MAX)
        for pip in range(health):
            at = (px + 10 * pip - 5 * (health - 1), top - 7)
            pygame.draw.circle(target, INK, at, 5)
            pygame.draw.circle(target, PIP, at, 4)
        if self.own and "fuel" in self.figure.fields:
            left = min(self.figure.fields["fuel"], FUEL_MAX) * BAR // FUEL_MAX
            pygame.draw.rect(target, INK, (px - BAR // 2 - 1, top - 9, BAR + 2, 7))
            pygame.draw.rect(target, PIP, (px - BAR // 2, top - 8, left, 5))


def draw_ball(target: pygame.Surface, camera: Point, at: Vec, below: float, size: float, tone: Colour) -> None:
    """Draws a ball and its shadow on the ground."""
    radius = max(round(size * HALF * 0.7), 3)
    _centred(target, disc(2 * radius, (20, 40, 20), 110), screen((at[0], at[1], below), camera))
    pygame.draw.circle(target, mixed(tone, 0.45), screen(at, camera), radius + 2)
    pygame.draw.circle(target, tone, screen(at, camera), radius)


def draw_box(target: pygame.Surface, camera: Point, low: Sequence[float], high: Sequence[float], tone: Colour) -> None:
    """Draws the three visible faces of a box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = (
        (1.0, ((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1))),
        (0.8, ((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1))),
        (0.6, ((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1))),
    )
    for light, corners in faces:
        points = [screen(corner, camera) for corner in corners]
        pygame.draw.polygon(target, mixed(tone, light), points)
        pygame.draw.polygon(target, mixed(tone, 0.4), points, 1)


def draw_car(target: pygame.Surface, camera: Point, at: Vec, heading: Point, tone: Colour) -> None:
    """Draws a car: two slabs and a window."""
    length = math.hypot(*heading)
    east, north = heading[0] / length, heading[1] / length

    def slab(back: float, front: float, half: float, up: float) -> list[tuple[int, int]]:
        corners = ((back, -half), (front, -half), (front, half), (back, half))
        return [
            screen((at[0] + a * east - b * north, at[1] + a * north + b * east, at[2] + up), camera) for a, b in corners
        ]

    for k in range(5):
        pygame.draw.polygon(target, mixed(tone, 0.5), slab(-0.65, 0.65, 0.36, 0.1 + 0.06 * k))
    pygame.draw.polygon(target, tone, slab(-0.65, 0.65, 0.36, 0.4))
    for k in range(4):
        pygame.draw.polygon(target, INK, slab(-0.45, 0.25, 0.3, 0.45 + 0.06 * k))
    pygame.draw.polygon(target, mixed(tone, 0.75, WHITE), slab(-0.42, 0.15, 0.28, 0.68))


def colour_named(value: object) -> Colour | None:
    """Returns the colour that an attribute names, like "#ff8800"; None if it names none."""
    if not isinstance(value, str) or len(value) != 7 or value[0] != "#":
        return None
    try:
        red, green, blue = bytes.fromhex(value[1:])
    except ValueError:
        return None
    return red, green, blue


def look_of(heading: Point) -> int:
    """Returns a direction (east, north) in eighths of a turn on the screen."""
    return round(math.atan2(heading[0] - heading[1], heading[0] + heading[1]) * 4 / math.pi) % 8


def draw_ghost(target: pygame.Surface, camera: Point, at: Vec, own: Vec, looks: int) -> None:
    """Draws the player's newest confirmed position, and a line from it to the predicted position."""
    px, py = screen(at, camera)
    pygame.draw.line(target, WHITE, (px, py - RISE), (screen(own, camera)[0], screen(own, camera)[1] - RISE), 2)
    _centred(target, disc(56, WHITE, 160, 2), (px, py))
    target.blit(body((225, 232, 245), looks, 150), (px - WIDTH // 2, py - FEET))
    plate = label("confirmed by the server", (245, 247, 252), INK, 17)
    left = screen(own, camera)[0] >= px
    target.blit(plate, (px - plate.get_width() - 30 if left else px + 30, py - FEET // 2))


def ground_below(solid: Solid, at: Vec) -> float:
    """Returns the height of the ground below a position."""
    x, y, z = int(at[0] // 1), int(at[1] // 1), int((at[2] + 0.01) // 1)
    while z > at[2] - 12 and not solid(x, y, z - 1):
        z -= 1
    return min(float(z), at[2])


def screen(at: Vec, camera: Point) -> tuple[int, int]:
    """Converts a position in blocks to a pixel of the window."""
    x, y = project(*at)
    return round(x - camera[0]), round(y - camera[1])


def _centred(target: pygame.Surface, picture: pygame.Surface, at: tuple[int, int]) -> None:
    target.blit(picture, (at[0] - picture.get_width() // 2, at[1] - picture.get_height() // 2))
