"""The developer's panel: corrections on a time line with their causes, what is predicted, and a diagnosis."""

from collections.abc import Iterable
from typing import NamedTuple

import pygame

from client_sdk.client import Client
from client_sdk.stats import CorrectionTime
from shared.scene import Scene
from sovereign_netcode.play.figures import INK, WHITE, font
from sovereign_netcode.play.iso import Colour

SPAN_S = 60.0
"""Time that the time line shows, in seconds."""
WIDTH, LINE, GRAPH, PAD = 560, 20, 70, 14
"""Width of the panel, height of a line of text, height of the time line, and the margin inside, in pixels."""
FULL_BLOCKS = 1.0
"""Size of a correction that fills the height of the time line, in blocks."""
LEAST = 4
"""Height of the smallest bar, in pixels."""
FAINT: Colour = (168, 182, 206)
GREEN: Colour = (120, 214, 140)
CAUSES: dict[str, Colour] = {
    "late input": (245, 190, 60),
    "other entity": (120, 200, 255),
    "server act": (190, 140, 240),
    "unknown edit": (150, 215, 160),
    "missing terrain": (150, 150, 160),
    "nondeterminism": (240, 80, 70),
}
"""Colours of the causes of corrections."""


class Bar(NamedTuple):
    """A correction on the time line: distance from its left edge and height in pixels, and its colour."""

    x: int
    height: int
    colour: Colour


def bars(corrections: Iterable[CorrectionTime], now: float, width: int) -> list[Bar]:
    """Returns the bars of the corrections of the last `SPAN_S` seconds; the right edge of the time line is `now`."""
    return [
        Bar(
            round(width * (1 - (now - each.at) / SPAN_S)),
            max(LEAST, round(GRAPH * min(each.blocks / FULL_BLOCKS, 1.0))),
            CAUSES.get(each.cause, WHITE),
        )
        for each in corrections
        if 0 <= now - each.at <= SPAN_S
    ]


def predicted(scene: Scene | None) -> list[str]:
    """Returns lines that say what the client predicts, and what waits for the server."""
    names = [entry.name for entry in scene.behaviours] if scene is not None else []
    ahead = "walking, jumping, blocks" + (f", behaviours ({', '.join(names)})" if names else "")
    return [f"predicted: {ahead}", "waits for the server: commands, and all that the rules do"]


class Panel:
    """The panel; `shown` switches it."""

    def __init__(self) -> None:
        self.shown = False

    def draw(self, target: pygame.Surface, client: Client) -> None:
        """Draws the panel at the lower left edge of the window, if it is shown."""
        if not self.shown:
            return
        stats, found = client.stats, client.diagnosis()
        tone = GREEN if found.verdict == "matched" else CAUSES.get(found.verdict, CAUSES["other entity"])
        lines = [(part, tone) for part in wrapped(f"{found.verdict}: {found.reason}")]
        lines += [(part, WHITE) for part in wrapped(found.advice)]
        lines += [(part, CAUSES["late input"]) for text in found.warnings for part in wrapped(text)]
        lines += [(part, FAINT) for text in predicted(client.core.scene) for part in wrapped(text)]
        height = GRAPH + LINE * (len(lines) + 1) + 3 * PAD
        plate = pygame.Surface((WIDTH, height), pygame.SRCALPHA)
        pygame.draw.rect(plate, (*INK, 220), plate.get_rect(), border_radius=10)
        floor, inside = PAD + GRAPH, WIDTH - 2 * PAD
        pygame.draw.line(plate, FAINT, (PAD, floor), (PAD + inside, floor))
        for x, tall, colour in bars(stats.correction_times, stats.measured_at, inside):
            pygame.draw.rect(plate, colour, (PAD + x - 1, floor - tall, 3, tall))
        at = PAD
        for cause in dict.fromkeys(each.cause for each in stats.correction_times):
            words = font(18).render(cause, True, CAUSES.get(cause, WHITE))
            plate.blit(words, (at, floor + 4))
            at += words.get_width() + PAD
        if not stats.correction_times:
            plate.blit(font(18).render("no corrections in the last minute", True, FAINT), (PAD, floor + 4))
        for n, (text, colour) in enumerate(lines):
            plate.blit(font(20).render(text, True, colour), (PAD, floor + PAD + LINE * (n + 1)))
        target.blit(plate, (PAD, target.get_height() - height - 60))


def wrapped(text: str) -> list[str]:
    """Returns a text in lines that fit into the panel."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if font(20).size(longer)[0] > WIDTH - 2 * PAD and lines[-1]:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines
