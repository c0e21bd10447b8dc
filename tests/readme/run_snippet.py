"""Runs a program of the pages until its player has walked: `python -m tests.readme.run_snippet HEADING`.

Loops, in an engine or bare, play in a game within this process, at 30 frames per second by their own clock, however
long a frame takes; the others on the server whose address is the second argument. An engine's keys are held by nobody,
so the wish is looked at and another one takes its place.
"""

import asyncio
import itertools
import sys
import time
from types import SimpleNamespace
from typing import Any

from sovereign_netcode.client_sdk import AsyncClient, Client, Loopback, View, client
from sovereign_netcode.server.game import Game
from sovereign_netcode.shared.scene import load_scene
from tests.readme import engines
from tests.readme.pages import programs

LOOP = "In your game's loop"
URL = "ws://127.0.0.1:8765"
FAR_BLOCKS = 3.0
FRAMES_MAX = 3000


class EnoughError(Exception):
    """The player has got somewhere."""


def in_this_process(wish: tuple[float, float, bool]) -> None:
    """Makes `Client` one of a game within this process; the program is to wish that."""
    frames = itertools.count()
    now = [0.0]
    start: list[float] = []
    poll, set_input, view = Client.poll, Client.set_input, Client.view

    def connect(url: str, *, name: str) -> Client:
        assert url == URL
        return Loopback(Game(load_scene("flat"))).join(name)

    def counted(self: Client) -> list[Any]:
        now[0] = next(frames) / 30
        assert now[0] < FRAMES_MAX / 30, "the player did not walk"
        return poll(self)

    def wished(self: Client, x: float, y: float, *, jump: bool) -> None:
        assert (x, y, jump) == wish
        set_input(self, 1, 0)

    def looked(self: Client) -> View:
        found = view(self)
        if found.me is not None:
            assert found.figures == [found.me]
            start.append(found.me.position[0])
            if found.me.position[0] > start[0] + FAR_BLOCKS:
                raise EnoughError
        return found

    module: Any = client
    module.time = SimpleNamespace(monotonic=lambda: now[0])
    patched: Any = Client
    patched.connect, patched.poll, patched.set_input, patched.view = connect, counted, wished, looked


def on_a_server(url: str) -> None:
    """Lets `AsyncClient` connect there, and leave once its player has walked."""
    connect = AsyncClient.connect
    tasks = []

    async def leave(found: AsyncClient) -> None:
        start = None
        until = time.monotonic() + 30
        while time.monotonic() < until:
            await asyncio.sleep(0.02)
            me = found.view().me
            start = start or (me.position if me else None)
            if me and start and sum(abs(a - b) for a, b in zip(me.position, start, strict=True)) > FAR_BLOCKS:
                print("walked")
                break
        await found.close()

    async def redirected(address: str, **more: Any) -> AsyncClient:
        assert address == URL
        found = await connect(url, **more)
        tasks.append(asyncio.create_task(leave(found)))
        return found

    patched: Any = AsyncClient
    patched.connect = redirected


def main(name: str, url: str = "") -> None:
    program = compile(programs()[name], name, "exec")
    space = {"__name__": "snippet"}
    if url:
        on_a_server(url)
        exec(program, space)
        return
    real = name == LOOP or engines.prepare(name)
    in_this_process((1, 0, False) if name == LOOP else (0, 0, False))
    try:
        exec(program, space)
    except EnoughError:
        print("walked, in", "the engine" if real else f"a stand-in; it has drawn {bool(engines.Thing.drawn)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
