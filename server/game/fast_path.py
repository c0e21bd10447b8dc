"""The fast path: serves all sessions that have nothing special to do at once, in compiled code.

Theory of operation. Nearly always, a session does the same in every tick: an input message or two arrives, one input is
taken, and the newest snapshot is sent. Python takes some 15 us for that. The code that does it (`Front.receive`,
`InputQueue`, `Sender.serve`) is the specification, and runs for every session that does anything else. A session that
has needed nothing else for some ticks comes to the fast path: its state moves to a row of arrays. From then on

    its input messages only wait in a list when they arrive (`post`). Compiled code takes the messages of all sessions
    at once, before the next tick (`flush`), with the times at which they arrived;
    its input of a tick is taken by compiled code (`take`);
    its snapshot is written by compiled code (`send`); Python passes the bytes to its connection.

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

import numpy as np

from server.config.limits import Limits, catch_up_ticks
from server.game.clocks import Clocks
from server.game.connections import Connections
from server.game.fast_rows import Rows, fits
from server.game.session import Session
from server.observability.counters import Counters
from server.players.player import Player
from server.replication.change_log import ChangeLog
from server.replication.flow_control import HELD_S
from server.replication.sender import SNAPSHOT_BYTES as SNAPSHOT_BYTES_MAX
from shared.bounds import bounds
from shared.checks import Cell
from shared.inputs import Input
from shared.kernels import Kernel
from shared.messages import Inputs, Ping, head_of
from shared.traffic import (
    ALLOWANCE,
    ANSWERED,
    CARRIES,
    DONE,
    FLOATS,
    HEADER_BYTES,
    HELD_SHARE,
    LEFT,
    MEASURE_AT,
    ODD,
    PLAIN,
    PROBE_AT,
    PROBE_BYTES,
    RECEIVED_AT,
    SENT_BYTES,
    SNAPSHOT_BYTES,
    STATE,
    TAKEN_BYTES,
    UNWRITTEN,
    WIDTH,
)
from shared.world import World

PATIENCE, PATIENCE_MAX = 3, 96
"""Ticks without anything special after which a session comes to the fast path, at first and at most."""
SOON = 12
"""Ticks. A session that is recalled sooner after it came waits twice as long before it comes again."""
WAITING_MAX = 4096
"""Maximum number of messages that wait for the next tick."""
OUT_BYTES, SEGMENTS_MIN = 1 << 16, 64
"""Initial sizes: bytes of the buffer for snapshots, number of segments."""
INPUTS, PING = head_of(Inputs), head_of(Ping)
"""First two bytes of the messages that do not take a session off the fast path."""
assert DONE < ANSWERED < LEFT


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
        """Number of each segment that a session on the fast path has seen."""
        self._used: list[int] = []
        """Number of sessions that see a segment, by its number."""
        self._starts, self._lengths = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._out = np.zeros(OUT_BYTES, np.uint8)
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
        lent, fates = self._kernel.lent, bytearray(len(data))
        rules = (self._world.tick, self._bounds.ahead, self._row_bytes, self._limits.input_rows_max, rows.slots)
        deadline = self._clocks.deadline
        clock = (deadline, self._rate, self._catch_up, self._bounds.margin_one, self._clocks.burst)
        self._kernel.take_messages(
            rows.numbers_lent,
            rows.floats_lent,
            rows.ring_lent,
            b"".join(data),
            lent(np.frombuffer(spans, np.int64)),
            lent(np.frombuffer(times, np.float64)),
            lent(np.frombuffer(fates, np.uint8)),
            lent(np.array(rules, np.int64)),
            lent(np.array(clock, np.float64)),
        )
        if not any(fates):
            return
        sessions = rows.sessions.copy()
        for i, fate in enumerate(fates):
            session = sessions[spans[2 * i]]
            if fate == DONE or session is None:
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
        silent = now - self._rows.floats_array[RECEIVED_AT::FLOATS] > self._limits.silence_s
        self._rows.numbers_array[STATE::WIDTH][silent & (self._rows.numbers_array[STATE::WIDTH] == PLAIN)] = ODD
        self._measure(now)
        self._write(now)
        for row in np.flatnonzero(self._rows.numbers_array[STATE::WIDTH] == ODD).tolist():
            odd = self._rows.sessions[row]
            if odd is not None:
                self.recall(odd)

    def _measure(self, now: float) -> None:
        """Measures the connections whose time has come, or looks at them, as `FlowControl.window` does."""
        rows = self._rows
        numbers, base = rows.numbers_array, rows.numbers
        latest, on_way = numbers[SNAPSHOT_BYTES::WIDTH], numbers[SENT_BYTES::WIDTH] - numbers[TAKEN_BYTES::WIDTH]
        due = rows.floats_array[MEASURE_AT::FLOATS] <= now
        full = on_way + latest > np.maximum(numbers[CARRIES::WIDTH], 2 * latest)
        for row in np.flatnonzero((due | full) & (numbers[STATE::WIDTH] == PLAIN)).tolist():
            session = rows.sessions[row]
            assert session is not None
            flow, at = session.flow, row * WIDTH
            flow.sent_bytes = base[at + SENT_BYTES]
            if due[row]:
                flow.held_share = rows.floats[row * FLOATS + HELD_SHARE]
                flow.measure(self._tick_s, now)
                base[at + CARRIES] = flow.carries
                rows.floats[row * FLOATS + MEASURE_AT] = flow.measure_at
                if not flow.steady:
                    base[at + STATE] = ODD
            else:
                flow.look()
            base[at + TAKEN_BYTES] = flow.taken

    def _write(self, now: float) -> None:
        """Writes the snapshots, and sends them."""
        rows, tick, lent = self._rows, self._world.tick, self._kernel.lent
        parts, longest = self._parts()
        if len(self._out) < HEADER_BYTES + longest:
            self._out = np.zeros(2 * (HEADER_BYTES + longest), np.uint8)
        view, n = self._out.data, len(rows.sessions)
        clock = (now, self._clocks.burst, self._limits.messages_per_tick, self._decay)
        at = 0
        while at < n:
            end = self._kernel.write_snapshots(
                rows.numbers_lent,
                rows.floats_lent,
                rows.views_lent,
                lent(self._starts),
                lent(self._lengths),
                parts,
                lent(self._out),
                rows.spans_lent,
                lent(np.array((at, tick, SNAPSHOT_BYTES_MAX), np.int64)),
                lent(np.array(clock, np.float64)),
            )
            spans = rows.spans_array[2 * at : 2 * end].tolist()
            data = bytes(view[: max(spans, default=0)])
            self._pass_on(at, spans, data)
            at = end

    def _pass_on(self, row: int, spans: list[int], data: bytes) -> None:
        """Passes the messages of consecutive rows to their connections."""
        sessions, sent, size = self._rows.sessions, 0, 0
        for start, end, session in zip(spans[::2], spans[1::2], sessions[row : row + len(spans) // 2], strict=True):
            if start == UNWRITTEN or session is None:
                continue
            sent += 1
            size += end - start
            try:
                session.link.send(data[start:end])
            except Exception:
                self._connections.fail(session, "serving a client")
        self._counters.snapshots_sent += sent
        self._counters.snapshot_bytes += size

    def _parts(self) -> tuple[bytes, int]:
        """Returns the deltas of all segments that are seen here and have changed, and their size."""
        self._lengths[:] = 0
        deltas, parts, at = self._log.since(self._world.tick - 1), [], 0
        for segment in deltas.changed:
            number = self._numbers.get(segment)
            if number is not None and self._used[number] and (part := deltas[segment]):
                parts.append(part)
                self._starts[number], self._lengths[number] = at, len(part)
                at += len(part)
        return b"".join(parts), at

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
        if not fits(session, tick):
            session.plain = 0
            return
        if self._n == 0:
            self._shared = shared
        elif shared != self._shared:
            return
        segments = session.stream.view.plain
        assert segments is not None
        numbers = [self._number(segment) for segment in segments]
        for number in numbers:
            self._used[number] += 1
        self._rows.write(session, numbers)
        session.fast_path, session.enrolled, session.plain = self, tick, 0
        self._n += 1

    def _number(self, segment: Cell) -> int:
        """Returns the number of a segment."""
        number = self._numbers.get(segment)
        if number is None:
            number = self._numbers[segment] = len(self._used)
            self._used.append(0)
            if number >= len(self._starts):
                more = np.zeros(max(len(self._starts), SEGMENTS_MIN), np.int64)
                self._starts, self._lengths = (np.concatenate((old, more)) for old in (self._starts, self._lengths))
        return number

    def recall(self, session: Session) -> None:
        """Takes a session off the fast path: its state is where the specification expects it again."""
        self.flush()
        if session.row < 0:  # it was recalled because of one of its messages
            return
        for number in self._rows.restore(session, self._world.tick):
            self._used[number] -= 1
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

    def count(self) -> None:
        """Completes the counts of the players' input queues."""
        self.flush()
        self._rows.count()
