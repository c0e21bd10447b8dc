"""The options of `sovereign-play`, for the window and for the browser."""

import argparse

GAME = "sovereign_netcode.examples.tag:Tag"
DESCRIPTION = "Opens a window to play a game in. By default the game is tag, on a server of its own, with bots."


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """Returns the options of a command line; None: that of this process."""
    parser = argparse.ArgumentParser(prog="sovereign-play", description=DESCRIPTION, allow_abbrev=False)
    parser.add_argument("--url", metavar="ws://...", help="URL of the server to play on (default: starts one)")
    parser.add_argument(
        "--game",
        default=GAME,
        metavar="MODULE:CLASS",
        help="game of the server that is started (default: tag); with --url, the game that is played there: its "
        "behaviours, keys and bots are used",
    )
    parser.add_argument("--scene", help="scene of the server that is started (default: the game's)")
    parser.add_argument(
        "--bots", type=int, metavar="N", help="number of bots (default: 4 on a server that is started, else 0)"
    )
    parser.add_argument("--name", default="You", help="player's name (default: %(default)s)")
    parser.add_argument(
        "--lag", type=float, default=0, metavar="MS", help="latency to add at the start; the keys [ and ] change it"
    )
    parser.add_argument(
        "--reload", action="store_true", help="restart the server and the game when a file beside the game changes"
    )
    parser.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="option of the game on the server started"
    )
    parser.add_argument("--browser", action="store_true", help="play in a browser instead of a window")
    parser.add_argument(
        "--picture", metavar="OUT.png", help="play for some seconds, save a picture, and exit; needs no display"
    )
    parser.add_argument(
        "--script-demo", metavar="OUT.png", help="run a scripted session, save a picture, and exit; needs no display"
    )
    return parser.parse_args(argv)
