"""The line in which a player types a message, for games whose rules declare a command `say` with a field `text`."""

from collections.abc import Mapping

import pygame

from server.declared import Value
from sovereign_netcode.play.figures import INK, WHITE, font

COMMAND, FIELD = "say", "text"
"""Name of the command that carries a message, and of its field."""
LONGEST = 120
"""Longest message, in characters."""
OPENS = (pygame.K_RETURN, pygame.K_KP_ENTER)
"""Keys that open the line, and send what it has."""


class Chat:
    """The line; `text` is what was typed, or None while the line is closed.

    Args:
        commands: the commands that the rules declare (`Rules.commands`).
    """

    def __init__(self, commands: Mapping[str, Mapping[str, Value]]) -> None:
        self.there = FIELD in commands.get(COMMAND, {})
        """Whether the game takes messages."""
        self.text: str | None = None

    def handle(self, event: pygame.event.Event) -> tuple[bool, str]:
        """Takes an event of the keyboard.

        Returns:
            Whether the event was for the line, and the message to send (empty: none).
        """
        if not self.there or event.type != pygame.KEYDOWN or (self.text is None and event.key not in OPENS):
            return False, ""
        if self.text is None:
            self.text = ""
        elif event.key in OPENS:
            message, self.text = self.text.strip(), None
            return True, message
        elif event.key == pygame.K_ESCAPE:
            self.text = None
        elif event.key == pygame.K_BACKSPACE:
            self.text = self.text[:-1]
        elif (typed := getattr(event, "unicode", "")).isprintable():
            self.text = (self.text + typed)[:LONGEST]
        return True, ""

    def draw(self, target: pygame.Surface) -> None:
        """Draws the line above the lower edge of the window, while it is open."""
        if self.text is None:
            return
        words = font(26).render(f"say: {self.text}_", True, WHITE)
        plate = pygame.Surface((max(words.get_width() + 28, 420), words.get_height() + 16), pygame.SRCALPHA)
        pygame.draw.rect(plate, (*INK, 225), plate.get_rect(), border_radius=10)
        plate.blit(words, (14, 9))
        width, height = target.get_size()
        target.blit(plate, ((width - plate.get_width()) // 2, height - 110))
