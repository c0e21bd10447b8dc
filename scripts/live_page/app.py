"""Takes a picture of the live page: a real server, bots that play on it, and a headless Chromium."""

import argparse
import asyncio
import random
import sys
from pathlib import Path

from client_sdk.async_client import AsyncClient
from client_sdk.bots import POLICIES, Bot
from scripts.live_page.chromium import chromium, installed
from sovereign_netcode.loadtest.processes import own_server

NAMES = "Ada Alan Barbara Chen Donald Edsger Frances Grace Hedy Ivan Joan Ken Leslie Margaret Niklaus Radia".split()
PLAYED = ("wander", "follow", "wander", "run-and-jump", "dig-and-place")


async def look(args: argparse.Namespace, browser: str) -> bytes:
    """Plays for `args.seconds`. Returns the picture as PNG."""
    async with own_server(args) as (_, url), asyncio.TaskGroup() as group:
        clients = []
        for i, name in enumerate(NAMES):
            bot = Bot(POLICIES[PLAYED[i % len(PLAYED)]](random.Random(i)))
            clients.append(await AsyncClient.connect(url, name=name, before_update=bot, timeout=30.0))
            group.create_task(_drain(clients[-1]))
        found = await asyncio.to_thread(_photograph, browser, url.replace("ws:", "http:"), args.seconds, args.light)
        for client in clients:
            await client.close()
    return found


async def _drain(client: AsyncClient) -> None:
    async for _ in client:
        pass


def _photograph(browser: str, url: str, seconds: float, light: bool) -> bytes:
    with chromium(browser) as tab:
        tab.open(url, 1400, 860, dark=not light)
        tab.until(f"charts[0].points.length > {2 * seconds} && have.every(tile => tile.version >= 0)", 4 * seconds + 60)
        assert not tab.said, tab.said
        return tab.picture()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "--seconds", type=float, default=40.0, help="seconds of play before the picture (default: %(default)g)"
    )
    parser.add_argument("--light", action="store_true", help="use the page's light theme")
    parser.add_argument("--scene", default="hills", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("docs/live.png"), help="default: %(default)s")
    args = parser.parse_args()
    args.tick_rate = args.game = None
    browser = installed()
    if browser is None:
        print("error: no Chromium was found on this machine", file=sys.stderr)
        return 2
    args.out.write_bytes(asyncio.run(look(args, browser)))
    print(args.out)
    return 0
