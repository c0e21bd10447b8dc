"""The store: saves a world in a directory, so that it outlives the process (`--data DIR`).

Theory of operation. The physics is deterministic, so a world is its last checkpoint plus the inputs and calls since. A
store observes the world as a pen (`server.journal.recorded_world`). After every step it gets the record of that tick,
with the same bytes as in a recording, and passes it to a thread of its own. The thread writes all records that came
since its last transaction in one transaction (group commit). So there is never more than one fsync under way, and a
slow disk makes the groups larger, but not the ticks longer.

`durable_tick` is the newest tick that is on disk. Until then the game holds back its promises: the verdict of a
command, and the welcome with the resume token. If a client received "done", the command is done after any crash.
Snapshots are not held back, so other clients may see a change before it is durable.

`server.persistence.restore` restores a world from the checkpoint and every record after it, and compares the marks and
hashes in them. The result is the same world at the same tick, or an error. `server.persistence.mark` knows how far the
log must reach. The state of the game beside its world is saved in the same way: by `keep` for the checkpoint, and by
`RecordedWorld.note` for the log.

A tick without inputs, calls and changes is quiet. Quiet ticks are written once per second. Losing them loses nothing,
so they count as durable as soon as everything before them is.

Every `checkpoint_s` seconds the world is copied (`server.persistence.checkpoint`): entities at once, segments that were
touched since the last checkpoint one by one in the thread. The copy is packed between the transactions of the log and
saved in one transaction, which also drops the log up to its tick. Until that is complete, the old checkpoint and its
log stay valid. The ticks wait for none of this.

If a checkpoint fails by a fault of our own, that is logged, counted and tried again, and the log goes on. If the disk
accepts nothing, or is more than `BEHIND_S` behind, a gap begins: `trouble` has the reason, records are dropped, and the
game refuses commands (`messages.UNSAVED`) while players can still move. Commands that were answered with "done" before
are on disk; commands that were carried out and not answered stay unanswered. Then the thread reopens the file and saves
a new checkpoint, and repeats this until it works. That saves everything, the unanswered commands too, and ends the gap.
"""

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgpack

from server.journal.recorded_world import Observer
from server.observability.errors import FaultReporter
from server.observability.histogram import Histogram
from server.persistence.checkpoint import Checkpoint, Copy, Saved
from server.persistence.database import Database, Record, StoreError, chained, seal_of
from server.persistence.owned import Owned
from server.persistence.restore import Loaded, claimed, load
from shared.checks import Cell, text
from shared.inputs import Input
from shared.scene import Scene
from shared.world import World
from shared.world_state import WorldState

LOG_BYTES_MAX = 32 << 20
"""Size of the log in bytes that triggers a checkpoint ahead of time."""
HASHED_MAX, STALE_MAX = 1000, 16
"""Numbers of entities, and of segments without a present digest (40 us each), up to which ticks have hashes of the
whole world. Otherwise only checkpoints have them."""
QUIET_S, BEHIND_S = 1.0, 10.0
"""Seconds that quiet ticks may wait to be written, and that the disk may be behind before records are dropped."""
RETRY_S, RETRY_MAX_S = 2.0, 30.0
"""Seconds until the next attempt after a failure, doubled with each further one, and the longest time between two."""
GAME_MAX = 1024
"""Maximum length of the name of a game, in characters."""
CLOSE_S = 2.5
"""Seconds that the shutdown waits for the disk."""

logger = logging.getLogger(__name__)


