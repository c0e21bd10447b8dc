"""The text over the picture: the round, the scores, the figures of the network, and recent events."""

import functools
from collections.abc import Sequence

import pygame

from sovereign_netcode.play.figures import INK, IT, WHITE, Actor, font
from sovereign_netcode.play.iso import Colour

WALK_KEYS, EDIT_KEYS = "WASD / arrows: walk", "left / right mouse: dig / place    1-6: colour"
WINDOW_KEYS = "G: confirmed position    F3: diagnosis    [ ]: latency    Esc: quit"
FAINT: Colour = (168, 182, 206)
TOAST_S = 4.0
MARGIN = 14


class Slider:
    """A value from 0 to `top` that the player sets with the mouse."""

    def __init__(self, top: float) -> None:
        self._top = top
        self.held = False
        """Whether the mouse holds the knob."""
        self.track = pygame.Rect(0, 0, 0, 0)

    def draw(self, target: pygame.Surface, area: pygame.Rect, value: float) -> None:
        """Draws a track on a plate, with a knob at the value."""
        target.blit(_plate(*area.size), area)
        self.track = pygame.Rect(area.x + 16, area.centery - 3, area.width - 32, 6)
        pygame.draw.rect(target, FAINT, self.track, border_radius=3)
        knob = (self.track.x + round(self.track.width * value / self._top), self.track.centery)
        pygame.draw.circle(target, WHITE, knob, 9)

    def handle(self, event: pygame.event.Event) -> float | None:
        """Returns the value that the mouse sets with this event; None if the event does not concern the slider."""
        x, y = pygame.mouse.get_pos()
        if event.type == pygame.MOUSEBUTTONDOWN and event.button == 1:
            self.held = self.track.inflate(24, 24).collidepoint(x, y)
        elif event.type == pygame.MOUSEBUTTONUP:
            self.held = False
        if not self.held or event.type not in (pygame.MOUSEBUTTONDOWN, pygame.MOUSEMOTION):
            return None
        share = (x - self.track.x) / max(self.track.width, 1)
        return self._top * min(max(share, 0.0), 1.0)


class Hud:
    """The panels at the edges of the window."""

    def __init__(self, lag_max_s: float) -> None:
        self.slider = Slider(lag_max_s)
        self._toasts: list[tuple[float, str]] = []

    def say(self, text: str, now: float) -> None:
        """Shows a line of text for `TOAST_S` seconds."""
        self._toasts = [*self._toasts[-3:], (now + TOAST_S, text)]

    def draw(
        self,
        target: pygame.Surface,
        now: float,
        *,
        title: str,
        keys: str,
        edits: bool,
        left_s: float | None,
        actors: Sequence[Actor],
        network: Sequence[tuple[str, str]],
        lag_s: float,
        choice: Colour,
    ) -> None:
        """Draws all panels.

        Args:
            target: the window.
            now: the present time.
            title: text at the top.
            keys: the keys of the game's buttons.
            edits: whether players may change blocks.
            left_s: the rest of the round in seconds; None if the game has no rounds.
            actors: the figures in sight.
            network: figures of the network, as name and value.
            lag_s: the latency that the slider shows.
            choice: colour of the blocks to place.
        """
        width, height = target.get_size()
        clock = "" if left_s is None else f"{int(left_s) // 60}:{int(left_s) % 60:02}"
        top = _panel(title, clock, 30)
        target.blit(top, ((width - top.get_width()) // 2, MARGIN))
        table = _table("The network", (("added latency", f"{lag_s * 1000:.0f} ms"), *network), ())
        target.blit(table, (MARGIN, MARGIN))
        self.slider.draw(target, pygame.Rect(MARGIN, MARGIN + table.get_height() + 6, table.get_width(), 34), lag_s)
        scores = _scores(actors)
        if scores:
            marks = tuple(tone for _, _, tone in scores)
            board = _table("Score", tuple((name, score) for name, score, _ in scores), marks)
            target.blit(board, (width - board.get_width() - MARGIN, MARGIN))
        parts = (WALK_KEYS, keys, EDIT_KEYS if edits else "", WINDOW_KEYS)
        line = _panel("    ".join(part for part in parts if part), "", 19)
        target.blit(line, ((width - line.get_width()) // 2, height - line.get_height() - MARGIN))
        if edits:
            hand = pygame.Rect(MARGIN, height - 44, 30, 30)
            pygame.draw.rect(target, choice, hand, border_radius=6)
            pygame.draw.rect(target, WHITE, hand, 2, border_radius=6)
        self._toasts = [entry for entry in self._toasts if entry[0] > now]
        for n, (_, text) in enumerate(reversed(self._toasts)):
            toast = _panel(text, "", 26)
            toast.set_alpha(255 - 60 * n)
            target.blit(toast, ((width - toast.get_width()) // 2, 70 + 42 * n))


def _scores(actors: Sequence[Actor]) -> list[tuple[str, str, Colour]]:
    """Returns name, score and colour of the figures that have a score, the best first, at most 12."""
    found = [
        (int(actor.figure.attributes["score"]), str(actor.figure.attributes.get("name") or "?"), actor)
        for actor in actors
        if isinstance(actor.figure.attributes.get("score"), int)
    ]
    found.sort(key=lambda entry: (-entry[0], entry[2].figure.entity))
    return [(name, str(score), actor.tone) for score, name, actor in found[:12]]


def _plate(width: int, height: int) -> pygame.Surface:
    plate = pygame.Surface((width, height), pygame.SRCALPHA)
    pygame.draw.rect(plate, (*INK, 196), plate.get_rect(), border_radius=10)
    return plate


@functools.lru_cache(64)
def _panel(text: str, more: str, size: int) -> pygame.Surface:
    """Returns a picture of a line on a plate. `more` follows the text in another colour."""
    words = font(size).render(text, True, WHITE)
    rest = font(size).render(more, True, (255, 214, 120)) if more else None
    width = words.get_width() + (rest.get_width() + 14 if rest else 0)
    plate = _plate(width + 28, words.get_height() + 14)
    plate.blit(words, (14, 8))
    if rest:
        plate.blit(rest, (28 + words.get_width(), 8))
    return plate


@functools.lru_cache(64)
def _table(title: str, rows: tuple[tuple[str, str], ...], marks: tuple[Colour, ...]) -> pygame.Surface:
    """Returns a picture of a table: names on the left, values on the right, coloured marks before them if given."""
    line, width, indent = 21, 196, 18 if marks else 0
    plate = _plate(width, 38 + line * len(rows))
    plate.blit(font(22).render(title, True, WHITE), (12, 10))
    for n, (name, value) in enumerate(rows):
        y = 34 + n * line
        if marks:
            pygame.draw.circle(plate, marks[n], (19, y + 7), 6)
        ink = WHITE if not marks or marks[n] != IT else (255, 150, 140)
        plate.blit(font(20).render(name, True, FAINT if not marks else ink), (12 + indent, y))
        shown = font(20).render(value, True, ink)
        plate.blit(shown, (width - 12 - shown.get_width(), y))
    return plate
