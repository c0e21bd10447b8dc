"""The developer's panel of the window: corrections on a time line, a diagnosis, and what is predicted."""

import os

os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import pygame

from client_sdk.loopback import Loopback
from client_sdk.stats import CorrectionTime
from server.game import Game
from shared.scene import load_scene
from sovereign_netcode.play.figures import WHITE
from sovereign_netcode.play.panel import CAUSES, GRAPH, LEAST, Bar, Panel, bars, predicted, wrapped


def test_a_bar_stands_at_its_time_in_the_colour_of_its_cause() -> None:
    corrections = [
        CorrectionTime(39.9, "late input", 0.5),
        CorrectionTime(40.0, "late input", 0.5),
        CorrectionTime(70.0, "other entity", 9.0),
        CorrectionTime(100.0, "a new cause", 0.0),
    ]
    assert bars(corrections, 100.0, 600) == [
        Bar(0, GRAPH // 2, CAUSES["late input"]),
        Bar(300, GRAPH, CAUSES["other entity"]),
        Bar(600, LEAST, WHITE),
    ]


def test_the_panel_names_what_is_predicted() -> None:
    assert predicted(load_scene("flat"))[0] == "predicted: walking, jumping, blocks"


def test_a_text_is_wrapped_without_loss() -> None:
    pygame.font.init()
    text = "a word and another one " * 12
    lines = wrapped(text)
    assert len(lines) > 1
    assert " ".join(lines).split() == text.split()


def test_the_panel_is_drawn_only_when_it_is_shown() -> None:
    pygame.display.init()
    pygame.font.init()
    client = Loopback(Game(load_scene("flat"))).join("Ann")
    target = pygame.Surface((800, 600))
    panel = Panel()
    panel.draw(target, client)
    assert pygame.transform.average_color(target)[:3] == (0, 0, 0)
    panel.shown = True
    panel.draw(target, client)
    assert pygame.transform.average_color(target)[:3] != (0, 0, 0)
    pygame.display.quit()
