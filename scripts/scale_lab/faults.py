"""Seeded faults: each run starts a world on real processes, disturbs it by chance, and checks every player and part."""

import asyncio
import contextlib
import random
import tempfile
from collections import defaultdict
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

import nats
from nats.errors import Error as NatsError
from nats.js.errors import Error as StreamError

from scripts.scale_lab.lab import HEAD, Disturbance, Lab, row

STORE_MB = 48
"""Size of the store of the bus in MB, so that it can be filled."""
FILLING_BYTES = 500_000
"""Size of a message that fills the store, in bytes."""


async def fill(lab: Lab, seconds: float) -> None:
    """Fills the store of the bus, and empties it after a while."""
    client = await nats.connect(lab.cluster.nats.url)
    stream = client.jetstream(timeout=2.0)
    try:
        await stream.add_stream(name="FILLER", subjects=["filler"])
        with contextlib.suppress(NatsError, StreamError, TimeoutError):
            for _ in range(2 * STORE_MB * 1_000_000 // FILLING_BYTES):
                await stream.publish("filler", bytes(FILLING_BYTES))
        await asyncio.sleep(seconds)
    finally:
        await stream.delete_stream("FILLER")
        await client.close()


async def chosen(lab: Lab, rng: random.Random) -> tuple[str, Callable[[], Awaitable[None]]]:
    """Returns a disturbance by chance: its name and the function that makes it."""
    (leader, follower), edge = await lab.writers(), rng.choice(lab.cluster.edges)
    seconds = rng.uniform(0.05, 1.5)
    kinds: dict[str, Callable[[], Awaitable[None]]] = {
        "edge killed": partial(lab.kill, edge, seconds),
        "sequencer killed": partial(lab.kill, leader, seconds),
        "standby killed": partial(lab.kill, follower, seconds),
        "edge suspended": partial(lab.suspend, edge, 2 * seconds),
        "sequencer suspended": partial(lab.suspend, leader, seconds),
        "standby suspended": partial(lab.suspend, follower, 2 * seconds),
        "bus killed": partial(lab.restart_bus, seconds),
        "store of the bus full": partial(fill, lab, seconds),
    }
    name = rng.choice(sorted(kinds))
    return name, kinds[name]


async def run(seed: int, *, players: int, disturbances: int, report: Callable[[str], None]) -> Lab:
    """Runs one seed. Returns the run, with its disturbances and what went wrong.

    Args:
        seed: the seed.
        players: number of players.
        disturbances: number of disturbances.
        report: gets a line after each disturbance.
    """
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="sovereign-faults-") as folder:
        limit = f"max_file_store: {STORE_MB}MB"
        async with Lab(Path(folder), players=players, seed=seed, report=report, store=limit) as lab:
            for _ in range(disturbances):
                await asyncio.sleep(rng.random())
                await lab.disturb(*await chosen(lab, rng))
            await lab.settle()
        await asyncio.to_thread(lab.compare)
    return lab


async def runs(first: int, number: int, *, players: int, disturbances: int) -> int:
    """Runs many seeds, and prints a table of all pauses by the kind of disturbance. Returns the exit code."""
    wrong = 0
    known: defaultdict[str, list[Disturbance]] = defaultdict(list)
    print(HEAD, flush=True)
    for seed in range(first, first + number):
        lab = await run(
            seed, players=players, disturbances=disturbances, report=partial(print, f"{seed:>4} ", flush=True)
        )
        for one in lab.disturbances:
            known[one.what].append(one)
        for line in lab.wrong:
            print(f"seed {seed}: wrong: {line}", flush=True)
        wrong += bool(lab.wrong)
    print(f"\n{HEAD}   (world: the longest of all)")
    for what, ones in sorted(known.items()):
        pauses = sorted(pause for one in ones for pause in one.players_s)
        world = max(one.world_s for one in ones)
        print(row(f"{what} ({len(ones)})", world, pauses, sum(one.reconnects for one in ones)))
    print(
        f"\n{number - wrong} of {number} runs without a fault: no command lost or doubled, equal worlds at every tick"
    )
    return 1 if wrong else 0
