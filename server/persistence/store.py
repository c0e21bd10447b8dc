"""A world that outlives its process: `--data DIR`.

Theory of operation. The physics is deterministic, so a world is its last checkpoint and what it has been told since. A
store is a pen on the world (`server.journal.recorded_world`): after every step it has the record of that tick, the same
bytes that a recording would hold, and hands it to a thread of its own. That thread puts what has come since its last
transaction into the next one (group commit), so there is never more than one fsync under way, and a slow disk makes the
groups larger, not the ticks longer. `durable_tick` is the newest tick that is on disk. The game holds back until then
what it promises: the verdict on a command, and the welcome with the token to come back with. A client that was told
"done" finds it done after any crash. What others see of it in their snapshots meanwhile is news, not a promise.
`server.persistence.restore` puts the world together again: checkpoint, then every record, each compared with the marks
and hashes in it; it is the same world at the same tick, or an error. `server.persistence.mark` knows how far the log
must reach. What belongs to the game and is not in the world goes the same way: `keep` for the checkpoint,
`RecordedWorld.note` for the log.

A tick in which nothing was told, nothing moved and nothing changed is quiet. Quiet ticks are written once a second; the
loss of some is the loss of nothing, so they count as durable as soon as everything before them is.

Every `checkpoint_s` seconds the world is copied (`server.persistence.checkpoint`: entities at once, the segments
touched since the checkpoint before piece by piece and in the thread), packed between the transactions of the log, and
saved in one transaction, which also drops the log up to there. Until it is complete the old checkpoint and its log are.
The ticks wait for none of it.

A checkpoint that fails by a fault of our own is reported, counted and tried again; the log goes on meanwhile. When the
disk takes no more, or does not keep up by more than `BEHIND_S`, there is a gap: `trouble` says why, records are
dropped, and the game refuses commands (`messages.UNSAVED`) while players move on. What was told "done" before is on
disk; what was carried out and not yet answered stays unanswered. Then the file is opened anew and a fresh checkpoint
tried, again and again. With it everything is saved, the unanswered too, and the gap is closed.

Rejected: a transaction in the tick (a disk's hiccup would be everybody's); a log of states instead of inputs (a hundred
times the bytes); a file per segment (no transaction spans them); a copy of the world by fork (threads, and Windows);
one replica that replays the log in the thread (twice the CPU, all the time). Not promised: that ticks which clients
have seen in snapshots, and got no verdict for, survive; those that the next transaction would have held are lost.
"""

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgpack

from server.journal.recorded_world import Pen
from server.observability.errors import Faults
from server.observability.histogram import Histogram
from server.persistence.checkpoint import Checkpoint, Copy, Saved
from server.persistence.database import Database, Record, StoreError, chained, seal_of
from server.persistence.restore import claimed, load
from shared.checks import Cell, text
from shared.inputs import Input
from shared.scene import Scene
from shared.world import World

LOG_BYTES_MAX = 32 << 20
"""A log that has grown to this is cut by a checkpoint ahead of time."""
HASHED_MAX = 1000
"""In larger worlds, whole hashes are left to the checkpoints: no tick should pay for one."""
STALE_MAX = 16
"""So are those of worlds in which more segments wait for their digests, 40 us each."""
QUIET_S = 1.0
"""Ticks in which nothing happened wait so long for company."""
BEHIND_S = 10.0
"""The disk may be so far behind the world before its records are dropped."""
RETRY_S = 2.0
"""After a failure the next attempt waits so long, twice as long after each further one,"""
RETRY_MAX_S = 30.0
"""but no longer than this: a disk that stays full should not fill with lines of the log, either."""
GAME_MAX = 1024
"""The longest name of a game, in characters."""
CLOSE_S = 2.5
"""The end waits so long for the disk."""

logger = logging.getLogger(__name__)


