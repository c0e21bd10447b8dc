"""The real server, killed at any time: every edit that a client got as done is in the restored world."""

import asyncio
import contextlib
import random
import shutil
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from server.journal.records import replay
from server.persistence.database import read
from server.persistence.store import Store
from shared import edits, messages
from shared.layout import ID, X
from shared.messages import VERSION, Command, Hello, Inputs, Snapshot, Welcome, decode_from_server, encode
from shared.scene import Scene, load_scene
from shared.snapshot import VERDICT, decode_parts
from shared.units import BLOCK
from shared.world import World
from tests.e2e.processes import END_S, ServerProcess, page, running, stats
from tests.lengths import contained
from tests.patience import until

pytestmark = pytest.mark.e2e

BOTS = 6
Cell = tuple[int, int, int]


class Cells:
    """The edits that clients have asked for and the verdicts that they got, for each block above the plain."""

    def __init__(self) -> None:
        self.asked: dict[Cell, list[int]] = {}
        """Kinds that a block may have: the last one that was done (or found), and those asked for since."""
        self.done = self.refused = 0

    def ask(self, cell: Cell, kind: int) -> None:
        self.asked.setdefault(cell, [0]).append(kind)

    def answered(self, cell: Cell, kind: int, verdict: int) -> None:
        if verdict == messages.DONE:
            del self.asked[cell][: self.asked[cell].index(kind)]
            self.done += 1
        else:
            self.asked[cell].remove(kind)
            self.refused += 1

    def check(self, world: World) -> None:
        """Compares with a restored world, which is the start for further edits."""
        for cell, kinds in self.asked.items():
            found = world.blocks.get(*cell)
            assert found in kinds, f"block {cell} is {found}; could be {kinds}"
            self.asked[cell] = [found]


class Editor:
    """A client that edits the blocks above it. Each of its edits differs from the others."""

    def __init__(self, cells: Cells, scene: Scene) -> None:
        self.cells, self.scene, self.turn = cells, scene, 0
        self.entity, self.resume, self.returns = 0, b"", 0
        self.own: list[Cell] = []
        self.waiting: dict[int, tuple[Cell, int]] = {}
        self.verdicts: list[int] = []
        self.used = 0
        """Inputs that the server has used, over all lives of the server."""
        self.places: set[int] = set()

    async def play(self, address: tuple[str, int]) -> None:
        """Plays until the connection ends."""
        with contextlib.suppress(ConnectionClosed, OSError, asyncio.TimeoutError):
            async with connect(f"ws://{address[0]}:{address[1]}", compression=None, max_queue=None) as link:
                await link.send(encode(Hello(VERSION, {}, "editor", resume=self.resume)))
                async for data in link:
                    assert isinstance(data, bytes)
                    message = decode_from_server(data)
                    if isinstance(message, Welcome):
                        self.welcome(message)
                    elif isinstance(message, Snapshot):
                        self.take(message)
                        await self.act(link, message.tick)

    def welcome(self, welcome: Welcome) -> None:
        """Takes a welcome. With a resume token, the entity must be the same as before."""
        if self.resume:
            assert welcome.entity == self.entity
            self.returns += 1
        self.entity, self.resume = welcome.entity, welcome.resume
        self.own, self.waiting = [], {}

    def take(self, snapshot: Snapshot) -> None:
        self.used += snapshot.statuses.count(messages.USED)
        self.places |= {state[X] for state in self.states(snapshot) if state[ID] == self.entity}
        if not self.own:
            (state,) = [state for state in self.states(snapshot) if state[ID] == self.entity]
            x, y, z = (part // BLOCK for part in state[X : X + 3])
            self.own = [(x, y, z + 3), (x, y, z + 4), (x, y + 1, z + 3)]
        for number, verdict in VERDICT.iter_unpack(snapshot.verdicts):
            self.verdicts.append(verdict)
            self.cells.answered(*self.waiting.pop(number), verdict)

    def states(self, snapshot: Snapshot) -> list[list[int]]:
        """Returns the states in a snapshot."""
        rows: list[list[int]] = decode_parts(snapshot.segments, len(self.scene.templates))[1].tolist()
        return rows

    async def act(self, link: ClientConnection, tick: int) -> None:
        """Sends an input (east and west, to keep the world busy) and every third tick an edit."""
        move = 127 if tick // 16 % 2 else 129
        await link.send(encode(Inputs(tick + 2, tick, bytes((move, 0, 0)))))
        if tick % 3:
            return
        self.turn += 1
        cell, kind = self.own[self.turn % len(self.own)], self.turn // len(self.own) % 255 + 1
        self.waiting[self.turn] = (cell, kind)
        self.cells.ask(cell, kind)
        await link.send(
            encode(Command(self.turn, tick + 1, float(tick), edits.NAME, edits.pack(edits.Edit(*cell, kind))))
        )


@contextlib.asynccontextmanager
async def editing(address: tuple[str, int], editors: list[Editor]) -> AsyncIterator[None]:
    """Runs clients that edit. All have ended at the end of the block."""
    tasks = [asyncio.create_task(editor.play(address)) for editor in editors]
    try:
        yield
    finally:
        done, late = await asyncio.wait(tasks, timeout=END_S)
        assert not late
        for task in done:
            task.result()


def looked_at(data: Path, scene: Scene, copy: Path, game: str = "") -> tuple[World, tuple[int, str]]:
    """Returns the world in a directory, and its tick and hash; a copy is replayed in this process."""
    shutil.copytree(data, copy)
    store = Store(copy, scene, game=game)
    store.close()
    shutil.rmtree(copy)
    return store.world, store.restored


@pytest.mark.parametrize("kills", [*contained(5), pytest.param(35, marks=[pytest.mark.slow, pytest.mark.longest])])
def test_no_acknowledged_edit_is_lost_in_kills(tmp_path: Path, kills: int) -> None:
    seed = 17
    rng, cells, scene = random.Random(seed), Cells(), load_scene("flat")
    editors = [Editor(cells, scene) for _ in range(BOTS)]
    data, early = tmp_path / "data", 0
    expected: tuple[int, str] | None = None
    for life in range(kills):
        how = {"checkpoint_s": rng.choice(("0.1", "0.5", "60")), "durability": rng.choice(("process", "power"))}
        environment = {f"SOVEREIGN_{name.upper()}": value for name, value in how.items()}
        server = ServerProcess("--port", "0", "--scene", "flat", "--data", str(data), **environment)
        try:
            if life % 5 == 4:  # while the server starts
                time.sleep(rng.uniform(0.0, 0.7))
                early += 1
                server.process.kill()
            else:
                address = server.address()
                if expected is not None:
                    figures = stats(address)
                    assert (figures["restored_tick"], figures["restored_hash"]) == expected, (seed, life)
                asyncio.run(one_life(server, address, cells, editors, rng.uniform(0.05, 0.8), signal.SIGKILL))
        finally:
            server.close()
        if (data / "world.db").exists():
            world, expected = looked_at(data, scene, tmp_path / "copy")
            cells.check(world)
    assert early == kills // 5
    assert sum(editor.returns for editor in editors) > BOTS * kills // 2
    assert cells.done > 10 * kills, (cells.done, cells.refused)
    for editor in editors:  # players walk to and fro, in every life that they see
        assert editor.used > kills
        assert len(editor.places) > kills // 5, "a place is sent where a player turns"


async def one_life(
    server: ServerProcess, address: tuple[str, int], cells: Cells, editors: list[Editor], seconds: float, end: int
) -> None:
    """Edits, and sends the signal `seconds` after the first verdict."""
    before = cells.done
    async with editing(address, editors):
        await asyncio.get_running_loop().run_in_executor(None, until, lambda: cells.done > before)
        await asyncio.sleep(seconds)
        server.process.send_signal(end)


@pytest.mark.slow
def test_a_clean_stop_leaves_a_checkpoint_and_no_log(tmp_path: Path) -> None:
    data, record, cells, scene = tmp_path / "data", tmp_path / "record", Cells(), load_scene("flat")
    editors = [Editor(cells, scene) for _ in range(BOTS)]
    with running("--port", "0", "--scene", "flat", "--data", str(data), "--record", str(record)) as server:
        asyncio.run(one_life(server, server.address(), cells, editors, 0.3, signal.SIGTERM))
        assert server.end() == 0
    saved = read(data / "world.db")
    assert saved is not None
    assert saved.log == []
    assert not (data / "world.db-wal").exists()
    *_, last = replay(record)
    assert saved.checkpoint.hash == last.world.state_hash()
    world, found = looked_at(data, scene, tmp_path / "copy")
    assert found == (last.world.tick, last.world.state_hash().hex())
    cells.check(world)
    with running("--port", "0", "--scene", "flat", "--data", str(data)) as server:
        figures = stats(server.address())
        assert (figures["restored_tick"], figures["restored_hash"]) == found
        with running("--port", "0", "--scene", "flat", "--data", str(data)) as second:
            assert second.end() == 2
            assert second.rest() == []
            assert "another server is using it" in second.errors[-1]
        assert server.end(signal.SIGTERM) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="limits another process's files")
