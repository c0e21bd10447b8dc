"""Opens a window to play a game in. By default the game is tag, on a server of its own, with bots."""

import contextlib
import importlib
import os
import signal
import sys
import time
from pathlib import Path

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

import pygame

from client_sdk.client import Client
from client_sdk.transports.common import ConnectError
from server.rules import Rules, RulesError, load_rules
from server.runtime.reload import folder_of
from shared.messages import WRONG_SCENE
from sovereign_netcode.play import own_server
from sovereign_netcode.play.options import GAME, arguments
from sovereign_netcode.play.script import Script
from sovereign_netcode.play.window import CLOSED, Window, keyboard

FRAMES_PER_S = 60
OTHER_CODE = 3
"""Exit code if the server plays a game with another scene or other behaviours."""
PICTURE_S = 5.0
"""Time of play after which `--picture` saves the window, in seconds."""
AGAIN_S = 0.5
"""Seconds between two attempts to import a changed game."""
SCRIPT_S = 120.0
"""Longest time of a scripted session, in seconds. A session that takes longer has failed."""
UNSEEN = ("dummy", "offscreen")
"""Drivers of SDL whose windows are invisible. SDL uses one of them where there is no display."""


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    if options.script_demo and (options.game != GAME or options.url):
        print("error: --script-demo plays tag on a server of its own; it takes no --game or --url", file=sys.stderr)
        return 2
    try:
        rules = load_rules(options.game)
    except RulesError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    script = Script(options.script_demo) if options.script_demo else None
    if script or options.picture:
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C, so that the server and the bots end, too
    try:
        open_display(unseen=script is not None or options.picture is not None)
        with contextlib.ExitStack() as stack:
            url = options.url
            if url is None:
                print("starting a server (the first start on a machine takes longer) ...", flush=True)
                url = stack.enter_context(
                    own_server.server(options.game, options.scene, options.option, reload=options.reload)
                )
            count = options.bots if options.bots is not None else 0 if options.url else 4
            stack.enter_context(own_server.bots(url, count, options.game))
            title = "Sovereign Netcode" if options.url else options.game.rpartition(":")[2]
            while True:
                with Client.connect(url, name=options.name, behaviours=rules.behaviours) as client:
                    code = play(client, options.lag / 1000, script, title, rules, options.picture)
                if not (options.reload and code == OTHER_CODE):
                    return code
                rules = reloaded(options.game)
    except (ConnectError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0


def reloaded(game: str) -> Rules:
    """Imports the modules beside a game again, as soon as that works, and returns its rules."""
    folder, shown = folder_of(game), ""
    while True:
        for name, module in list(sys.modules.items()):
            path = getattr(module, "__file__", None)
            if path and Path(path).parent == folder:
                del sys.modules[name]
        importlib.invalidate_caches()
        try:
            return load_rules(game)
        except RulesError as error:
            if str(error) != shown:
                shown = str(error)
                print(f"error: {shown}", file=sys.stderr, flush=True)
            time.sleep(AGAIN_S)


def open_display(*, unseen: bool) -> None:
    """Prepares pygame to open a window.

    Args:
        unseen: the window may be invisible.

    Raises:
        RuntimeError: the window would be invisible although `unseen` is false.
    """
    try:
        pygame.display.init()
        found = f"SDL's driver is {pygame.display.get_driver()!r}"
        seen = pygame.display.get_driver() not in UNSEEN
    except pygame.error as error:
        found, seen, unseen = str(error), False, False
    if not seen and not unseen:
        raise RuntimeError(f"no display to open a window on ({found}); --script-demo OUT.png needs none")


def play(
    client: Client, lag_s: float, script: Script | None, title: str, rules: Rules, picture: str | None = None
) -> int:
    """Plays until the player, the server or the script ends the session. Returns the exit code."""
    pygame.font.init()
    window = Window(client, script or keyboard, title, rules.keys, rules.commands)
    window.lag(lag_s)
    clock, started = pygame.time.Clock(), time.monotonic()
    while not window.over:
        now = time.monotonic()
        window.frame(now)
        clock.tick(FRAMES_PER_S)
        if picture and not client.playing:
            started = now
        elif picture and now - started > PICTURE_S:
            window.save(picture)
            window.over = CLOSED
        if script and now - started > SCRIPT_S:
            window.over = "the script took too long"
    if window.code == WRONG_SCENE:
        print(window.over)
        return OTHER_CODE
    pygame.quit()
    advice = "; start the window with --game MODULE:CLASS" if window.over.startswith("behaviours: ") else ""
    print(window.over + advice)
    if script is None:
        return int(window.over != CLOSED)
    print(*(f"{what} {much:.3g}" for what, much in script.done.items()), sep=", ")
    return 0 if "in sight" in script.done else 1
