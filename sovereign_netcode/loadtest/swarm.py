"""A process of bots. The load test starts it and controls it over its pipes.

argument  {"url", "first", "clients", "seed", "game", "policy", "joins_per_s"}, as JSON
stdin     a command per line: "settle": all have joined, collect garbage; "measure": the window begins; "stop": the
          window ends, report and disconnect. The end of the pipe: disconnect without a report
stdout    a JSON object per line: {"playing", "ended"} while joining, and from "measure" on also {"at", "cpu_s",
          "lag_counts", ...}, the counters of all its bots since their start. After "stop" {"clients", "cpu_s",
          "lag_counts"}, counted in the window

`lag_counts` are the counts of a `Histogram`; the counts of several processes can be added.
"""

import asyncio
import gc
import json
import random
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from client_sdk.async_client import AsyncClient
from client_sdk.bots import POLICIES, Bot, Policy
from client_sdk.events import Left
from client_sdk.stats import Stats
from client_sdk.transports.common import ConnectError
from server.observability.histogram import Histogram
from server.rules import Rules, load_rules
from shared import kernels
from shared.behaviours import Behaviour

REPORT_S = 0.2
LAG_S = 0.02
COUNTERS = (
    *("snapshots", "inputs_sent", "inputs_late", "corrections", "repredictions", "replayed_ticks", "resyncs"),
    *("bytes_up", "bytes_down"),
)


@dataclass
class Player:
    """A bot, from the attempt to connect to its end."""

    name: str
    client: AsyncClient | None = None
    left: dict[str, Any] | None = None
    """Close code and reason of the ended connection; None while it lasts or has not been tried."""
    before: dict[str, float] = field(default_factory=dict)
    causes_before: dict[str, int] = field(default_factory=dict)
    tick_before: int = 0

    @property
    def playing(self) -> bool:
        return self.client is not None and self.client.core.state == "playing"

    async def play(self, url: str, bot: Bot, behaviours: Sequence[type[Behaviour]]) -> None:
        """Connects, and plays until the connection ends for good."""
        try:
            self.client = await AsyncClient.connect(
                url, name=self.name, before_update=bot, timeout=20.0, behaviours=behaviours
            )
        except ConnectError as error:
            self.left = {"code": 0, "reason": str(error)}
            return
        async for event in self.client:
            if isinstance(event, Left):
                self.left = {"code": event.code, "reason": event.reason}

    def mark(self) -> None:
        """Remembers all counters at the start of the window."""
        if self.client is not None:
            self.before = counters(self.client.stats)
            self.causes_before = dict(self.client.stats.corrections_by_cause)
            self.tick_before = self._tick()

    def figures(self) -> dict[str, Any]:
        """Returns the counts since `mark`."""
        left = self.left or (None if self.playing else {"code": 0, "reason": "the bot did not join in time"})
        base: dict[str, Any] = {"name": self.name, "left": left, "ticks": 0} | dict.fromkeys(COUNTERS, 0)
        if self.client is None or not self.before:
            return base | {"correction_blocks": [], "causes": {}, "lead_ticks": 0.0, "rtt_ms": 0.0}
        stats = self.client.stats
        figures = {name: value - self.before[name] for name, value in counters(stats).items()}
        causes = {
            cause: n - self.causes_before.get(cause, 0)
            for cause, n in stats.corrections_by_cause.items()
            if n > self.causes_before.get(cause, 0)
        }
        sizes = stats.correction_blocks[-int(figures["corrections"]) :] if figures["corrections"] else []
        return (
            base
            | figures
            | {
                "ticks": self._tick() - self.tick_before,
                "correction_blocks": sizes,
                "causes": causes,
                "lead_ticks": stats.lead_ticks,
                "rtt_ms": stats.rtt_s * 1e3,
            }
        )

    def _tick(self) -> int:
        """Returns the newest tick that the bot has received from the server."""
        prediction = self.client.core.prediction if self.client is not None else None
        return prediction.confirmed.tick if prediction is not None else 0