@pytest.mark.slow
def test_a_full_disk_refuses_edits_players_move_on_and_saving_resumes(tmp_path: Path) -> None:
    cells, data = Cells(), tmp_path / "data"
    with running("--port", "0", "--scene", "flat", "--data", str(data)) as server:
        address = server.address()
        asyncio.run(fill_up(server, address, cells, data))
        server.end()
        told = server.log(but="info")
    assert len(told) == 2, told
    assert "cannot save" in str(told[0])
    assert "saving again" in str(told[1])
    world, _ = looked_at(data, load_scene("flat"), tmp_path / "copy")
    cells.check(world)


async def fill_up(server: ServerProcess, address: tuple[str, int], cells: Cells, data: Path) -> None:
    loop = asyncio.get_running_loop()
    editors = [Editor(cells, load_scene("flat")) for _ in range(BOTS)]

    async def seen(condition: Callable[[], bool]) -> None:
        await loop.run_in_executor(None, until, condition)

    def limit(size: int) -> None:
        import resource  # not on Windows

        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (size, -1))

    async with editing(address, editors):
        await seen(lambda: cells.done > 20)
        limit((data / "world.db-wal").stat().st_size)
        await seen(lambda: messages.UNSAVED in editors[0].verdicts)
        figures = await loop.run_in_executor(None, stats, address)
        assert figures["save_trouble"]
        assert not figures["ready"]
        assert figures["internal_errors"] == 0
        done = cells.done
        tick = figures["tick"]
        await seen(lambda: stats(address)["tick"] > tick + 30)
        later = await loop.run_in_executor(None, stats, address)
        assert later["inputs_used"] > figures["inputs_used"]
        assert later["snapshots_sent"] > figures["snapshots_sent"]
        assert cells.done == done
        limit(-1)
        await seen(lambda: not stats(address)["save_trouble"])
        await seen(lambda: cells.done > done + 20)
        assert await loop.run_in_executor(None, page, address, "/readyz") == "ready\n"
        server.process.kill()
