"""The fast path: serves all sessions that have nothing special to do at once, in compiled code.

Theory of operation. Nearly always, a session does the same in every tick: an input message or two arrives, one input is
taken, and the newest snapshot is sent. Python takes some 15 us for that. The code that does it (`Front.receive`,
`InputQueue`, `Sender.serve`) is the specification, and runs for every session that does anything else. A session that
has needed nothing else for some ticks comes to the fast path: its state moves to a row of arrays. From then on

    its input messages only wait in a list when they arrive (`post`). Before the next tick, compiled code takes those of
    all sessions at once, with the times at which they arrived (`flush`);
    compiled code takes its input of a tick (`take`), and writes its snapshot, which Python sends (`send`).

The compiled code (`shared.traffic`) does exactly what the specification does, or nothing. Whatever it does not handle
takes the session off the fast path: another message, an input out of order, a verdict, an event, another segment, a
connection without room. Then the state moves back (`recall`), and the specification goes on with it. Reading
`Session.stream`, or the input queue, the verdicts or the events of a player, recalls the session as well. So no other
code can see old state, and none has to know about rows. A session that was recalled soon after it came waits longer
before it comes again.

Clients cannot tell the difference: tests compare every byte that is sent (`tests/server/test_fast_path.py`).
"""

from array import array
from collections.abc import Callable, Mapping
from functools import partial

from server.config.limits import Limits, catch_up_ticks
from server.game.clocks import Clocks
from server.game.connections import Connections
from server.game.fast_rows import Arguments, Rows, fits, lent
from server.game.session import Session
from server.observability.counters import Counters
from server.players.input_queue import InputQueue
from server.players.player import Player
from server.replication.change_log import ChangeLog
from server.replication.flow_control import HELD_S
from server.replication.sender import SNAPSHOT_BYTES
from shared.bounds import bounds
from shared.checks import Cell
from shared.inputs import Input
from shared.kernels import Kernel
from shared.messages import Inputs, Ping, head_of
from shared.traffic import (
    ALLOWANCE,
    ANSWERED,
    CARRIES,
    FLOATS,
    HEADER_BYTES,
    HELD_SHARE,
    LEFT,
    MEASURE_AT,
    ODD,
    PROBE_AT,
    PROBE_BYTES,
    RECEIVED_AT,
    SENT_BYTES,
    STATE,
    TAKEN_BYTES,
    UNUSED,
    UNWRITTEN,
    WIDTH,
)
from shared.world import World

PATIENCE, PATIENCE_MAX, SOON = 3, 96, 12
"""Ticks without anything special after which a session comes to the fast path, at first and at most. If it is recalled
sooner than `SOON` ticks later, it waits twice as long before it comes again."""
WAITING_MAX = 4096
"""Maximum number of messages that wait for the next tick."""
OUT_BYTES, SEGMENTS_MIN = 2048, 32
"""Initial sizes: bytes of the buffer for snapshots, number of segments."""
INPUTS, PING = head_of(Inputs), head_of(Ping)
"""First two bytes of the messages that do not take a session off the fast path."""