def counters(stats: Stats) -> dict[str, float]:
    return {name: getattr(stats, name) for name in COUNTERS}


async def swarm(order: dict[str, Any]) -> int:
    """Runs the bots until "stop" or the end of stdin. Returns the exit code."""
    commands = listen()
    players = [Player(f"bot {order['first'] + i}") for i in range(order["clients"])]
    rules = Rules() if order["game"] is None else load_rules(order["game"])
    lives: list[asyncio.Task[None]] = []
    joining = asyncio.create_task(join(order, players, rules, lives))
    lags = Histogram()
    measuring = asyncio.create_task(lag(lags))
    cpu_s: float | None = None
    while True:
        told = {"playing": sum(p.playing for p in players), "ended": [p.left for p in players if p.left]}
        say(told if cpu_s is None else told | so_far(players, lags))
        try:
            command = await asyncio.wait_for(commands.get(), REPORT_S)
        except TimeoutError:
            continue
        if command == "settle":
            gc.collect()
            gc.freeze()
        elif command == "measure":
            lags.reset()
            cpu_s = time.process_time()
            for player in players:
                player.mark()
        elif command == "stop":
            cpu_s = time.process_time() - (cpu_s or 0.0)
            say({"clients": [player.figures() for player in players], "cpu_s": cpu_s, "lag_counts": lags.counts()})
        if command not in ("settle", "measure"):
            break
    joining.cancel()
    measuring.cancel()
    await asyncio.gather(*(p.client.close() for p in players if p.client is not None))
    for life in lives:
        life.cancel()
    await asyncio.gather(*lives, return_exceptions=True)
    return 0


def so_far(players: list[Player], lags: Histogram) -> dict[str, Any]:
    """Returns the totals of all bots since their start."""
    totals = [counters(player.client.stats) for player in players if player.client is not None]
    return {
        "at": time.monotonic(),
        "cpu_s": time.process_time(),
        "lag_counts": lags.counts(),
        **{name: sum(total[name] for total in totals) for name in COUNTERS},
    }


def policy_of(name: str | None, rules: Rules, chance: random.Random) -> Policy:
    """Returns the policy of a bot: the one with that name, else that of the game, else one that wanders."""
    found = rules.bot_policy(chance) if name is None else None
    made: Policy = found if found is not None else POLICIES[name or "wander"](chance)
    return made


async def join(order: dict[str, Any], players: list[Player], rules: Rules, lives: list[asyncio.Task[None]]) -> None:
    """Starts the bots one by one, `joins_per_s` of them per second."""
    begun = time.monotonic()
    for i, player in enumerate(players):
        bot = Bot(policy_of(order["policy"], rules, random.Random(f"{order['seed']} {player.name}")))
        lives.append(asyncio.create_task(player.play(order["url"], bot, rules.behaviours)))
        await asyncio.sleep(max(0.0, begun + (i + 1) / order["joins_per_s"] - time.monotonic()))


async def lag(found: Histogram) -> None:
    """Records every 20 ms how late the event loop is."""
    while True:
        due = time.monotonic() + LAG_S
        await asyncio.sleep(LAG_S)
        found.record(time.monotonic() - due)


def listen() -> asyncio.Queue[str]:
    """Returns a queue of the lines of stdin, with "" at its end. A thread reads it: not all event loops can."""
    commands: asyncio.Queue[str] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def read() -> None:
        for line in sys.stdin:
            loop.call_soon_threadsafe(commands.put_nowait, line.strip())
        loop.call_soon_threadsafe(commands.put_nowait, "")

    threading.Thread(target=read, daemon=True).start()
    return commands


def say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


def run(order: dict[str, Any]) -> int:
    """Runs the whole process. Returns the exit code."""
    kernels.get()  # where it has to be compiled, that is over before the first bot plays
    try:
        import uvloop
    except ImportError:
        return asyncio.run(swarm(order))
    return int(uvloop.run(swarm(order)))


if __name__ == "__main__":
    sys.exit(run(json.loads(sys.argv[1])))
