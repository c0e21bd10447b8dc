"""Runs a program of the pages until its player has walked: `python -m tests.readme.run_snippet HEADING`.

A program with a loop plays in a game within this process, in the default scene, with company. It plays at 30 frames per
second of simulated time. The other programs play on the server whose address is the second argument. The keys of an
engine are not pressed, so the program's input is checked and then replaced by another one. At the end the engine must
show exactly the figures of the game, in their places.
"""

import asyncio
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

from sovereign_netcode.client_sdk import AsyncClient, Client, Loopback, View, client
from sovereign_netcode.server import Game, Player, Rules
from sovereign_netcode.server.config.settings import Settings
from sovereign_netcode.shared.behaviours import Behaviour
from sovereign_netcode.shared.buttons import Names
from sovereign_netcode.shared.scene import load_scene
from tests.patience import PATIENCE_S
from tests.readme import engines
from tests.readme.pages import programs

LOOPS = ("A client", "In your game's loop")
"""Programs that are a bare loop and walk east. The others are run by an engine, whose keys are not pressed."""
URL = "ws://127.0.0.1:8765"
FAR_BLOCKS = 3.0
COMPANY = ((9, 0), (0, 6))
NEAR = 0.07
"""Maximum distance of the own figure from the middle, in heights of the window."""
FRAMES_MAX = 3000
TAP_FRAME = 10


class EnoughError(Exception):
    """Ends a program: its player has walked far enough."""


class Company(Rules):
    """Rules that put a standing entity to the east of each player, and one to the north."""

    def on_join(self, player: Player) -> None:
        x, y, z = self.game.position(player.entity)
        for i, j in COMPANY:
            self.game.spawn("player", (x + i, y + j, z))


def in_this_process(
    input_: tuple[float, float], done: Callable[[View], None], tap: Callable[[], object] | None = None
) -> None:
    """Makes `Client` connect to a game within this process.

    Args:
        input_: the direction that the program must set.
        done: called with the last view that the program has drawn, once the player has walked.
        tap: presses and releases the space bar between two frames; the program must then set a jump once.
    """
    frames = itertools.count()
    now = [0.0]
    start: list[float] = []
    drawn: list[View] = []
    jumps: list[float] = []
    poll, set_input, view = Client.poll, Client.set_input, Client.view

    def connect(url: str, *, name: str, behaviours: Iterable[type[Behaviour]] = ()) -> Client:
        assert url == URL
        assert [each.__name__ for each in behaviours] in ([], ["Dash"])
        return Loopback(Game(load_scene(Settings().scene), rules=Company())).join(name)

    def counted(self: Client) -> list[Any]:
        if drawn and start[-1] > start[0] + FAR_BLOCKS and len(drawn[-1].others) == len(COMPANY):
            done(drawn[-1])
            assert len(jumps) == (tap is not None)
            raise EnoughError
        frame = next(frames)
        if frame == TAP_FRAME and tap is not None:
            tap()
        now[0] = frame / 30
        assert now[0] < FRAMES_MAX / 30, "the player did not walk"
        return poll(self)

    def wished(self: Client, x: float, y: float, *, jump: bool = False, buttons: Names = ()) -> None:
        assert (x, y) == input_
        if jump:
            jumps.append(now[0])
        set_input(self, 1, 0, jump=True)  # the ground is not even

    def looked(self: Client) -> View:
        found = view(self)
        if found.me is not None:
            start.append(found.me.position[0])
            drawn.append(found)
        return found

    module: Any = client
    module.time = SimpleNamespace(monotonic=lambda: now[0])
    patched: Any = Client
    patched.connect, patched.poll, patched.set_input, patched.view = connect, counted, wished, looked


def compare(lit: list[engines.Point], view: View) -> None:
    """Fails unless something is shown exactly where each figure is: the own one in the middle, north up."""
    assert view.me is not None
    x, y, _ = view.me.position
    ways = [math.atan2(other.position[1] - y, other.position[0] - x) for other in view.others]
    near = [point for point in lit if math.hypot(*point) < NEAR]
    assert near, f"the own figure is not in the middle: {lit}"
    off = [
        [abs(math.remainder(math.atan2(north, east) - way, math.tau)) for way in ways]
        for east, north in lit
        if math.hypot(east, north) >= NEAR
    ]
    for i, way in enumerate(ways):
        assert any(angles[i] < 0.15 for angles in off), f"nobody is shown at {math.degrees(way):.0f} degrees"
    assert all(min(angles) < 0.3 for angles in off), f"something else is shown: {lit}"


def on_a_server(url: str) -> None:
    """Lets `AsyncClient` connect to a server, and leave once its player has walked."""
    connect = AsyncClient.connect
    tasks = []

    async def leave(found: AsyncClient) -> None:
        start = None
        until = time.monotonic() + PATIENCE_S
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
    exec(programs()["A game"], engines.module("bounce").__dict__)  # bounce.py of the README
    space = {"__name__": "snippet"}
    if url:
        on_a_server(url)
        exec(program, space)
        return
    if name in LOOPS:
        said = "walked"
        in_this_process((1, 0), lambda view: None)
    else:
        real, lit, tap = engines.prepare(name)
        said = f"walked, and all are shown by {'the engine' if real else 'a stand-in'}"
        in_this_process((0, 0), lambda view: compare(lit(), view), tap)
    try:
        exec(program, space)
    except EnoughError:
        print(said)


if __name__ == "__main__":
    main(*sys.argv[1:])
