"""Leaves a server alone with honest players, churn, kills, stalls and abuse, and then checks its world.

    python scripts/soak.py [--minutes 30] [--clients 100] [--seed 1] [--json OUT]

One server process saves its world. A third of the honest players lose their connections every few seconds. The others
stay for up to 90 s, and then leave or are cut off. All come back by themselves. Players of the SDK, one for every ten
honest players, walk all the time. Meanwhile the server is killed (SIGKILL) and started again, suspended for some
seconds (SIGSTOP), and attacked (`scripts.loadgen.hostile`). In the last 40 % of the time it is not killed, because its
memory is watched. At the end, the saved world must have every edit that the server has confirmed.

Exits with 1 if an edit is lost or an error is unexplained. A player is stuck, which is an error, if the server uses
none of its inputs more than 2 s after a stall or a return. A player of the SDK is also stuck if it does not move.
"""

import argparse
import asyncio
import json
import random
import signal
import statistics
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from scripts.soak_test.cells import Cells
from scripts.soak_test.disturbance import Course, disturb
from scripts.soak_test.honest import Honest
from scripts.soak_test.server_process import SAMPLE_S, SCENE, Life, logged
from scripts.soak_test.walkers import Walker
from server.persistence.store import Store
from shared.scene import load_scene
from shared.world import World
from sovereign_netcode.loadtest.processes import CannotStartError

PER_WALKER = 10
"""Number of honest players per player of the SDK. There are at least two of the SDK."""
STUCK_S_MAX = 1.0
"""Most seconds, beyond the time that is allowed, for which a player may be stuck."""

Figures = dict[str, Any]


async def soak(minutes: float, clients: int, seed: int, directory: Path, console: Console) -> Figures:
    """Runs the whole soak test. Returns its figures."""
    cells, errors, counts = Cells(), list[str](), Counter[str]()
    life = Life(directory, errors)
    await life.start()
    players = [Honest(i, life.port, seed, cells, lossy=i % 3 == 0) for i in range(clients)]
    walkers = [Walker(i, life.port) for i in range(max(2, clients // PER_WALKER))]
    everybody: list[Honest | Walker] = [*players, *walkers]
    tasks = [asyncio.create_task(player.play()) for player in everybody]
    watching = [asyncio.create_task(life.watch())]
    playing: list[int] = []
    try:
        course = Course(minutes * 60, random.Random(seed))
        disturbing = asyncio.create_task(disturb(life, course, counts, errors))
        watching.append(disturbing)
        with Progress(console=console, disable=not console.is_terminal) as progress:
            bar = progress.add_task("soak", total=course.seconds)
            while not disturbing.done():
                await asyncio.wait([disturbing], timeout=SAMPLE_S)
                playing.append(sum(player.playing for player in players))
                progress.update(bar, advance=SAMPLE_S, description=f"life {life.lives}, {playing[-1]} play")
        await disturbing
        growth = life.rss_growth_mb()
        for task in (*tasks, *watching):
            if task.done() and not task.cancelled() and task.exception() is not None:
                errors.append(f"a player: {task.exception()!r}")
            task.cancel()
        code = await life.end(signal.SIGTERM)
        if code != 0:
            errors.append(f"the server ended with {code}")
    finally:
        for task in (*tasks, *watching):
            task.cancel()
        await asyncio.gather(*tasks, *watching, return_exceptions=True)
        if life.process is not None and life.process.returncode is None:
            life.process.kill()
            await life.process.wait()
    bad, explained = logged(directory)
    errors += bad + [f"player {player.number}: {error}" for player in players for error in wrongs(player)]
    errors += [f"walker {walker.number}: {error}" for walker in walkers for error in wrongs(walker)]
    for player in players:
        counts.update(player.counts)
    lost = lost_edits(directory / "data", cells)
    return {
        "minutes": minutes,
        "clients": clients,
        "seed": seed,
        "honest_snapshot_share": round(sum(player.got for player in players) / max(1, _due(players)), 5),
        "lost_edits": len(lost),
        "rss_growth_mb": growth,
        "unexplained_errors": len(errors),
        "details": {
            **details(players, walkers, playing),
            "edits_done": cells.verdicts[0],
            "edits_by_verdict": dict(sorted(cells.verdicts.items())),
            "blocks_checked": len(cells.settled),
            "lives": life.lives,
            "rss_mb": [life.samples[i]["rss_mb"] for i in (0, -1)] if life.samples else [],
            "counts": dict(counts),
            "explained": dict(explained),
            "errors": errors[:50],
            "lost": lost[:50],
        },
    }


def details(players: list[Honest], walkers: list[Walker], playing: list[int]) -> Figures:
    """Returns figures of the players.

    Args:
        playing: number of honest players that play, one for each sample.
    """
    shares = sorted(player.got / player.due for player in players if player.due)
    everybody: list[Honest | Walker] = [*players, *walkers]
    return {
        "snapshots_due": _due(players),
        "worst_player_share": round(shares[0], 5) if shares else 0.0,
        "players_playing_median": statistics.median(playing) if playing else 0,
        "inputs_used": sum(player.used for player in everybody),
        "stuck_s_max": round(max(player.progress.stuck_s for player in everybody), 2),
        "walkers": len(walkers),
        "blocks_walked_least": round(min(walker.walked for walker in walkers), 1),
        "walkers_events": dict(sum((walker.counts for walker in walkers), Counter[str]())),
    }


def _due(players: list[Honest]) -> int:
    """Returns the number of snapshots that the server has made for all players."""
    return sum(player.due for player in players)


def wrongs(player: Honest | Walker) -> list[str]:
    """Returns the errors of a player."""
    stuck_s = player.progress.stuck_s
    return player.unexplained + ([f"stuck for {stuck_s:.1f} s"] if stuck_s > STUCK_S_MAX else [])


def lost_edits(data: Path, cells: Cells) -> list[str]:
    """Loads the saved world. Returns the edited blocks that are not what they may be."""
    scene = load_scene(SCENE)
    untouched = World(scene)
    untouched.load_terrain()
    store = Store(data, scene)
    store.close()
    return cells.lost(store.world, untouched)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--minutes", type=float, default=30.0, metavar="M", help="default: %(default)g")
    parser.add_argument("--clients", type=int, default=100, metavar="N", help="honest players (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the figures to this file")
    args = parser.parse_args(argv)
    console = Console()
    for number in (signal.SIGINT, signal.SIGTERM):  # the server ends as well
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as directory:
        try:
            found = asyncio.run(soak(args.minutes, args.clients, args.seed, Path(directory), console))
        except CannotStartError as error:
            console.print(f"error: {error}", style="red", highlight=False, markup=False)
            return 2
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            return 130
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
    console.print_json(json.dumps(found))
    return int(bool(found["lost_edits"] or found["unexplained_errors"]))