class FastPath:
    """The fast path of one game.

    Args:
        world: the world.
        log: the changes of the world.
        limits: the limits.
        counters: where snapshots and bytes are counted.
        clocks: the time of the tick, and the allowances of messages.
        players: the players by entity.
        connections: ends a connection that fails.
        receive: takes a message of a session that is not on the fast path: session, message, time of arrival.
        kernel: the kernel to use.
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
    ) -> None:
        scene, rate = world.scene, world.scene.tick_rate
        self._world, self._log, self._limits, self._counters = world, log, limits, counters
        self._clocks, self._receive, self._kernel = clocks, receive, kernel
        self._players, self._connections = players, connections
        self._rows = Rows(scene, kernel)
        self._bounds, self._tick_s = bounds(rate), 1 / rate
        self._decay = min(self._tick_s / HELD_S, 1.0)
        self._catch_up, self._rate = catch_up_ticks(rate), rate
        self._row_bytes = scene.input_row_bytes
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
        self._rules, self._clock = Arguments(kernel, "q", 5), Arguments(kernel, "d", 5)
        self._shared = 0
        """Version of the shared values that all sessions here have been sent."""
        self._n = 0
        """Number of sessions here."""
        self._renew()

    def _renew(self) -> None:
        """Empties the list of waiting messages."""
        self._data: list[bytes] = []
        self._spans, self._times = array("q"), array("d")

    # -- messages that arrive ------------------------------------------------------------------------------

    def post(self, session: Session, data: bytes, now: float) -> bool:
        """Handles a message of a session on the fast path. Returns False if it was recalled instead."""
        head, row = data[:2], session.row
        if head == INPUTS and len(data) <= self._limits.message_bytes_max:
            self._data.append(data)
            self._spans.extend((row, len(data)))
            self._times.append(now)
            if len(self._data) >= WAITING_MAX:
                self.flush()
            return True
        if head == PING and self._rows.floats[row * FLOATS + ALLOWANCE] - 1 >= -self._clocks.burst:
            self._rows.floats[row * FLOATS + RECEIVED_AT] = now
            self._rows.floats[row * FLOATS + ALLOWANCE] -= 1
        else:
            self.recall(session)
        return False

    def flush(self) -> None:
        """Takes all messages that have arrived. Call it before a tick."""
        if not self._data:
            return
        data, spans, times, rows = self._data, self._spans, self._times, self._rows
        self._renew()
        fates, rules, clock = bytearray(len(data)), self._rules, self._clock
        rules.values[0], rules.values[1], rules.values[2] = (
            self._world.tick,
            min(self._bounds.ahead, rows.slots),
            self._row_bytes,
        )
        rules.values[3], rules.values[4] = self._limits.input_rows_max, rows.slots
        clock.values[0], clock.values[1], clock.values[2] = self._clocks.deadline, self._rate, self._catch_up
        clock.values[3], clock.values[4] = self._bounds.margin_one, self._clocks.burst
        self._kernel.take_messages(
            rows.numbers_lent,
            rows.floats_lent,
            rows.ring_lent,
            b"".join(data),
            lent(self._kernel, spans, "q"),
            lent(self._kernel, times, "d"),
            lent(self._kernel, fates, "B"),
            rules.lent,
            clock.lent,
        )
        if not any(fates):
            return
        sessions = rows.sessions.copy()
        for i, fate in enumerate(fates):
            session = sessions[spans[2 * i]]
            if session is None:
                continue
            if fate == ANSWERED and session.row >= 0:
                sent_at = rows.floats[session.row * FLOATS + PROBE_AT]
                size = rows.numbers[session.row * WIDTH + PROBE_BYTES]
                session.flow.answered(times[i] - sent_at, size, times[i])
            elif fate == LEFT:
                self.recall(session)
                self._receive(session, data[i], times[i])

    # -- the tick ------------------------------------------------------------------------------------------

    def take(self, tick: int) -> list[Input]:
        """Takes the input of each session for a tick. Returns them by row."""
        rows = self._rows
        if not self._n:
            return []
        self._kernel.take_inputs(
            rows.numbers_lent, rows.ring_lent, rows.taken_lent, tick, self._bounds.repeats, rows.slots
        )
        return rows.inputs()

    def coming(self, row: int, tick: int) -> Input:
        """Returns the input of a row that would be taken for a tick now, like `InputQueue.coming`."""
        self.flush()
        return self._rows.coming(row, tick, self._bounds.repeats)

    def send(self, shared: int, now: float) -> None:
        """Sends the newest snapshot to each session here. Recalls those for which it cannot be done here.

        Args:
            shared: version of the shared values.
            now: the current time in seconds.
        """
        if not self._n:
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
        numbers, floats = rows.numbers, rows.floats
        self._clock.values[0], self._clock.values[1] = now, self._limits.silence_s
        n = self._kernel.due_rows(rows.numbers_lent, rows.floats_lent, rows.due_lent, self._clock.lent)
        for row in rows.due[:n].tolist():
            at, measures = (row, True) if row >= 0 else (-1 - row, False)
            session, base = rows.sessions[at], at * WIDTH
            assert session is not None
            flow = session.flow
            flow.sent_bytes = numbers[base + SENT_BYTES]
            if measures:
                flow.held_share = floats[at * FLOATS + HELD_SHARE]
                flow.measure(self._tick_s, now)
                numbers[base + CARRIES], floats[at * FLOATS + MEASURE_AT] = flow.carries, flow.measure_at
                if not flow.steady:
                    numbers[base + STATE] = ODD
            else:
                flow.look()
            numbers[base + TAKEN_BYTES] = flow.taken

    def _write(self, now: float) -> list[Session]:
        """Writes the snapshots, and sends them. Returns the sessions for which it was not done."""
        rows, n, rules, clock = self._rows, len(self._rows.sessions), self._rules, self._clock
        parts = self._parts()
        if len(self._out.values) < HEADER_BYTES + len(parts):
            self._out = Arguments(self._kernel, "B", 2 * (HEADER_BYTES + len(parts)))
        at, left = 0, list[Session]()
        while at < n:
            rules.values[0], rules.values[1], rules.values[2] = at, self._world.tick, SNAPSHOT_BYTES
            clock.values[0], clock.values[1] = now, self._clocks.burst
            clock.values[2], clock.values[3] = self._limits.messages_per_tick, self._decay
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
                clock.lent,
            )
            left += self._pass_on(at, rows.spans[2 * at : 2 * end].tolist())
            if end < n:
                self._out = Arguments(self._kernel, "B", 2 * len(self._out.values))
            at = end
        return left

    def _pass_on(self, row: int, spans: list[int]) -> list[Session]:
        """Passes the messages of consecutive rows to their connections. Returns the sessions without one."""
        data = bytes(self._out.values[: max(spans, default=0)])
        sent, size, left = 0, 0, []
        for start, end, session in zip(spans[::2], spans[1::2], self._rows.sessions[row:], strict=False):
            if session is None or session.row < 0 or start == UNUSED:
                continue
            if start == UNWRITTEN:
                left.append(session)
                continue
            sent += 1
            size += end - start
            try:
                session.link.send(data[start:end])
            except Exception:
                self._connections.fail(session, "serving a client")
        self._counters.snapshots_sent += sent
        self._counters.snapshot_bytes += size
        return left

    def _parts(self) -> bytes:
        """Returns the deltas of all segments that are seen here and have changed."""
        starts, lengths = self._starts.values, self._lengths.values
        for latest in self._changed:
            lengths[latest] = 0
        self._changed.clear()
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
        if not fits(session, tick, self._rows.slots):
            session.plain = 0
            return
        if self._n == 0:
            self._shared = shared
        elif shared != self._shared:
            return
        segments = session.stream.view.plain
        assert segments is not None
        queue = session.inputs
        self._rows.write(session, [self._see(segment) for segment in segments])
        queue.settle = partial(self.count, session.row, queue)
        session.fast_path, session.enrolled, session.plain = self, tick, 0
        self._n += 1

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
        self.flush()
        if session.row < 0:  # it was recalled because of one of its messages
            return
        for number in self._rows.restore(session, self._world.tick):
            self._leave(number)
        soon = self._world.tick - session.enrolled < SOON
        session.patience = min(2 * max(session.patience, PATIENCE), PATIENCE_MAX) if soon else PATIENCE
        session.plain = 0
        self._n -= 1

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
        self.flush()
        settle, queue.settle = queue.settle, None
        if settle is not None:  # the session is still here
            self._rows.count(row, queue)
            queue.settle = settle
