#!/usr/bin/env python3
"""A server left alone with everything at once: honest players, churn, kills, stalls and abuse; then its world is read.

    python scripts/soak.py [--minutes 30] [--clients 100] [--seed 1] [--json OUT]

One server process saves its world; a third of the honest players lose their connections every few seconds, the others
stay for up to 90 s, then leave or are cut off; all come back by themselves. Players of the SDK, one for each ten of
them, walk all the time. Meanwhile the server is killed (SIGKILL)
and started again, suspended for some seconds (SIGSTOP), and attacked (`hostile.py`). In the last 40 % of the time it
is not killed any more, so that its memory can be watched. Every edit that a player was told is done must be in the
world that is read from the directory in the end. Exits with 1 if one is lost, or an error is unexplained. That a
player's inputs are not used, or that a player of the SDK does not move, more than 2 s after a stall or a return, is an
error: snapshots would go on coming.
"""

import argparse
import asyncio
import contextlib
import dataclasses
import json
import random
import re
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from scripts._soakers import Cells, Honest
from scripts._walkers import Walker
from server.persistence.store import Store
from shared.scene import load_scene
from shared.world import World
from sovereign_netcode.loadtest.processes import CannotStartError, stats
from sovereign_netcode.stderr import Stderr

ROOT = Path(__file__).resolve().parent.parent
SCENE = "hills"
START_S_MAX = 120.0
END_S = 10.0
SAMPLE_S = 1.0
QUIET_SHARE = 0.4
"""In this last part of the time nothing is killed."""
ABUSE = {
    "nothing": 20,
    "half_a_request": 10,
    "slow_loris": 10,
    "never_reads": 5,
    "one_byte_a_second": 5,
    "mid_frame": 4,
    "rubbish": 4,
    "flood": 1,
}
CONNECTS_PER_S = 200
STALL_S = 1.0, 5.0
"""The shortest and the longest time, in seconds, for which the server is suspended."""
PER_WALKER = 10
"""Honest players for each one of the SDK; there are two of these at least."""
STUCK_S_MAX = 1.0
"""A player who could do nothing for longer, in seconds beyond the time that is allowed, is an error."""
EXPLAINED = re.compile("stalled|suspended|goes on")
"""What the watchdog says of a process that was suspended, and of a machine that others keep busy."""

Figures = dict[str, Any]


