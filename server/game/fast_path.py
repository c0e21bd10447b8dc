"""The fast path: serves all sessions that have nothing special to do at once, in compiled code.

Theory of operation. Nearly always, a session does the same in every tick: an input message or two arrives, one input is
taken, and the newest snapshot is sent. Python takes some 15 us for that. The code that does it (`Front.receive`,
`InputQueue`, `Sender.serve`) is the specification, and runs for every session that does anything else. A session that
has needed nothing else for some ticks comes to the fast path: its state moves to a row of arrays. From then on

    its input messages only wait in a list when they arrive (`fast_arrivals`), those from a WebSocket still in their
    frames. Before the next tick, compiled code takes those of all sessions at once, with the times of their arrival;
    compiled code takes its input of a tick (`take`), measures its connection, and writes its snapshot, which Python
    sends (`send`).

The compiled code (`shared.traffic`, `pacing`, `delivery`) does exactly what the specification does, or nothing.
Whatever it does not handle takes the session off the fast path: another message, an input out of order, a verdict, an
event, another segment, a connection without room. Then the state moves back (`recall`), and the specification goes on
with it. Reading `Session.stream`, or the input queue, the verdicts or the events of a player, recalls the session as
well. So no other code can see old state, and none has to know about rows. A session that was recalled soon after it
came waits longer before it comes again.

Clients cannot tell the difference: tests compare every byte that is sent (`tests/server/test_fast_path.py`).
"""

from collections.abc import Callable, Mapping
from functools import partial

from server.config.limits import Limits
from server.game.clocks import Clocks
from server.game.connections import Connections
from server.game.fast_arrivals import Arrivals
from server.game.fast_rows import Arguments, Rows, fits
from server.game.session import Session
from server.observability.counters import Counters
from server.players.input_queue import InputQueue
from server.players.player import Player
from server.replication import flow_control
from server.replication.change_log import ChangeLog
from server.replication.sender import SNAPSHOT_BYTES
from shared.bounds import bounds
from shared.checks import Cell
from shared.delivery import HEADER_BYTES, UNWRITTEN
from shared.inputs import Input
from shared.kernels import Kernel
from shared.session_rows import ODD, SENT_BYTES, STATE, WIDTH
from shared.world import World

PATIENCE, PATIENCE_MAX, SOON = 3, 96, 12
"""Ticks without anything special after which a session comes to the fast path, at first and at most. If it is recalled
sooner than `SOON` ticks later, it waits twice as long before it comes again."""
OUT_BYTES, SEGMENTS_MIN = 2048, 32
"""Initial sizes: bytes of the buffer for snapshots, number of segments."""