class Store(Pen):
    """A directory with a world in it.

    Args:
        directory: made if it is not there.
        scene: the rules; they must be those that the world was saved with.
        game: so must the game be, MODULE:CLASS; empty: none.
        power: whether a verdict waits until it survives a power cut (an fsync), or just the end of the process.
        checkpoint_s: a checkpoint so often, in seconds of the world's time.
        compiled: as for `World`.

    Attributes:
        world: the one that was saved, or a new one.
        kept: what `keep` returned for its checkpoint; None for a new world.
        notes: what has been noted since then, in order.

    Raises:
        SceneError: the game's name is no text that UTF-8 can hold.
        StoreError: what is there cannot be used, by this program or now; nothing has been changed.
    """

    def __init__(
        self,
        directory: str | Path,
        scene: Scene,
        *,
        game: str = "",
        power: bool = True,
        checkpoint_s: float = 60.0,
        compiled: bool | None = None,
    ) -> None:
        super().__init__(first=False, hashed_max=HASHED_MAX, stale_max=STALE_MAX)
        text(game, "game", GAME_MAX, shortest=0)
        self._path = Path(directory) / "world.db"
        self._rules, self._game = msgpack.packb(scene.to_table()), game
        self.faults = Faults("the store has failed")
        """Exceptions of our own, by what has been given up because of them."""
        self.checkpoints_failed = 0
        self._power = power
        self._checkpoint_ticks = max(1, round(checkpoint_s * scene.tick_rate))
        self.trouble = ""
        """Why nothing can be saved just now, in one line; empty if all is well."""
        self.commit_s, self.checkpoint_s = Histogram(), Histogram()
        """How long it took from the end of a step until its record was on disk, and a checkpoint."""
        # The thread's own:
        self._chain_there = 0
        self._retry_s = RETRY_S
        self._copying: Copy | None = None
        self._pieces: Iterator[Checkpoint | None] = iter(())
        self._began = 0.0
        # Between the loop and the thread, under its lock:
        self._wake = threading.Condition()
        self._records: list[tuple[int, bytes, float]] = []
        self._copy: Copy | None = None
        self._urgent = self._closing = self._copy_due = self._gap = self._reopening = False
        self._claim = claimed(self._path.parent)
        try:
            loaded = load(self._path, scene, game, compiled=compiled)
            self._file: Database | None = Database(self._path, power=power)
            self._saved: Saved = loaded.saved
            self._seals: dict[bytes, Saved] = {self._file.seal(): loaded.saved}
        except sqlite3.Error as error:
            self._claim.close()
            raise StoreError(f"{self._path}: cannot be written ({error})") from error
        except BaseException:
            self._claim.close()
            raise
        self.world, self.kept = loaded.world, loaded.kept
        self.notes: Sequence[tuple[int, Any]] = loaded.notes
        self._chain, self._log_bytes, self._copied = loaded.chain, loaded.log_bytes, loaded.checkpoint_tick
        self.restored = (self.world.tick, self.world.state_hash().hex())
        """The tick and the state hash of the world that was found, or of the new one."""
        self._tick = self._loud = self._written = self._not_before = self.world.tick
        self._keep: Callable[[], Any] = lambda: None
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self.world.attach(self)

    # -- the loop's side -------------------------------------------------------------------------------------

    def start(self, keep: Callable[[], Any]) -> None:
        """Begins to write. What has happened to the world since it was loaded belongs to the first tick.

        Args:
            keep: what belongs to the world and is not in it, for a checkpoint: anything that MessagePack can hold. It
                is called at the end of a step, when all that was noted so far belongs to that tick.
        """
        self._keep = keep
        self._thread.start()

    @property
    def durable_tick(self) -> int:
        """The newest tick with nothing before it that a crash could undo."""
        return self._tick if self._written >= self._loud else self._written

    @property
    def idle(self) -> bool:
        """Whether no checkpoint is being made."""
        return self._copy is None

    def touch(self, segment: Cell) -> None:
        copy = self._copy
        if copy is not None:
            copy.touch(segment)

    def tick(self, world: World, inputs: Mapping[int, Input]) -> None:
        tick = world.tick
        try:
            parts = self.taken(world, inputs)
            record, loud = msgpack.packb(parts), any(parts[:3])
        except Exception:  # the tick goes on: what it was told is as good as on a disk that takes nothing
            self.faults.report("the record of a tick")
            with self._wake:
                self._tick = self._loud = tick
                self._drop("internal error")
            return
        due = self._copy_due or tick - self._copied >= self._checkpoint_ticks
        if self._gap:  # not before the file is opened anew: the log must not go on behind a gap
            due = self._reopening
        copy = self._copied_world() if self._copy is None and due and tick >= self._not_before else None
        with self._wake:
            self._tick = tick
            if loud:
                self._loud = tick
            if not self._gap:
                self._records.append((tick, record, time.monotonic() if loud else 0.0))
            if copy is not None:
                self._copy, self._copied, self._copy_due, self._gap = copy, tick, False, False
            if len(self._records) > BEHIND_S * world.scene.tick_rate:
                self._drop(f"the disk is more than {BEHIND_S:g} s behind")
            if loud or copy is not None:
                self._urgent = True
                self._wake.notify()

    def close(self) -> bool:
        """Saves all that there is, and lets go of the directory; whether that worked."""
        self.world.detach(self)
        if self._thread.is_alive():
            copy = self._copied_world()  # if that fails, the log has all that there is
            with self._wake:
                self._copy = copy
                self._closing = self._urgent = True
                self._wake.notify()
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                logger.error("the disk does not answer: what happened since tick %d may be lost", self._written)
                return False
        elif self._file is not None:
            self._file.close()
        self._claim.close()
        if self.trouble:
            logger.error(
                "the end could not be saved: %s; what happened since tick %d is lost", self.trouble, self._written
            )
        return not self.trouble

    def stats(self) -> dict[str, Any]:
        """What `/stats` shows."""
        return {
            "save_trouble": self.trouble,
            "restored_tick": self.restored[0],
            "restored_hash": self.restored[1],
            "durable_tick": self.durable_tick,
            "journal_lag_ticks": self._tick - self.durable_tick,
            "log_bytes": self._log_bytes,
            "commit_ms": self.commit_s.summary(),
            "checkpoints": self.checkpoint_s.count,
            "checkpoints_failed": self.checkpoints_failed,
            "checkpoint_ms": self.checkpoint_s.summary(),
        }

    def _copied_world(self) -> Copy | None:
        """A copy of the world for a checkpoint; None if that failed, which is counted, and tried again later."""
        try:
            return Copy(self.world, msgpack.packb(self._keep()))
        except Exception:
            self._checkpoint_failed()
            return None

    def _checkpoint_failed(self) -> None:
        """An exception of ours has hit a checkpoint: the log goes on, and another attempt follows."""
        self.faults.report("a checkpoint")
        self.checkpoints_failed += 1
        self._copy_due = True
        self._not_before = self._tick + round(RETRY_S * self.world.scene.tick_rate)

    # -- the thread's side -----------------------------------------------------------------------------------

    def _run(self) -> None:
        done = False
        while not done:
            try:
                if self._file is None:
                    self._reopen()
                else:
                    self._write_on(self._file)
            except (sqlite3.Error, OSError) as error:
                self._fail(str(error))
            except Exception:
                self.faults.report("writing")
                self._fail("internal error")
            with self._wake:
                done = self._closing and self._copy is None and not self._records
        if self._file is not None:
            self._file.close()

    def _write_on(self, file: Database) -> None:
        """Writes what has come, and packs a piece of the checkpoint that is being made."""
        with self._wake:
            if self._copy is None:
                self._wake.wait_for(lambda: self._urgent, QUIET_S)
            self._urgent = False
            records, self._records = self._records, []
            copy, gap = self._copy, self._gap
        there = self._append(file, records, -1 if copy is None else copy.tick)
        if gap:
            file.close()
            self._file = None
        elif copy is not None:
            if copy is not self._copying:
                self._copying, self._pieces, self._chain_there = copy, copy.pieces(self._saved), there
                self._began = time.monotonic()
            try:
                checkpoint = next(self._pieces)
                if checkpoint is not None and self._copy is copy:
                    self._save(file, copy, checkpoint, self._chain_there)
                    self._retry_s = RETRY_S
            except (sqlite3.Error, OSError):
                raise
            except Exception:
                if self.trouble:  # it was to close a gap, behind which the log must not go on
                    raise
                with self._wake:
                    self._checkpoint_failed()
                    self._copy = None if self._copy is copy else self._copy

    def _append(self, file: Database, records: list[tuple[int, bytes, float]], tick: int) -> int:
        """Puts records on disk, in one transaction; what the chain is after a tick."""
        chain = there = self._chain
        rows = []
        for at, record, _ in records:
            chain = chained(record, chain)
            there = chain if at <= tick else there
            rows.append(Record(at, record, chain))
        if rows:
            file.append(rows)
            self._chain, self._written = chain, rows[-1].tick
            now = time.monotonic()
            for _, record, began in records:
                self._log_bytes += len(record)
                if began:
                    self.commit_s.record(now - began)
        if self._log_bytes > LOG_BYTES_MAX:
            self._copy_due = True
        return there

    def _save(self, file: Database, copy: Copy, checkpoint: Checkpoint, chain: int) -> None:
        """Puts a checkpoint on disk; the gap before it, if there was one, is closed."""
        seal = seal_of(checkpoint, self._rules, chain)
        self._seals[seal] = copy.saved
        file.save(checkpoint, self._rules, chain, self._game)
        self._saved, self._seals = copy.saved, {seal: copy.saved}
        self._written = max(self._written, copy.tick)
        self._log_bytes = 0
        self.checkpoint_s.record(time.monotonic() - self._began)
        with self._wake:
            if self._copy is copy:
                self._copy = None
            if self.trouble and not self._gap:
                logger.warning("saving again, as of tick %d", copy.tick)
                self.trouble = ""

    def _reopen(self) -> None:
        """After a gap: waits a while, and saves everything anew. What has come since then follows in `_write_on`."""
        with self._wake:
            self._wake.wait_for(lambda: self._closing, self._retry_s)
            self._reopening = True
            self._wake.wait_for(lambda: self._copy is not None or self._closing)
            self._reopening = False
            copy = self._copying = self._copy
            if self._closing:
                self._gap = False
        if copy is None:
            return
        self._began = time.monotonic()
        file = Database(self._path, power=self._power)
        try:
            seal = file.seal()  # an attempt that failed may have been carried out all the same
            self._saved = self._seals.get(seal) or dict.fromkeys(file.segments())
            self._seals = {seal: self._saved}
            for checkpoint in copy.pieces(self._saved):
                if checkpoint is not None and self._copy is copy:
                    self._save(file, copy, checkpoint, self._chain)
                    self._file = file
        finally:
            if self._file is not file:
                file.close()

    def _fail(self, reason: str) -> None:
        """The file takes nothing, for this reason."""
        self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
        if self._file is not None:
            self._file.close()
            self._file = None
        with self._wake:
            self._drop(reason)

    def _drop(self, reason: str) -> None:
        """Begins a gap; the lock is held."""
        if not self.trouble:
            logger.error("cannot save: %s; commands are refused until it works again", reason)
        self.trouble, self._gap = reason, True
        if not self._closing or self._copy is self._copying:  # else it is the last one, which has not been tried yet
            self._copy = None
        self._records.clear()
