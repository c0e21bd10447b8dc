"""Players as they are drawn: small round figures with a shadow, a face that looks where they go, and a name."""

import functools
import math
from collections.abc import Callable

import pygame

from client_sdk.picture import Figure
from shared.checks import Vec
from sovereign_netcode.play.iso import HALF, QUARTER, RISE, Colour, Ground, Point, mixed, project

FINE = 4
"""Figures are drawn so many times as large, and scaled down: smooth edges."""
UNIT = HALF / 20
"""What figures are made of, in pixels."""
WIDTH, HEIGHT, FEET = round(40 * UNIT), round(66 * UNIT), round(56 * UNIT)
"""Of a figure's picture, in pixels; its feet are so far below the upper edge, in the middle."""
HIGH = 1.8
IT: Colour = (232, 64, 58)
WHITE: Colour = (255, 255, 255)
INK: Colour = (22, 28, 44)
SHIELD: Colour = (120, 200, 255)
TONES: tuple[Colour, ...] = (
    (66, 135, 245), (245, 190, 60), (160, 105, 225), (40, 178, 170), (245, 140, 190), (250, 250, 250),
    (70, 90, 130), (150, 215, 245), (120, 80, 60),
)  # fmt: skip
OWN: Colour = (255, 146, 60)

Solid = Callable[[int, int, int], int | None]


@functools.cache
def font(size: int, *, bold: bool = False) -> pygame.font.Font:
    """The one that comes with pygame, so that it looks alike everywhere."""
    made = pygame.font.Font(None, size)
    made.set_bold(bold)
    return made


@functools.lru_cache(512)
def label(text: str, ground: Colour, ink: Colour = WHITE, size: int = 20) -> pygame.Surface:
    """A name on a rounded plate."""
    words = font(size).render(text, True, ink)
    width, height = words.get_width() + 14, words.get_height() + 6
    large = pygame.Surface((width * 3, height * 3), pygame.SRCALPHA)
    pygame.draw.rect(large, (*ground, 215), large.get_rect(), border_radius=height * 3 // 2)
    plate = pygame.transform.smoothscale(large, (width, height))
    plate.blit(words, (7, 4))
    return plate


@functools.lru_cache(512)
def body(tone: Colour, looks: int, alpha: int = 255) -> pygame.Surface:
    """A figure; `looks` is where it looks in eighths of a turn on the screen, from the right by way of below."""
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
    if gaze[1] > -0.6:  # else it shows its back
        for eye in (-1, 1):
            at = x + gaze[0] * 6 * f + eye * 4.2 * f * (1 - 0.3 * abs(gaze[0])), head + gaze[1] * 3 * f + 1 * f
            pygame.draw.circle(large, WHITE, at, 2.9 * f)
            pygame.draw.circle(large, INK, (at[0] + gaze[0] * 0.9 * f, at[1] + gaze[1] * 0.7 * f), 1.8 * f)
    small = pygame.transform.smoothscale(large, (WIDTH, HEIGHT))
    small.set_alpha(alpha)
    return small


@functools.lru_cache(64)
def disc(width: int, colour: Colour, alpha: int, ring: int = 0) -> pygame.Surface:
    """An ellipse on the ground, or (ring > 0) only its rim of that width."""
    size = width, width * QUARTER // HALF
    large = pygame.Surface((size[0] * FINE, size[1] * FINE), pygame.SRCALPHA)
    pygame.draw.ellipse(large, (*colour, alpha), large.get_rect(), ring * FINE)
    return pygame.transform.smoothscale(large, size)


class Actor:
    """A figure and how it is to be drawn."""

    def __init__(self, figure: Figure, tone: Colour, *, it: bool, own: bool, safe: bool) -> None:
        self.figure, self.it, self.own, self.safe = figure, it, own, safe
        self.tone = IT if it else tone

    @property
    def depth(self) -> float:
        """Who is further away is drawn first."""
        x, y, z = self.figure.position
        return x - y + z

    def draw(self, target: pygame.Surface, camera: Point, ground: Ground, solid: Solid, looks: int) -> None:
        """The shadow, the figure, and what covers it."""
        x, y, z = self.figure.position
        below = ground_below(solid, (x, y, z))
        rings = [disc(40 - min(int(2 * (z - below)), 16), (20, 40, 20), 110)]
        rings += [disc(66, IT, 235, 4), disc(50, IT, 90)] if self.it else []
        rings += [disc(62, SHIELD, 235, 3)] if self.safe else []
        rings += [disc(56, WHITE, 235, 2)] if self.own and not self.it else []
        for ring in reversed(rings):
            _centred(target, ring, screen((x, y, below), camera))
        px, py = screen((x, y, z), camera)
        box = pygame.Rect(px - WIDTH // 2, py - FEET, WIDTH, HEIGHT)
        clip = target.get_clip()
        target.blit(body(self.tone, looks), box)
        target.set_clip(box.clip(clip))
        if ground.cover(target, camera, (x - 0.3, y - 0.3, z), (x + 0.3, y + 0.3, z + HIGH)):
            target.blit(body(self.tone, looks, 70), box)  # seen through what hides it
        target.set_clip(clip)

    def draw_name(self, target: pygame.Surface, camera: Point) -> None:
        """The name, over everything else."""
        name = str(self.figure.attributes.get("name") or f"#{self.figure.entity}")
        px, py = screen(self.figure.position, camera)
        text = ("You are it!" if self.own else f"{name} is it!") if self.it else name
        plate = label(text, IT if self.it else (60, 130, 60) if self.own else INK)
        target.blit(plate, (px - plate.get_width() // 2, py - FEET - 20))


def draw_ghost(target: pygame.Surface, camera: Point, at: Vec, own: Vec, looks: int) -> None:
    """Where the server's newest word has oneself, and how far that is behind."""
    px, py = screen(at, camera)
    pygame.draw.line(target, WHITE, (px, py - RISE), (screen(own, camera)[0], screen(own, camera)[1] - RISE), 2)
    _centred(target, disc(56, WHITE, 160, 2), (px, py))
    target.blit(body((225, 232, 245), looks, 150), (px - WIDTH // 2, py - FEET))
    plate = label("the server's word", (245, 247, 252), INK, 17)
    left = screen(own, camera)[0] >= px
    target.blit(plate, (px - plate.get_width() - 30 if left else px + 30, py - FEET // 2))


def ground_below(solid: Solid, at: Vec) -> float:
    """The height of the ground under a place."""
    x, y, z = int(at[0] // 1), int(at[1] // 1), int((at[2] + 0.01) // 1)
    while z > at[2] - 12 and not solid(x, y, z - 1):
        z -= 1
    return min(float(z), at[2])


def screen(at: Vec, camera: Point) -> tuple[int, int]:
    """A place in blocks as a pixel of the window."""
    x, y = project(*at)
    return round(x - camera[0]), round(y - camera[1])


def _centred(target: pygame.Surface, picture: pygame.Surface, at: tuple[int, int]) -> None:
    target.blit(picture, (at[0] - picture.get_width() // 2, at[1] - picture.get_height() // 2))