class Store(Owned, Observer):
    """A directory with a saved world.

    Args:
        directory: the directory; it is created if it does not exist.
        scene: the scene; it must be the one with which the world was saved.
        game: the name of the game, MODULE:CLASS, or empty; it must be the one with which the world was saved.
        power: whether a durable tick survives a power cut (by an fsync), or only the end of the process.
        checkpoint_s: seconds of the world's time between two checkpoints.
        compiled: whether the kernel is compiled, as for `World`.
        terrain: a world of the scene as generated, for `World.restore`; None: it is generated anew.

    Attributes:
        world: the saved world, or a new one.
        kept: the result of `keep` for the checkpoint; None for a new world.
        notes: notes since the checkpoint, in order.

    Raises:
        SceneError: the name of the game is too long, or UTF-8 cannot encode it.
        StoreError: the directory or the world in it cannot be used. Nothing has been changed.
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
        terrain: World | None = None,
    ) -> None:
        super().__init__(first=False, hashed_max=HASHED_MAX, stale_max=STALE_MAX)
        text(game, "game", GAME_MAX, shortest=0)
        self._path = Path(directory) / "world.db"
        self._rules, self._game = msgpack.packb(scene.to_table()), game
        self.faults = FaultReporter("the store has failed")
        self.checkpoints_failed, self._power = 0, power
        self._checkpoint_ticks = max(1, round(checkpoint_s * scene.tick_rate))
        self.trouble = ""
        """Reason why nothing can be saved at the moment, in one line; empty: saving works."""
        self.commit_s, self.checkpoint_s = Histogram(), Histogram()
        """Durations from the end of a step until its record was on disk, and durations of checkpoints."""
        # Used by the thread only:
        self._chain_there, self._retry_s, self._began = 0, RETRY_S, 0.0
        self._copying: Copy | None = None
        self._pieces: Iterator[Checkpoint | None] = iter(())
        # Shared by the event loop and the thread, guarded by the lock of `_wake`:
        self._wake = threading.Condition()
        self._records: list[tuple[int, bytes, float]] = []
        self._copy: Copy | None = None
        self._urgent = self._closing = self._copy_due = self._gap = self._reopening = False
        self._claim = claimed(self._path.parent)
        self._file: Database | None = None
        self._seals: dict[bytes, Saved] = {}
        try:
            loaded = self._load(scene, compiled, terrain)
        except BaseException as error:
            self._claim.close()
            if isinstance(error, sqlite3.Error):
                raise StoreError(f"{self._path}: cannot be written ({error})") from error
            raise
        self.world, self.kept = loaded.world, loaded.kept
        self._saved: Saved = loaded.saved
        self.notes: Sequence[tuple[int, Any]] = loaded.notes
        self._chain, self._log_bytes, self._copied = loaded.chain, loaded.log_bytes, loaded.checkpoint_tick
        self.restored = (self.world.tick, self.world.state_hash().hex())
        """Tick and state hash of the restored or new world."""
        self._tick = self._loud = self._written = self._not_before = self.world.tick
        self._keep: Callable[[], Any] = lambda: None
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self.world.attach(self)

    # -- the loop's side -------------------------------------------------------------------------------------

    def start(self, keep: Callable[[], Any]) -> None:
        """Starts to write. Changes of the world since it was loaded belong to the first tick.

        Args:
            keep: returns the state beside the world for a checkpoint, as a MessagePack value. It is called at the end
                of a step, when all notes so far belong to that tick.
        """
        self._keep = keep
        self._thread.start()

    @property
    def durable_tick(self) -> int:
        """Newest tick that a crash cannot undo."""
        return self._tick if self._written >= self._loud else self._written

    @property
    def idle(self) -> bool:
        """Whether no checkpoint is being made."""
        return self._copy is None

    def touch(self, segment: Cell) -> None:
        copy = self._copy
        if copy is not None:
            copy.touch(segment)

    def tick(self, world: WorldState, inputs: Mapping[int, Input]) -> None:
        tick = world.tick
        try:
            parts = self.taken(world, inputs)
            record, loud = msgpack.packb(parts), any(parts[:3])
        except Exception:  # the tick goes on, as with a disk that accepts nothing
            self.faults.report("the record of a tick")
            with self._wake:
                self._tick = self._loud = tick
                self._drop("internal error")
            return
        due = self._copy_due or tick - self._copied >= self._checkpoint_ticks
        if self._gap:  # not before the file is reopened, because the log must not go on behind a gap
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
            self._urgent = self._urgent or loud or copy is not None
            if self._urgent or len(self._records) == 1:
                self._wake.notify()

    def end(self, *, save: bool = True) -> None:
        """Lets the thread save everything, unless `save` is false, and end. The world must not change any more."""
        self.world.detach(self)
        with self._wake:  # if the copy fails, the log has everything
            self._copy = self._copied_world() if save and self._thread.is_alive() else None
            self._records = self._records if save else []
            self._closing = self._urgent = True
            self._wake.notify()

    def close(self) -> bool:
        """Saves everything and releases the directory. Returns whether everything was saved."""
        if not self._closing:
            self.end()
        if self._thread.ident is not None:
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                logger.error("the disk does not respond: changes since tick %d may be lost", self._written)
                return False
        elif self._file is not None:
            self._file.close()
        self._claim.close()
        if self.trouble:
            logger.error("not saved: %s; the changes since tick %d are lost", self.trouble, self._written)
        return not self.trouble

    def stats(self) -> dict[str, Any]:
        """Returns the figures of the store for `/stats`."""
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

    def _load(self, scene: Scene, compiled: bool | None, terrain: World | None) -> Loaded:
        """Returns the saved world, or a new one, and opens the file."""
        loaded = load(self._path, scene, self._game, compiled=compiled, terrain=terrain)
        self._file = Database(self._path, power=self._power)
        self._seals = {self._file.seal(): loaded.saved}
        return loaded

    def _copied_world(self) -> Copy | None:
        """Returns a copy of the world for a checkpoint; None if that failed, which is counted and tried again."""
        try:
            return Copy(self.world, msgpack.packb(self._keep()))
        except Exception:
            self._checkpoint_failed()
            return None

    def _checkpoint_failed(self) -> None:
        """Counts a checkpoint that failed by an exception of ours, and schedules another attempt."""
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
        """Writes the records that have come, and packs one piece of the checkpoint that is being made."""
        with self._wake:
            if self._copy is None:
                self._wake.wait_for(lambda: self._urgent or self._gap or bool(self._records))
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
                if self.trouble:  # the checkpoint was to end a gap; without it the log must not go on
                    raise
                with self._wake:
                    self._checkpoint_failed()
                    self._copy = None if self._copy is copy else self._copy

    def _append(self, file: Database, records: list[tuple[int, bytes, float]], tick: int) -> int:
        """Writes records to disk in one transaction. Returns the chain after the record of a tick.

        Args:
            file: the database.
            records: tick, record, and the time in seconds at which its step ended (0: quiet).
            tick: the tick whose chain is wanted; -1: none.
        """
        chain = there = self._chain
        rows = []
        for at, record, _ in records:
            chain = chained(record, chain)
            there = chain if at <= tick else there
            rows.append(Record(at, record, chain))
        if rows:
            with self._owning():
                file.append(rows)
            self._chain, self._written = chain, rows[-1].tick
            now = time.monotonic()
            self._log_bytes += sum(len(record) for _, record, _ in records)
            for began in (began for _, _, began in records if began):
                self.commit_s.record(now - began)
        self._copy_due = self._copy_due or self._log_bytes > LOG_BYTES_MAX
        return there

    def _save(self, file: Database, copy: Copy, checkpoint: Checkpoint, chain: int) -> None:
        """Writes a checkpoint to disk. That ends a gap before it."""
        self._seals[seal := seal_of(checkpoint, self._rules, chain)] = copy.saved
        with self._owning():
            file.save(checkpoint, self._rules, chain, self._game)
        self._saved, self._seals = copy.saved, {seal: copy.saved}
        self._written = max(self._written, copy.tick)
        self._log_bytes = 0
        self.checkpoint_s.record(time.monotonic() - self._began)
        with self._wake:
            if self._copy is copy:
                self._copy = None
            if self.trouble and not self._gap:
                logger.warning("saving again, from tick %d on", copy.tick)
                self.trouble = ""

    def _reopen(self) -> None:
        """Reopens the file after a gap and saves a new checkpoint. `_write_on` then writes the records after it."""
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
            seal = file.seal()  # a transaction that raised may have been committed nevertheless
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
        """Handles a failure of the file: closes it, begins a gap, and doubles the time until the next attempt."""
        self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
        if self._file is not None:
            self._file.close()
            self._file = None
        with self._wake:
            self._drop(reason)

    def _drop(self, reason: str) -> None:
        """Begins a gap, or goes on with it. The caller holds the lock."""
        if not self.trouble:
            logger.error("cannot save: %s; commands are refused until it works again", reason)
        self.trouble, self._gap = reason, True
        self._wake.notify()
        if not self._closing or self._copy is self._copying:  # otherwise it is the last copy, which has not been tried
            self._copy = None
        self._records.clear()
