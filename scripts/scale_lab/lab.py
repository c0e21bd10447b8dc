"""A run: starts a world on real processes with players, disturbs it, and measures what the players notice."""

import asyncio
import contextlib
import signal
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scripts.scale_lab.cluster import Cluster, PartProcess
from scripts.scale_lab.players import FRESH_S, Player, joined
from server.cluster.bus import PurgedError
from server.cluster.nats_bus import NatsBus
from server.journal.records import JournalError, Recording
from server.scale.wire import record_of
from server.scale.writer import UNACKNOWLEDGED_MAX

ARGUMENTS = ("--scene", "meadow", "--game", "scripts.scale_lab.tally:Tally", "--checkpoint-s", "5")
"""Arguments of all parts."""
CALM_S = 1.0
"""Seconds without a disturbance before and after each one."""
RECOVERY_S = 45.0
"""Seconds within which all players have to play again."""


@dataclass
class Disturbance:
    """One disturbance, and what it cost."""

    what: str
    world_s: float = 0.0
    """Longest time between two ticks of the log, in seconds."""
    players_s: list[float] = field(default_factory=list)
    """Longest time between two new ticks for each player, in seconds."""
    reconnects: int = 0


class Lab:
    """A cluster with players and a follower of its log.

    Args:
        folder: an existing folder for all files.
        players: number of players.
        seed: source of everything that the players do.
        edges, standbys: numbers of these parts.
        report: gets a row of the table after each disturbance.
        store: further settings of the store of the bus.
    """

    def __init__(
        self,
        folder: Path,
        *,
        players: int,
        seed: int,
        edges: int = 2,
        standbys: int = 1,
        report: Callable[[str], None] = lambda line: None,
        store: str = "",
    ) -> None:
        self._report = report
        self.cluster = Cluster(folder, edges=edges, standbys=standbys, arguments=ARGUMENTS, store=store)
        for part in self.cluster.parts:
            part.recorded = True
        self._number, self._seed = players, seed
        self.players: list[Player] = []
        self.wrong: list[str] = []
        """Faults that were found, one line each."""
        self.disturbances: list[Disturbance] = []
        self.ticks: list[int] = []
        """Ticks of the log in the order in which they came."""
        self.log_bytes = 0
        self._gap_s, self._heard = 0.0, 0.0
        self._tasks: list[asyncio.Task[None]] = []
        self._held: set[PartProcess] = set()
        """Parts that a disturbance has ended, which starts them again."""
        self.restarts = 0
        """Parts that have ended by themselves, as a deposed sequencer does, and were started again."""
        self._bus: NatsBus | None = None

    async def __aenter__(self) -> "Lab":
        try:
            await self.cluster.start()
            self._bus = await NatsBus.connect(self.cluster.nats.url, "world")
            self._tasks = [asyncio.create_task(self._follow(self._bus)), asyncio.create_task(self._supervise())]
            urls = [edge.url for edge in self.cluster.edges]
            self.players = await joined(self._number, urls, self._seed)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        for player in self.players:
            with contextlib.suppress(Exception):
                await player.leave()
        for task in self._tasks:
            task.cancel()
        if self._bus is not None:
            await self._bus.close()
        self.cluster.close()

    async def disturb(self, what: str, act: Callable[[], Awaitable[None]]) -> Disturbance:
        """Disturbs the world, and waits until all players play again."""
        await asyncio.sleep(CALM_S)
        before = sum(player.reconnects for player in self.players)
        for player in self.players:
            player.take_gap()
        self._gap_s = 0.0
        await act()
        until = time.monotonic() + RECOVERY_S
        calm = 0.0
        while calm < CALM_S and time.monotonic() < until:
            await asyncio.sleep(0.05)
            good = all(player.playing for player in self.players) and time.monotonic() - self._heard < FRESH_S
            calm = calm + 0.05 if good else 0.0
        if calm < CALM_S:
            lost = [player.name for player in self.players if not player.playing]
            self.wrong.append(f"{what}: after {RECOVERY_S:g} s these do not play: {', '.join(lost) or 'the log'}")
        done = Disturbance(
            what,
            max(self._gap_s, time.monotonic() - self._heard),
            sorted(player.take_gap() for player in self.players),
            sum(player.reconnects for player in self.players) - before,
        )
        self.disturbances.append(done)
        self._report(row(what, done.world_s, done.players_s, done.reconnects))
        return done

    async def settle(self) -> None:
        """Ends the counting, waits for all answers, and checks every player and the log."""
        for player in self.players:
            player.counting = False
        until = time.monotonic() + RECOVERY_S
        while any(player.unanswered for player in self.players) and time.monotonic() < until:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
        await asyncio.sleep(CALM_S)
        for player in self.players:
            self.wrong += player.verdicts()
        if self.ticks != list(range(1, len(self.ticks) + 1)):
            self.wrong.append("the log has not every tick once")

    def compare(self) -> int:
        """Compares the worlds of all parts tick by tick, by their recordings. Returns the number of comparisons.

        The last ticks of a sequencer that has ended may be in no record of the log. So a recording may end with other
        worlds.
        """
        known: dict[int, bytes] = {}
        compared = 0
        for path in sorted(self.cluster.folder.glob("*.rec")):
            hashes = self._hashes(path)
            differ = [tick for tick, hashed in hashes.items() if known.get(tick, hashed) != hashed]
            compared += len(hashes.keys() & known.keys())
            if differ and len([tick for tick in hashes if tick >= differ[0]]) > UNACKNOWLEDGED_MAX:
                self.wrong.append(f"{path.name}: the world of tick {differ[0]} is another one")
            for tick in hashes.keys() - set(differ):
                known.setdefault(tick, hashes[tick])
        return compared

    def _hashes(self, path: Path) -> dict[int, bytes]:
        """Returns the hash of the world after each tick of a recording."""
        hashes = {}
        try:
            with path.open("rb") as file:
                for moment in Recording(file):
                    hashes[moment.world.tick] = moment.world.state_hash()
        except JournalError as error:
            if "broke off before" not in str(error):  # it was killed at its start
                self.wrong.append(f"{path.name}: {error}")
        return hashes

    async def _follow(self, bus: NatsBus) -> None:
        """Notes when each tick of the log comes."""
        reader = await bus.follow(1)
        while True:
            try:
                stored = await reader.take(1.0)
            except PurgedError:
                self.wrong.append("the log was purged before it was followed")
                return
            if stored is None:
                continue
            record, now = record_of(stored.data), time.monotonic()
            if record.journal is not None:
                self._gap_s = max(self._gap_s, now - self._heard) if self._heard else 0.0
                self._heard = now
                self.ticks.append(record.tick)
                self.log_bytes += len(stored.data)

    async def _supervise(self) -> None:
        """Starts parts again that have ended by themselves."""
        while True:
            await asyncio.sleep(0.3)
            for part in self.cluster.parts:
                if part not in self._held and not part.alive:
                    self.restarts += 1
                    part.start()

    # -- disturbances --------------------------------------------------------------------------------------------

    async def kill(self, part: PartProcess, after_s: float = 0.5) -> None:
        """Kills a part, and starts it again after a while."""
        self._held.add(part)
        part.kill()
        await asyncio.sleep(after_s)
        part.start()
        self._held.discard(part)
        await part.ready()

    async def suspend(self, part: PartProcess, seconds: float) -> None:
        """Suspends a part for a while (SIGSTOP)."""
        part.send(signal.SIGSTOP)
        await asyncio.sleep(seconds)
        part.send(signal.SIGCONT)
        await asyncio.sleep(CALM_S)
        await part.ready()

    async def restart_bus(self, after_s: float = 0.5) -> None:
        """Kills the NATS server, and starts it again after a while."""
        self.cluster.nats.kill()
        await asyncio.sleep(after_s)
        await self.cluster.nats.start()

    async def writers(self) -> tuple[PartProcess, PartProcess]:
        """Returns the part that runs the world, and one that would take over.

        Raises:
            TimeoutError: there are none in time.
        """
        async with asyncio.timeout(RECOVERY_S):
            while True:
                parts = [part for part in (self.cluster.sequencer, *self.cluster.standbys) if part.alive]
                leads = [bool((await part.stats()).get("leads")) for part in parts]
                if leads.count(True) == 1 and len(parts) > 1:
                    return parts[leads.index(True)], parts[leads.index(False)]
                await asyncio.sleep(0.1)


def quantile(values: Sequence[float], share: float) -> float:
    """Returns a quantile of sorted values; 0 if there are none."""
    return values[min(int(len(values) * share), len(values) - 1)] if values else 0.0


HEAD = f"{'pauses in ms':<40} {'world':>7} {'players p50':>12} {'p99':>7} {'max':>7} {'reconnects':>11}"
"""Head of a table of disturbances."""


def row(what: str, world_s: float, players_s: Sequence[float], reconnects: int) -> str:
    """Returns a row of a table of disturbances; all but the pause of the world from sorted pauses of players."""
    p50, p99, most = (1e3 * quantile(players_s, share) for share in (0.5, 0.99, 1.0))
    return f"{what:<40} {1e3 * world_s:>7.0f} {p50:>12.0f} {p99:>7.0f} {most:>7.0f} {reconnects:>11}"
