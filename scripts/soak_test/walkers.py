"""Players of the SDK that walk in circles and jump all the time, and check that they move."""

import asyncio
import math
import time
from collections import Counter

from client_sdk.async_client import AsyncClient
from client_sdk.core import Core
from client_sdk.events import Diverged, Left
from client_sdk.transports.common import ConnectError
from scripts.soak_test.progress import Progress
from shared.inputs import make_input

LOOK_S = 0.1
AGAIN_S = 0.5
TURN_TICKS = 96
"""Ticks per round of the circle."""
JUMP_BLOCKS = 3.0
"""Longest distance, in blocks, between two looks of a walking player. A player that is farther away was placed."""


class Walker:
    """A player, from its first join until the task is cancelled."""

    def __init__(self, number: int, port: int) -> None:
        self.number, self.port = number, port
        self.progress = Progress(walks=True)
        self.walked = 0.0
        """Distance in blocks, up and down included."""
        self.used = 0
        """Number of inputs that the server has used, over all connections."""
        self.unexplained: list[str] = []
        self.counts: Counter[str] = Counter()
        self._place: tuple[float, float, float] | None = None
        self._tick = -1

    async def play(self) -> None:
        """Plays, and connects again after each connection."""
        url, name = f"ws://127.0.0.1:{self.port}", f"walker {self.number}"
        while True:
            try:
                client = await AsyncClient.connect(url, name=name, before_update=walk)
            except ConnectError:
                self.counts["connects failed"] += 1
                await asyncio.sleep(AGAIN_S)
                continue
            looking = asyncio.create_task(self._look(client))
            try:
                async for event in client:
                    self.counts[type(event).__name__] += 1
                    if isinstance(event, Left | Diverged):
                        self.unexplained.append(str(event))
            finally:
                looking.cancel()
                await client.close()

    async def _look(self, client: AsyncClient) -> None:
        before, core = self.used, client.core
        while True:
            await asyncio.sleep(LOOK_S)
            self.used = before + core.stats.inputs_used
            self.look(core, time.monotonic())

    def look(self, core: Core, now: float) -> None:
        """Takes the newest snapshot, unless it was taken before."""
        confirmed = core.prediction.confirmed if core.prediction else None
        if core.state != "playing" or confirmed is None or core.entity not in confirmed:
            self._place = None
            self.progress.away()
        elif confirmed.tick != self._tick:
            place = confirmed.position(core.entity)
            way = 0.0 if self._place is None else math.dist(place, self._place)
            self.walked += way if way < JUMP_BLOCKS else 0.0
            self._place, self._tick = place, confirmed.tick
            self.progress.see(now, self.used, self.walked)


def walk(core: Core) -> None:
    """Sets the input of the next tick: a step on a circle, and a jump."""
    if core.prediction is not None:
        angle = math.tau * core.prediction.predicted.tick / TURN_TICKS
        core.set_input(make_input(math.cos(angle), math.sin(angle), jump=True))