class FastPath:
    """The fast path of one game.

    Args:
        world: the world.
        log: the changes of the world.
        limits: the limits.
        counters: where snapshots and bytes are counted.
        clocks: the time of the tick, and the allowances of messages.
        players: the players by entity.
        connections: counts the sessions here, and ends a connection that fails.
        receive: takes a message of a session that is not on the fast path: session, message, time of arrival.
        kernel: the kernel to use.
        newest: returns the latest tick whose inputs were taken; None: that of the world.
        unrecorded: maximum number of ticks that this may be ahead of the world, at an edge; 0: this is none.
    """

    def __init__(
        self,
        world: World,
        log: ChangeLog,
        limits: Limits,
        counters: Counters,
        clocks: Clocks,
        players: Mapping[int, Player],
        connections: Connections,
        receive: Callable[[Session, bytes, float], None],
        kernel: Kernel,
        newest: Callable[[], int] | None = None,
        unrecorded: int = 0,
    ) -> None:
        scene, rate = world.scene, world.scene.tick_rate
        self._world, self._log, self._limits, self._counters = world, log, limits, counters
        self._clocks, self._kernel = clocks, kernel
        self._players, self._connections = players, connections
        self._newest, self._confirmed = newest or (lambda: world.tick), -1
        self._rows = Rows(scene, kernel, unrecorded)
        self.arrivals = Arrivals(scene, self._newest, self._rows, limits, clocks, self.recall, receive, kernel)
        """Messages that wait for the next tick."""
        self._repeats = bounds(rate).repeats
        self._numbers: dict[Cell, int] = {}
        """Number of each segment that a session here sees."""
        self._seen: list[tuple[Cell, int]] = []
        """Segments with the number of sessions here that see them, by their own numbers."""
        self._free: list[int] = []
        """Numbers of no segment."""
        self._starts, self._lengths = Arguments(kernel, "q", SEGMENTS_MIN), Arguments(kernel, "q", SEGMENTS_MIN)
        self._changed: list[int] = []
        """Numbers of the segments that have a length."""
        self._out = Arguments(kernel, "B", OUT_BYTES)
        decay, flow = min(1 / rate / flow_control.HELD_S, 1.0), flow_control
        self._rules = Arguments(kernel, "q", 5)
        self._writing = Arguments(kernel, "d", values=(0.0, clocks.burst, limits.messages_per_tick, decay))
        self._asking = Arguments(kernel, "d", values=(0.0, limits.silence_s, flow.NARROW, flow.RTT_WINDOW_S))
        spans = flow.SAMPLE_S, flow.RATE_SPAN_S, flow.RATE_WINDOW_S
        self._measuring = Arguments(kernel, "d", values=(0.0, *spans, flow.STALL_RTTS, flow.HOLD_S_MAX, 1 / rate))
        self._shared = 0
        """Version of the shared values that all sessions here have been sent."""

    # -- the tick ------------------------------------------------------------------------------------------

    def take(self, tick: int, *, everyone: bool) -> dict[int, Input]:
        """Takes the input of each session for a tick.

        Args:
            tick: the tick.
            everyone: whether to return the inputs of all sessions, and not only those that differ from the tick before.

        Returns:
            The inputs by entity.
        """
        rows = self._rows
        if not self._connections.fast:
            return {}
        n = self._kernel.take_inputs(
            rows.numbers_lent,
            rows.ring_lent,
            rows.taken_lent,
            rows.changed_lent,
            rows.unrecorded_lent,
            tick,
            self._repeats,
            rows.slots,
            rows.most,
        )
        if everyone:
            return rows.taken_by(range(len(rows.sessions)))
        return rows.taken_by(rows.changed[:n].tolist()) if n else {}

    def confirm(self, tick: int) -> None:
        """Files the statuses of a tick at an edge, whose record has the inputs that were taken for it."""
        self._confirmed = tick
        if self._connections.fast:
            rows = self._rows
            self._kernel.confirm_inputs(rows.numbers_lent, rows.unrecorded_lent, tick, rows.most)

    def coming(self, row: int, tick: int) -> Input:
        """Returns the input of a row that would be taken for a tick now, like `InputQueue.coming`."""
        self.arrivals.flush()
        return self._rows.coming(row, tick, self._repeats)

    def send(self, shared: int, now: float) -> None:
        """Sends the newest snapshot to each session here. Recalls those for which it cannot be done here.

        Args:
            shared: version of the shared values.
            now: the current time in seconds.
        """
        if not self._connections.fast:
            return
        if shared != self._shared:
            self.recall_all()
            return
        for entity in self._log.moved:
            if entity in self._players:
                self._players[entity].recall()
        self._measure(now)
        for session in self._write(now):
            self.recall(session)

    def _measure(self, now: float) -> None:
        """Measures the connections whose time has come, or looks at them, as `FlowControl.window` does."""
        rows = self._rows
        self._asking.values[0] = self._measuring.values[0] = now
        n = self._kernel.due_rows(rows.numbers_lent, rows.floats_lent, rows.due_lent, self._asking.lent)
        if not n:
            return
        for i, row in enumerate(rows.due[:n].tolist()):
            session = rows.sessions[row if row >= 0 else -1 - row]
            assert session is not None
            rows.told[i] = self._outstanding(session)
        self._kernel.measure_rows(
            rows.numbers_lent, rows.floats_lent, rows.due_lent, rows.told_lent, n, self._measuring.lent
        )

    def _outstanding(self, session: Session) -> int:
        """Returns the bytes on the way to a session. If they are not known, it is left to the specification."""
        try:
            told = session.link.outstanding()
        except Exception:
            self._connections.fail(session, "serving a client")
            return 0
        if told is None:
            session.flow.blind, self._rows.numbers[session.row * WIDTH + STATE] = True, ODD
        return told or 0

    def _write(self, now: float) -> list[Session]:
        """Writes the snapshots, and sends them. Returns the sessions for which it was not done."""
        rows, n, rules = self._rows, len(self._rows.sessions), self._rules
        parts = self._parts()
        if len(self._out.values) < HEADER_BYTES + len(parts):
            self._out = Arguments(self._kernel, "B", 2 * (HEADER_BYTES + len(parts)))
        at, left = 0, list[Session]()
        while at < n:
            rules.values[0], rules.values[1], rules.values[2] = at, self._world.tick, SNAPSHOT_BYTES
            self._writing.values[0] = now
            end = self._kernel.write_snapshots(
                rows.numbers_lent,
                rows.floats_lent,
                rows.views_lent,
                self._starts.lent,
                self._lengths.lent,
                parts,
                self._out.lent,
                rows.spans_lent,
                rules.lent,
                self._writing.lent,
            )
            left += self._pass_on(at, rows.spans[2 * at : 2 * end].tolist())
            self._counters.snapshots_sent += rules.values[3]
            self._counters.snapshot_bytes += rules.values[4]
            if end < n:
                self._out = Arguments(self._kernel, "B", 2 * len(self._out.values))
            at = end
        return left

    def _pass_on(self, row: int, spans: list[int]) -> list[Session]:
        """Passes the messages of consecutive rows to their connections. Returns the sessions without one."""
        data, starts = bytes(self._out.values[: max(spans, default=0)]), spans[::2]
        sessions, outlets = self._rows.sessions[row:], self._rows.outlets[row:]
        for start, end, session, outlet in zip(starts, spans[1::2], sessions, outlets, strict=False):
            if start >= 0:
                try:
                    outlet(data[start:end])
                except Exception:
                    assert session is not None
                    self._connections.fail(session, "serving a client")
        if UNWRITTEN not in starts:
            return []
        return [s for s, start in zip(sessions, starts, strict=False) if s is not None and start == UNWRITTEN]

    def _parts(self) -> bytes:
        """Returns the deltas of all segments that are seen here and have changed."""
        starts, lengths = self._starts.values, self._lengths.values
        for latest in self._changed:
            lengths[latest] = 0
        self._changed.clear()
        if self._log.quiet:
            return b""
        deltas, parts, at = self._log.since(self._world.tick - 1), [], 0
        for segment in deltas.changed:
            number = self._numbers.get(segment)
            if number is not None and (part := deltas[segment]):
                parts.append(part)
                self._changed.append(number)
                starts[number], lengths[number] = at, len(part)
                at += len(part)
        return b"".join(parts)

    # -- coming and going ----------------------------------------------------------------------------------

    def consider(self, session: Session, shared: int) -> None:
        """Takes a session that was just served by the specification, if it has needed nothing special for long enough.

        Args:
            session: the session.
            shared: version of the shared values.
        """
        session.plain += 1
        if session.plain < max(session.patience, PATIENCE):
            return
        tick = self._world.tick
        if not fits(session, tick, self._newest(), self._rows.slots):
            session.plain = 0
            return
        if not self._connections.fast:
            self._shared = shared
        elif shared != self._shared:
            return
        segments = session.stream.view.plain
        assert segments is not None
        queue = session.inputs
        self._rows.write(session, [self._see(segment) for segment in segments])
        queue.settle = partial(self.count, session.row, queue)
        session.fast_path, session.enrolled, session.plain = self, tick, 0
        if session.framed is not None:
            session.framed.inlet = partial(self.arrivals.post_frame, session.row)
        self._connections.enrol(session)

    def _see(self, segment: Cell) -> int:
        """Notes that one more session sees a segment. Returns the segment's number."""
        number = self._numbers.get(segment)
        if number is not None:
            self._seen[number] = segment, self._seen[number][1] + 1
            return number
        if self._free:
            number = self._free.pop()
            self._seen[number] = segment, 1
        else:
            number = len(self._seen)
            self._seen.append((segment, 1))
            if number >= len(self._starts.values):
                self._starts, self._lengths = (
                    Arguments(self._kernel, "q", 2 * number, old.values) for old in (self._starts, self._lengths)
                )
        self._numbers[segment] = number
        return number

    def _leave(self, number: int) -> None:
        """Notes that one session less sees a segment."""
        segment, n = self._seen[number]
        self._seen[number] = segment, n - 1
        if n == 1:
            del self._numbers[segment]
            self._free.append(number)

    def recall(self, session: Session) -> None:
        """Takes a session off the fast path: its state is where the specification expects it again."""
        self.arrivals.flush()
        if session.row < 0:  # it was recalled because of one of its messages
            return
        if session.framed is not None:
            session.framed.inlet = None
        for number in self._rows.restore(session, self._newest(), self._confirmed):
            self._leave(number)
        soon = self._world.tick - session.enrolled < SOON
        session.patience = min(2 * max(session.patience, PATIENCE), PATIENCE_MAX) if soon else PATIENCE
        session.plain = 0
        self._connections.withdraw(session)

    def recall_all(self) -> None:
        """Takes all sessions off the fast path."""
        for session in tuple(self._rows.sessions):
            if session is not None:
                session.recall()

    def sent(self, row: int, size: int) -> None:
        """Notes that a message besides the snapshots was sent to a session here."""
        self._rows.numbers[row * WIDTH + SENT_BYTES] += size

    def count(self, row: int, queue: InputQueue) -> None:
        """Completes the counts of an input queue whose player's session is here."""
        self.arrivals.flush()
        settle, queue.settle = queue.settle, None
        if settle is not None:  # the session is still here
            self._rows.count(row, queue)
            queue.settle = settle
