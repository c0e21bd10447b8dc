"""Our clients of `bench.py peers`: players of the SDK that predict.

    python -m scripts.benchmarks.peers.our_clients ORDER

ORDER is JSON: {"port", "players", "seed", "per_step"}. `per_step` is the number of inputs that player 0 sends per step:
1, or 2 to try whether that gains anything. All others send one.

stdout  a JSON object per line: {"playing"} when all have joined, and the answer to each command
stdin   a command per line: "log": report the times of inputs and corrections. The end of the pipe: stop
"""

import asyncio
import json
import math
import random
import sys
import time
from typing import Any, cast

from client_sdk.async_client import AsyncClient
from client_sdk.bots import Bot
from client_sdk.events import Corrected, Joined, Left
from server.runtime import event_loop
from shared.inputs import Input, make_input, row
from shared.messages import Held, Inputs, decode_from_client, encode
from shared.world import World

INPUTS, HELD = encode(Inputs(0, 0, bytes(3)))[1], encode(Held(1, 0))[1]
"""Second bytes of messages with inputs: their types."""


class Walk:
    """A policy that walks all the time, and turns every 0.5 to 2 s."""

    def __init__(self, random: random.Random) -> None:
        self._random = random
        self._until = 0
        self._input = make_input(1.0, 0.0)

    def __call__(self, world: World, me: int) -> Input:
        if world.tick >= self._until:
            angle = self._random.random() * math.tau
            self._input = make_input(math.cos(angle), math.sin(angle))
            self._until = world.tick + round((0.5 + 1.5 * self._random.random()) * world.scene.tick_rate)
        return self._input


class Player:
    """A client, and the times of its inputs by tick and of its corrections.

    Args:
        number: number of the player.
        greedy: whether it sends a second input with each one, for the tick after.
    """

    def __init__(self, number: int, *, greedy: bool) -> None:
        self.name = f"p{number}"
        self._greedy = greedy
        self.sent: dict[int, float] = {}
        self._newest, self._row = -1, b""
        self.corrections: list[tuple[float, float]] = []
        self._joined = asyncio.Event()

    async def play(self, port: int, seed: str) -> None:
        """Connects and returns when the world is there; then it plays by itself."""
        policy = Bot(Walk(random.Random(seed)))
        self.client = await AsyncClient.connect(f"ws://127.0.0.1:{port}", name=self.name, before_update=policy)
        core = cast("Any", self.client.core)
        self._plain = core.outgoing
        core.outgoing = self._outgoing
        self._listening = asyncio.create_task(self._listen())
        await self._joined.wait()

    def _outgoing(self) -> list[bytes]:
        sent, now = [], time.monotonic()
        for message in self._plain():
            sent.append(message)
            if message[1] == INPUTS:
                inputs = decode_from_client(message)
                assert isinstance(inputs, Inputs)
                newest = inputs.first + len(inputs.rows) // 3 - 1
                for tick in range(inputs.first, newest + 1):
                    self.sent[tick] = now
                if self._greedy:
                    sent.append(encode(Inputs(newest + 1, inputs.acked, row(make_input(1.0, 0.0)))))
                self._newest, self._row = newest, inputs.rows[-3:]
            elif message[1] == HELD:
                held = decode_from_client(message)
                assert isinstance(held, Held)
                self._newest += held.after
                self.sent[self._newest] = now
                if self._greedy:
                    rows = self._row + row(make_input(1.0, 0.0))  # a later `Held` must not count from the second one
                    sent[-1] = encode(Inputs(self._newest, self._newest - held.behind, rows))
        return sent

    async def _listen(self) -> None:
        async for event in self.client:
            if isinstance(event, Corrected):
                self.corrections.append((time.monotonic(), event.blocks))
            elif isinstance(event, Joined):
                self._joined.set()
            elif isinstance(event, Left):
                raise SystemExit(f"error: {self.name} has left: {event}")


async def run(order: dict[str, Any]) -> None:
    """Plays until stdin ends."""
    loop, commands = asyncio.get_running_loop(), asyncio.StreamReader()
    players = [Player(number, greedy=number == 0 and order["per_step"] > 1) for number in range(order["players"])]
    await asyncio.gather(*(player.play(order["port"], f"{order['seed']} {player.name}") for player in players))
    say({"playing": len(players)})
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    while (await commands.readline()).strip():
        say(
            {
                "sent": {player.name: list(player.sent.items()) for player in players},
                "corrections": {player.name: player.corrections for player in players},
            }
        )


def say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=event_loop.loop_factory()) as runner:
        runner.run(run(json.loads(sys.argv[1])))
