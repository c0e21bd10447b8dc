"""The demonstration: a world on real processes, each of which is killed in turn while bots play."""

import asyncio
import tempfile
from functools import partial
from pathlib import Path

from scripts.scale_lab.lab import HEAD, Lab

INTRO = """\
starts a NATS server, a sequencer, two edges, a standby and {} bots, and kills each process in turn (kill -9).
A pause is the longest time without a new tick, in ms: of the world (its log), and as each player saw it.
Without a disturbance there is a tick every {:.0f} ms.
"""


async def demonstrate(players: int, seed: int) -> int:
    """Runs the demonstration and prints a table and a verdict. Returns the exit code."""
    print(INTRO.format(players, 1000 / 32), flush=True)
    with tempfile.TemporaryDirectory(prefix="sovereign-scale-") as folder:
        async with Lab(Path(folder), players=players, seed=seed, report=partial(print, flush=True)) as lab:
            print(f"{players} bots play over {len(lab.cluster.edges)} edges\n\n{HEAD}", flush=True)
            await lab.disturb("nothing", partial(asyncio.sleep, 2.0))
            for edge in lab.cluster.edges:
                await lab.disturb(f"an edge was killed ({edge.name})", partial(lab.kill, edge))
            leader, _ = await lab.writers()
            await lab.disturb(f"the sequencer was killed ({leader.name})", partial(lab.kill, leader))
            _, follower = await lab.writers()
            await lab.disturb(f"the standby was killed ({follower.name})", partial(lab.kill, follower))
            await lab.disturb("the NATS server was killed", lab.restart_bus)
            await lab.settle()
            counted = sum(player.count for player in lab.players)
            answered = sum(len(player.answers) for player in lab.players)
            entities = {player.client.entity for player in lab.players if player.client is not None}
        compared = await asyncio.to_thread(lab.compare)
    for line in lab.wrong:
        print(f"wrong: {line}")
    print(
        f"\n{len(entities)} of {players} players are still there, each with its entity; {answered} commands and edits "
        f"were answered once each, {counted} of them counted on without a gap; {len(lab.ticks)} ticks in the log, "
        f"{compared} comparisons of whole worlds between the parts"
    )
    print("verdict: " + ("SOMETHING WAS LOST" if lab.wrong else "nobody lost, nothing lost"))
    return 1 if lab.wrong else 0
