"""Makes the pictures of docs/tutorial.md: `python -m tests.readme.tutorial_pictures [FOLDER]`. It needs no display.

The game of the last step is played within this process, in simulated time, by bots; one of them has a window.
"""

import importlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

os.environ["SDL_VIDEODRIVER"] = "dummy"

import pygame

from client_sdk import Client, Loopback
from client_sdk.bots import Bot
from client_sdk.view import View
from server.game import Game
from server.rules import load_rules
from shared.inputs import MOVE_MAX
from shared.scene import load_scene
from sovereign_netcode.play.window import REST, Window, Wish
from tests.readme import tutorial
from tests.readme.pages import ROOT

NAMES = ("Ann", "Bob", "Cleo", "Dag", "Elif", "Finn")
FRAMES_PER_S = 60
SECONDS = 24.0
LAG_S = 0.15
BALLS = 4
"""Number of balls that should be in the picture. It is taken at the end at the latest."""


def module(name: str) -> Any:
    """Returns a module of the tutorial."""
    return importlib.import_module(name)


def played(done: Callable[[Client, float, bool], bool]) -> None:
    """Plays until a picture has been taken.

    Args:
        done: draws a frame of the first player's window, and returns whether it has saved it. It gets the client, the
            time, and whether the game ends.
    """
    rules = module("dodge").Dodge()
    loopback = Loopback(Game(rules.prepare(load_scene(rules.scene)), rules=rules, seed=3))
    clients = [loopback.join(name) for name in NAMES]
    minds = [Bot(module("brain").Brain(Random(i))) for i in range(1, len(NAMES))]
    for frame in range(round(SECONDS * FRAMES_PER_S)):
        now = frame / FRAMES_PER_S
        for client, mind in zip(clients[1:], minds, strict=True):
            client.poll(now)
            mind(client.core)
            client.update(now)
        if done(clients[0], now, frame + 1 == round(SECONDS * FRAMES_PER_S)):
            return


def good(client: Client, now: float, last: bool) -> bool:
    balls = [figure for figure in client.view(now).others if figure.template == "ball"]
    return last or (now > SECONDS / 2 and len(balls) >= BALLS)


def own_window(path: Path) -> None:
    """Saves what the tutorial's own window shows."""
    window, mind = module("window"), Bot(module("brain").Brain(Random(0)))
    screen = pygame.display.set_mode((window.SIZE, window.SIZE))

    def done(client: Client, now: float, last: bool) -> bool:
        client.poll(now)
        mind(client.core)
        client.update(now)
        if good(client, now, last):
            window.draw(screen, client, client.view(now))
            pygame.image.save(screen, str(path))
            return True
        return False

    played(done)


def window_of_play(path: Path) -> None:
    """Saves what the window of `sovereign-play` shows, at half of its size."""
    windows: list[Window] = []
    brain = module("brain").Brain(Random(0))

    def pilot(window: Window, view: View, now: float) -> Wish:
        prediction, scene = window.core.prediction, window.core.scene
        if prediction is None or scene is None or window.core.entity not in prediction.predicted:
            return REST
        wish = brain(prediction.predicted, window.core.entity)
        buttons = tuple(name for k, name in enumerate(scene.buttons) if wish.buttons >> k & 1)
        return Wish(wish.move_x / MOVE_MAX, wish.move_y / MOVE_MAX, False, buttons, wish.aim)

    def done(client: Client, now: float, last: bool) -> bool:
        if not windows:
            windows.append(Window(client, pilot, "Dodge", module("dodge").Dodge.keys))
            windows[0].lag(LAG_S)
        windows[0].frame(now)
        if good(client, now, last):
            surface = pygame.display.get_surface()
            assert surface is not None
            width, height = surface.get_size()
            pygame.image.save(pygame.transform.smoothscale(surface, (width // 2, height // 2)), str(path))
            return True
        return False

    played(done)


def main(out: Path) -> None:
    """Saves both pictures to a folder."""
    with tempfile.TemporaryDirectory() as folder:
        tutorial.write(max(tutorial.steps()), Path(folder))
        os.chdir(folder)
        load_rules("dodge:Dodge")  # from here on, modules are looked for in this folder, too
        pygame.display.init()
        pygame.font.init()
        own_window(out / "tutorial.png")
        window_of_play(out / "tutorial_play.png")
        os.chdir(ROOT)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT / "docs")