class Life:
    """The server's process, from one start to its end; the port and the directory stay."""

    def __init__(self, directory: Path, errors: list[str]) -> None:
        self.directory, self.errors = directory, errors
        self.port = 0
        self.lives = 0
        self.process: asyncio.subprocess.Process | None = None
        self.samples: list[Figures] = []
        """What `/stats` said in this life."""

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    async def start(self) -> None:
        """A new process on the old port.

        Raises:
            CannotStartError: it did not say that it listens.
        """
        self.lives += 1
        self.samples = []
        command = ("-m", "server", "--host", "127.0.0.1", "--port", str(self.port), "--scene", SCENE)
        flags = ("--data", str(self.directory / "data"), "--log-format", "json", "--checkpoint-s", "20")
        with (self.directory / f"log {self.lives}").open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *(sys.executable, *command, *flags),
                cwd=ROOT,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        assert self.process.stdout is not None
        line = b""
        with contextlib.suppress(TimeoutError):
            line = await asyncio.wait_for(self.process.stdout.readline(), START_S_MAX)
        if not line.startswith(b"listening on "):
            raise CannotStartError(f"the server did not start: {(self.directory / f'log {self.lives}').read_text()}")
        self.port = int(line.rpartition(b":")[2])

    async def end(self, number: int) -> int:
        """Its exit code after a signal; it is killed if it does not end."""
        assert self.process is not None
        self.note_faults()
        self.process.send_signal(number)
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self.process.wait(), END_S)
        self.process.kill()
        await self.process.wait()
        return -1

    def note_faults(self) -> None:
        """What the latest figures tell of errors within."""
        for name in ("internal_errors", "ticks_failed", "rules_failed"):
            if self.samples and self.samples[-1].get(name):
                self.errors.append(f"life {self.lives}: {name} {self.samples[-1][name]}")

    async def watch(self) -> None:
        """Takes samples for as long as it is let."""
        while True:
            await asyncio.sleep(SAMPLE_S)
            figures = await stats(self.url)
            if figures:
                self.samples.append(figures)

    def rss_growth_mb(self) -> float:
        """From the second quarter of this life's samples to the last one."""
        rss, n = [figures["rss_mb"] for figures in self.samples], len(self.samples)
        if n < 8:
            return 0.0
        return round(float(statistics.median(rss[-n // 4 :]) - statistics.median(rss[n // 4 : n // 2])), 2)


@dataclasses.dataclass
class Course:
    """What is done to the server, and when, in seconds from the beginning."""

    seconds: float
    rng: random.Random

    def plan(self) -> list[tuple[float, str]]:
        """Kills until the quiet part, stalls and attacks throughout; at least one of each."""
        events = []
        for what, every, share in (("kill", 90.0, 1 - QUIET_SHARE), ("stall", 75.0, 0.9), ("abuse", 60.0, 0.8)):
            n = max(1, int(self.seconds * share / every))
            gap = self.seconds * share / n
            events += [(gap * (i + self.rng.uniform(0.3, 0.9)), what) for i in range(n)]
        return sorted(events)


async def abuse(port: int, seed: int, seconds: float, made: Counter[str], errors: list[str]) -> None:
    """An attack that is over after a while."""
    order = {"port": port, "seed": seed, "peers": ABUSE, "connects_per_s": CONNECTS_PER_S}
    complaints = Stderr()
    try:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "scripts.loadgen.hostile", json.dumps(order)),
            cwd=ROOT,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=complaints.pipe,
        )
    finally:
        complaints.started()
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        await asyncio.sleep(seconds)
        process.stdin.close()
        told = json.loads(await asyncio.wait_for(process.stdout.read(), END_S) or b"{}")
        made.update(told.get("made", {}))
        code = await asyncio.wait_for(process.wait(), END_S)
        errors += [f"hostile: {error}" for error in told.get("failed", [f"it died: {complaints.cause(code)}"])]
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def disturb(life: Life, course: Course, counts: Counter[str], errors: list[str]) -> None:
    """Does what is planned; an attack goes on beside the rest."""
    begun = time.monotonic()
    length_s = min(20.0, course.seconds / 4)
    async with asyncio.TaskGroup() as group:
        for at, what in course.plan():
            await asyncio.sleep(max(0.0, begun + at - time.monotonic()))
            counts[what] += 1
            assert life.process is not None
            if what == "kill":
                await life.end(signal.SIGKILL)
                await life.start()
            elif what == "stall":
                life.process.send_signal(signal.SIGSTOP)
                await asyncio.sleep(course.rng.uniform(*STALL_S))
                life.process.send_signal(signal.SIGCONT)
            else:
                group.create_task(abuse(life.port, counts[what], length_s, counts, errors))
        await asyncio.sleep(max(0.0, begun + course.seconds - time.monotonic()))


def logged(directory: Path) -> tuple[list[str], Counter[str]]:
    """Lines of the logs that are neither information nor explained, and how often each explained one is there."""
    bad, explained = [], Counter[str]()
    for path in sorted(directory.glob("log *")):
        for line in path.read_text("utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                bad.append(f"{path.name}: {line}")
                continue
            if EXPLAINED.search(entry["event"]):
                explained[entry["event"]] += 1
            elif entry["level"] != "info":
                bad.append(f"{path.name}: {line}")
    return bad, explained


async def soak(minutes: float, clients: int, seed: int, directory: Path, console: Console) -> Figures:
    """All of it; the figures."""
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
    errors += bad + [f"player {player.number}: {what}" for player in players for what in wrongs(player)]
    errors += [f"walker {walker.number}: {what}" for walker in walkers for what in wrongs(walker)]
    for player in players:
        counts.update(player.counts)
    lost = lost_edits(directory / "data", cells)
    due = sum(player.due for player in players)
    shares = sorted(player.got / player.due for player in players if player.due)
    return {
        "minutes": minutes,
        "clients": clients,
        "seed": seed,
        "honest_snapshot_share": round(sum(player.got for player in players) / max(1, due), 5),
        "lost_edits": len(lost),
        "rss_growth_mb": growth,
        "unexplained_errors": len(errors),
        "details": {
            "snapshots_due": due,
            "worst_player_share": round(shares[0], 5) if shares else 0.0,
            "players_playing_median": statistics.median(playing) if playing else 0,
            "inputs_used": sum(player.used for player in everybody),
            "stuck_s_max": round(max(player.progress.stuck_s for player in everybody), 2),
            "walkers": len(walkers),
            "blocks_walked_least": round(min(walker.walked for walker in walkers), 1),
            "walkers_events": dict(sum((walker.counts for walker in walkers), Counter[str]())),
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


def wrongs(player: Honest | Walker) -> list[str]:
    """Returns what went wrong for a player."""
    stuck_s = player.progress.stuck_s
    return player.unexplained + ([f"stuck for {stuck_s:.1f} s"] if stuck_s > STUCK_S_MAX else [])


def lost_edits(data: Path, cells: Cells) -> list[str]:
    """Looks at every block that was edited, in the world that is in the directory."""
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


if __name__ == "__main__":
    sys.exit(main())
