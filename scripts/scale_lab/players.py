"""The players of a run: they walk, dig, build and count, and measure each pause that they notice."""

import asyncio
import random
import time
from collections import Counter
from collections.abc import Sequence

from client_sdk.async_client import AsyncClient
from client_sdk.core import Core
from client_sdk.events import Answered, Corrected, Disconnected, Diverged, Left
from client_sdk.transports.common import ConnectError
from shared.inputs import Input, make_input

PATIENCE_S = 60.0
"""Seconds for which a player tries to reconnect."""
FRESH_S = 1.0
"""Seconds without a new tick after which a player does not count as playing."""
JOIN_S = 90.0
"""Seconds within which all players have to play."""
COUNT_SHARE, EDIT_SHARE, TURN_SHARE = 0.1, 0.05, 0.03
"""Shares of the updates in which a player counts, digs or builds, and turns."""


class Player:
    """One player.

    Args:
        name: its name.
        seed: source of what it does.
    """

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self._rng = random.Random(seed)
        self._input: Input = make_input(1.0, 0.0)
        self.client: AsyncClient | None = None
        self.counting = True
        """Whether it sends commands."""
        self.count = 0
        self.answers: Counter[int] = Counter()
        self.refused: list[str] = []
        """Count commands that the server refused, with the reason."""
        self._numbers: dict[int, bool] = {}
        """Numbers of the commands that were sent, and whether each is one that counts."""
        self.corrections: Counter[str] = Counter()
        self.faults: list[str] = []
        """Events that must not come."""
        self.reconnects = 0
        self._tick, self._since, self._gap = -1, 0.0, 0.0
        self._listening: asyncio.Task[None] | None = None

    async def join(self, url: str) -> None:
        """Connects to an edge. If that ends, the client goes on at another one that the server has named."""
        self.client = await AsyncClient.connect(url, name=self.name, patience_s=PATIENCE_S, before_update=self._update)
        self._since = time.monotonic()
        self._listening = asyncio.create_task(self._listen(self.client))

    def take_gap(self) -> float:
        """Returns the longest time in seconds between two new ticks since the last call, up to now."""
        longest = max(self._gap, time.monotonic() - self._since)
        self._gap = 0.0
        return longest

    @property
    def playing(self) -> bool:
        """Whether the client gets new ticks."""
        return self.client is not None and self.client.playing and time.monotonic() - self._since < FRESH_S

    @property
    def unanswered(self) -> int:
        """Number of commands without an answer."""
        return len(self._numbers) - len(self.answers)

    def verdicts(self) -> list[str]:
        """Returns what is wrong at the end, once nothing is unanswered."""
        assert self.client is not None
        me = self.client.view().me
        counted = -1 if me is None else me.attributes.get("count", 0)
        wrong = list(self.faults)
        wrong += [f"command {number} was answered {times} times" for number, times in self.answers.items() if times > 1]
        wrong += [f"count command {number} was refused" for number in self.refused[:2]]
        if counted != self.count:
            wrong.append(f"{self.count} counts were sent, and the world has {counted}")
        if self.unanswered:
            wrong.append(f"{self.unanswered} commands have no answer")
        return [f"{self.name}: {each}" for each in wrong]

    async def leave(self) -> None:
        """Closes the connection."""
        if self._listening is not None:
            self._listening.cancel()
        if self.client is not None:
            await self.client.close()

    def _update(self, core: Core) -> None:
        assert core.prediction is not None
        rng, tick, now = self._rng, core.prediction.confirmed.tick, time.monotonic()
        if tick != self._tick:
            self._gap = max(self._gap, now - self._since)
            self._tick, self._since = tick, now
        if rng.random() < TURN_SHARE:
            self._input = make_input(rng.uniform(-1, 1), rng.uniform(-1, 1))
        core.set_input(self._input)
        if not self.counting:
            return
        if rng.random() < COUNT_SHARE:
            self.count += 1
            self._numbers[core.command("count", self.count)] = True
        if rng.random() < EDIT_SHARE:
            x, y, z = core.prediction.predicted.position(core.entity)
            at = int(x) + rng.randint(-2, 2), int(y) + rng.randint(-2, 2), int(z) + rng.randint(0, 1)
            self._numbers[core.edit(*at, rng.randint(0, 1))] = False

    async def _listen(self, client: AsyncClient) -> None:
        async for event in client:
            match event:
                case Answered():
                    self.answers[event.number] += 1
                    if self._numbers.get(event.number) and not event.done:
                        self.refused.append(f"{event.number} ({event.verdict})")
                case Corrected():
                    self.corrections[event.cause] += 1
                case Disconnected():
                    self.reconnects += 1
                case Diverged() | Left():
                    self.faults.append(repr(event))


async def joined(names: int, urls: Sequence[str], seed: int) -> list[Player]:
    """Returns new players that all play.

    Raises:
        TimeoutError: one of them does not play in time.
    """
    players = [Player(f"player {number}", seed * 1009 + number) for number in range(names)]
    async with asyncio.timeout(JOIN_S):
        for number, player in enumerate(players):
            while player.client is None:
                try:
                    await player.join(urls[number % len(urls)])
                except ConnectError:
                    await asyncio.sleep(0.1)
        while not all(player.playing for player in players):  # noqa: ASYNC110
            await asyncio.sleep(0.05)
    return players
