"""Our server of `bench.py peers`: the product with a log of the inputs.

    python -m scripts.benchmarks.peers.our_server PORT [walked]

Players walk on a plane at 3 blocks/s, and do not stop each other.

stdout  a line when it listens, then a JSON object for each command
stdin   a command per line: "mark": report the counters; "log": report the log of inputs. The end of the pipe: stop

With `walked` it also measures the way of each player.
"""

import asyncio
import json
import math
import sys
import time
import tomllib
from typing import Any, cast

from websockets.speedups import apply_mask

from scripts.benchmarks.busy_server import in_view
from scripts.environment import ROOT
from server import serving
from server.config.settings import Settings
from server.game import Game
from server.game.session import Session
from server.runtime import event_loop, log
from server.runtime.warmup import warm_up
from shared.bounds import bounds
from shared.fields import INPUT_ROW_BYTES
from shared.messages import Held, Inputs, Restart, decode_from_client, head_of
from shared.scene import Scene

RATE = 32
HEADS = head_of(Inputs), head_of(Held), head_of(Restart)


def scene() -> Scene:
    """Returns the scene `flat` without collisions between players, who all spawn in the middle of a segment."""
    table = tomllib.loads((ROOT / "shared" / "scenes" / "flat.toml").read_text("utf-8"))
    table |= {"name": "plane", "tick_rate": RATE, "size": [6, 6, 1], "spawns": [[80, 80, 8]]}
    table["templates"][0]["solid"] = False
    return Scene.from_table(table)


class Measured(Game):
    """The game with a log: when each tick began, when each input arrived, and if `follow`, how far each player walked.

    An input that arrived before its tick began was used in it.
    """

    def __init__(self, rules: Scene, *, follow: bool) -> None:
        super().__init__(rules)
        self.follow = follow
        self.began: list[float] = []
        self.arrived: list[tuple[str, bytes, float]] = []
        """Input messages: name of the player, message, time of arrival."""
        self.first = self.world.tick + 1
        self._at: dict[int, tuple[float, float]] = {}
        self.walked: dict[str, float] = {}
        assert self.fast_path is not None
        self._plain_post, arrivals = self.fast_path.arrivals.post_frame, cast("Any", self.fast_path.arrivals)
        arrivals.post_frame, self._rows = self._post_frame, arrivals._rows

    def receive(self, session: Session, data: bytes, now: float) -> None:
        if data[:2] in HEADS and session.player is not None:
            self.arrived.append((session.player.name, data, now))
        super().receive(session, data, now)

    def _post_frame(self, row: int, data: bytes, now: float) -> bool:
        """Notes a message that comes in its frame."""
        taken = self._plain_post(row, data, now)
        if taken:
            self.arrived.append((self._rows.sessions[row].player.name, data, now))
        return taken

    def tick(self, deadline: float, now: float) -> None:
        self.began.append(time.monotonic())
        super().tick(deadline, now)
        for entity, player in self.players.items() if self.follow else ():
            x, y, _ = self.world.position(entity)
            was = self._at.get(entity, (x, y))
            self._at[entity] = (x, y)
            self.walked[player.name] = self.walked.get(player.name, 0.0) + math.hypot(x - was[0], y - was[1])

    def mark(self) -> dict[str, Any]:
        return {
            "now": time.monotonic(),
            "cpu_s": time.process_time(),
            "ticks": len(self.began),
            "rss_mb": event_loop.rss_mb(),
            "in_view": in_view(self),
            "walked": self.walked,
        }

    def input_log(self) -> dict[str, Any]:
        logs: dict[str, dict[int, float]] = {}
        newest: dict[str, int] = {}
        for name, data, now in self.arrived:
            message = decode_from_client(data if data[:2] in HEADS else apply_mask(data[6:], data[2:6]))
            log, before, holds = logs.setdefault(name, {}), newest.get(name, -1), 0
            if isinstance(message, Restart):  # it sends the inputs from that tick on again
                newest[name] = min(before, message.tick - 1)
                logs[name] = {at: arrived for at, arrived in log.items() if at < message.tick}
                continue
            if isinstance(message, Held):
                first, n, holds = before + message.after, 1, bounds(RATE).repeats + 1
            else:
                assert isinstance(message, Inputs)
                first, n = message.first, len(message.rows) // INPUT_ROW_BYTES
            for at in range(max(first, before + 1), first + n):
                log[at] = now  # also where an earlier input held
            for at in range(first + n, first + holds):
                log.setdefault(at, now)
            newest[name] = max(before, first + n - 1)
        inputs = {
            name: [[at, arrived, at - self.first if self._used(at, arrived) else -1] for at, arrived in log.items()]
            for name, log in logs.items()
        }
        return {"first": self.first, "ticks": self.began, "inputs": inputs}

    def _used(self, at: int, arrived: float) -> bool:
        """Returns whether the input for a tick was used in it."""
        return 0 <= at - self.first < len(self.began) and arrived < self.began[at - self.first]


class Reporting(serving.Server):
    """The product's server, which also answers commands on stdin."""

    def __init__(self, settings: Settings, game: Measured) -> None:
        super().__init__(settings, game)
        self._measured = game

    async def serve(self) -> int:
        obeying = asyncio.create_task(self.obey())
        try:
            return await super().serve()
        finally:
            obeying.cancel()

    async def obey(self) -> None:
        """Answers commands, and stops the server when stdin ends."""
        commands = asyncio.StreamReader()
        loop = asyncio.get_running_loop()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
        while command := (await commands.readline()).decode().strip():
            answer = self._measured.mark() if command == "mark" else self._measured.input_log()
            print(json.dumps(answer), flush=True)
        self._end("stdin has ended", 0)


def main(argv: list[str]) -> int:
    rules = scene()
    warm_up(rules)
    settings = Settings(port=int(argv[0]), page=False, log_level="warning")
    log.set_up(settings.log_level, settings.log_format, sys.stderr)
    with asyncio.Runner(loop_factory=event_loop.loop_factory()) as runner:
        return runner.run(Reporting(settings, Measured(rules, follow="walked" in argv)).serve())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
