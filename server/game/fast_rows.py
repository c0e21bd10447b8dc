"""The rows of the fast path: the state of sessions in arrays for compiled code (`shared.session_rows`)."""

import math
from array import array
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from server.game.session import Session
from server.players.input_queue import InputQueue, decoded
from server.replication.flow_control import FlowControl
from shared.bounds import in_ticks
from shared.inputs import ROW, Input, row
from shared.kernels import NUMBA, Kernel
from shared.messages import IDLE
from shared.scene import Scene
from shared.session_rows import (
    ACCEPTED,
    ACKED,
    ALLOWANCE,
    CARRIES,
    FLOATS,
    FRAMED,
    FREE,
    FULL_AT,
    HELD,
    HELD_AIM,
    HELD_SHARE,
    HELD_TO,
    KEPT,
    LATE,
    LEAST_RTT,
    MARGINS,
    MEASURE_AT,
    MISSING,
    N_MARGINS,
    N_RATES,
    N_SAMPLES,
    N_SEGMENTS,
    N_STATUSES,
    NEWEST,
    PLAIN,
    PROBE_AT,
    PROBE_BYTES,
    PROBE_TICK,
    RATE,
    RATE_AT,
    RATES,
    RECEIVED_AT,
    REFUSED,
    RTT,
    RTT_AT,
    SAMPLE_AT,
    SAMPLE_BYTES,
    SAMPLES,
    SEGMENTS,
    SENT_AT,
    SENT_BYTES,
    SLOT,
    SNAPSHOT_BYTES,
    STATE,
    STATUSES,
    SUBSTITUTED,
    TAKEN_BYTES,
    TICK,
    UNRECORDED,
    USED,
    WIDTH,
)

ROWS_MIN = 4
"""Number of rows at first. It grows by half when all are in use."""
WAITING_S, SLOTS_MIN = 0.5, 60
"""Seconds for which inputs can wait in a row, and the minimum in ticks. By themselves, clients are less far ahead. A
server that skips ticks falls behind them, until their next measurement of its time."""
INPUTS_KEPT = 4096
"""Maximum number of decoded inputs that are kept."""


def lent(kernel: Kernel, values: Any, kind: str) -> Any:
    """Returns a flat array with a buffer as a kernel takes it.

    Args:
        kernel: the kernel.
        values: the array.
        kind: kind of its elements, as in `array`.
    """
    return kernel.lent(np.frombuffer(values, kind)) if kernel.form == NUMBA else values


class Arguments:
    """A flat array for a kernel.

    Args:
        kernel: the kernel.
        kind: kind of its elements, as in `array`: "q", "d" or "B".
        length: number of its elements, at least.
        values: values for its beginning; the others are 0.
    """

    def __init__(self, kernel: Kernel, kind: str, length: int = 0, values: Iterable[Any] = ()) -> None:
        made = array(kind, values)
        made.frombytes(bytes(max(length - len(made), 0) * made.itemsize))
        self.values: Any = memoryview(made)  # of whole numbers or floats
        self.lent = lent(kernel, made, kind)


class Rows:
    """The rows of one game.

    Args:
        scene: the scene.
        kernel: the kernel that gets the arrays.
        unrecorded: maximum number of ticks whose records have not come, at an edge; 0: this is none.
    """

    def __init__(self, scene: Scene, kernel: Kernel, unrecorded: int = 0) -> None:
        self._kernel, self._aim, self.most = kernel, scene.aim, unrecorded
        self.slots = in_ticks(WAITING_S, scene.tick_rate, SLOTS_MIN)
        """Number of slots of a row's ring: for how many ticks ahead a row can have inputs."""
        self.sessions: list[Session | None] = []
        """Session of each row; None: the row is free."""
        self.outlets: list[Callable[[bytes], None]] = []
        """Function of each row that sends a snapshot."""
        self._inputs: dict[tuple[int, int], Input] = {}
        self._grow(ROWS_MIN)

    def _grow(self, n: int) -> None:
        """Makes room for `n` rows. Their contents stay."""
        old = len(self.sessions)
        self.sessions += [None] * (n - old)
        self.outlets += [_refuse] * (n - old)
        for name, width, kind in (
            ("numbers", WIDTH, "q"),
            ("floats", FLOATS, "d"),
            ("ring", self.slots * SLOT, "q"),
            ("views", SEGMENTS, "i"),
            ("taken", 2, "q"),
            ("spans", 2, "q"),
            ("due", 1, "q"),
            ("told", 1, "q"),
            ("changed", 1, "q"),
            ("unrecorded", self.most * UNRECORDED, "q"),
        ):
            grown = Arguments(self._kernel, kind, n * width, getattr(self, name) if old else ())
            setattr(self, name, grown.values)
            setattr(self, f"{name}_lent", grown.lent)

    numbers: Any
    floats: Any
    ring: Any
    views: Any
    taken: Any
    spans: Any
    due: Any
    told: Any
    changed: Any
    unrecorded: Any
    """Arrays of all rows; each has a form for the kernel (`numbers_lent`)."""
    numbers_lent: Any
    floats_lent: Any
    ring_lent: Any
    views_lent: Any
    taken_lent: Any
    spans_lent: Any
    due_lent: Any
    told_lent: Any
    changed_lent: Any
    unrecorded_lent: Any

    def write(self, session: Session, segments: list[int]) -> None:
        """Moves the state of a session to a free row.

        Args:
            session: the session.
            segments: numbers of the segments of its client view.
        """
        if None not in self.sessions:
            self._grow(len(self.sessions) * 3 // 2)
        at = self.sessions.index(None)
        self.sessions[at] = session
        queue, stream = session.inputs, session.stream
        flow, probe = stream.flow, stream.probe
        values = [0] * WIDTH
        values[STATE] = PLAIN
        values[NEWEST], values[ACCEPTED], values[MISSING] = queue.newest, queue.accepted, queue.missing
        values[HELD], values[HELD_AIM] = self._words(row(queue.held, aim=self._aim))
        values[N_MARGINS], values[N_STATUSES] = len(queue.margins), len(queue.statuses)
        values[HELD_TO] = queue.held_to
        values[MARGINS : MARGINS + len(queue.margins)] = queue.margins.tolist()
        values[STATUSES : STATUSES + len(queue.statuses)] = queue.statuses
        values[TICK], values[ACKED], values[SNAPSHOT_BYTES] = stream.tick, stream.acked, stream.snapshot_bytes
        values[SENT_BYTES], values[TAKEN_BYTES], values[CARRIES] = flow.sent_bytes, flow.taken, flow.carries
        values[PROBE_TICK], probe_at, values[PROBE_BYTES] = probe or (-1, 0.0, 0)
        values[N_SEGMENTS], values[FRAMED] = len(segments), session.framed is not None
        values[N_SAMPLES], values[N_RATES] = len(flow.samples), len(flow.rates)
        values[SAMPLE_BYTES : SAMPLE_BYTES + len(flow.samples)] = [taken for _, taken in flow.samples]
        self.numbers[at * WIDTH : (at + 1) * WIDTH] = array("q", values)
        reals = [0.0] * FLOATS
        reals[RECEIVED_AT], reals[ALLOWANCE], reals[SENT_AT] = session.received_at, session.allowance, stream.sent_at
        reals[MEASURE_AT], reals[HELD_SHARE], reals[PROBE_AT] = flow.measure_at, flow.held_share, probe_at
        reals[FULL_AT] = flow.full_at
        reals[SAMPLE_AT : SAMPLE_AT + len(flow.samples)] = [measured for measured, _ in flow.samples]
        reals[RATE_AT : RATE_AT + len(flow.rates)] = [measured for measured, _ in flow.rates]
        reals[RATE : RATE + len(flow.rates)] = [rate for _, rate in flow.rates]
        self.floats[at * FLOATS : (at + 1) * FLOATS] = array("d", reals)
        self.write_rtts(at, flow)
        self.views[at * SEGMENTS : at * SEGMENTS + len(segments)] = array("i", segments)
        start, end = at * self.slots * SLOT, (at + 1) * self.slots * SLOT
        self.ring[start:end] = array("q", [-1]) * (end - start)
        for tick, input_ in queue.waiting.items():
            slot = start + tick % self.slots * SLOT
            self.ring[slot : slot + SLOT] = array("q", (tick, *self._words(row(input_, aim=self._aim))))
        if queue.sent is None:
            self.taken[2 * at] = -1  # no input, so that the first one counts as changed
        else:
            self.taken[2 * at], self.taken[2 * at + 1] = self._words(row(queue.sent, aim=self._aim))
        for tick, (status, input_) in (queue.unrecorded or {}).items():
            slot = (at * self.most + tick % self.most) * UNRECORDED
            words = self._words(row(input_, aim=self._aim))
            self.unrecorded[slot : slot + UNRECORDED] = array("q", (status, *words))
        assert session.player is not None
        session.row = session.player.row = at
        self.outlets[at] = session.link.send if session.framed is None else session.framed.outlet()

    def write_rtts(self, at: int, flow: FlowControl) -> None:
        """Writes what a row has of the measured round trips."""
        base = at * FLOATS
        self.floats[base + LEAST_RTT] = flow.least_rtt_s
        self.floats[base + RTT_AT], self.floats[base + RTT] = flow.rtts[-1] if flow.rtts else (-math.inf, math.inf)

    def restore(self, session: Session, tick: int, confirmed: int) -> list[int]:
        """Moves the state of a session back, and frees its row. Returns the numbers of its segments.

        Args:
            session: the session.
            tick: the latest tick whose inputs were taken.
            confirmed: the latest tick whose record has come, at an edge.
        """
        at, session.row = session.row, -1
        assert session.player is not None
        session.player.row = -1
        self.sessions[at], self.outlets[at] = None, _refuse
        values = self.numbers[at * WIDTH : (at + 1) * WIDTH].tolist()
        self.numbers[at * WIDTH + STATE] = FREE
        reals = self.floats[at * FLOATS : (at + 1) * FLOATS].tolist()
        queue, stream = session.inputs, session.stream
        flow = stream.flow
        self.count(at, queue)
        queue.newest, queue.accepted, queue.missing = values[NEWEST], values[ACCEPTED], values[MISSING]
        queue.held_to = values[HELD_TO]
        queue.held = self.input_of(values[HELD], values[HELD_AIM])
        queue.margins = array("h", values[MARGINS : MARGINS + values[N_MARGINS]])
        queue.statuses = bytearray(values[STATUSES : STATUSES + values[N_STATUSES]])
        queue.waiting = {}
        for due in range(tick + 1, queue.accepted + 1):
            slot = (at * self.slots + due % self.slots) * SLOT
            if self.ring[slot] == due:
                queue.waiting[due] = self.input_of(self.ring[slot + 1], self.ring[slot + 2])
        if self.most:
            self._restore_unrecorded(at, queue, range(confirmed + 1, tick + 1))
        stream.tick = stream.view.tick = values[TICK]
        stream.acked, stream.snapshot_bytes = values[ACKED], values[SNAPSHOT_BYTES]
        if values[PROBE_TICK] >= 0:
            stream.probe = (values[PROBE_TICK], reals[PROBE_AT], values[PROBE_BYTES])
        else:
            stream.probe = None
        flow.sent_bytes, flow.taken, flow.carries = values[SENT_BYTES], values[TAKEN_BYTES], values[CARRIES]
        session.received_at, session.allowance, stream.sent_at = reals[RECEIVED_AT], reals[ALLOWANCE], reals[SENT_AT]
        flow.measure_at, flow.held_share = reals[MEASURE_AT], reals[HELD_SHARE]
        n = values[N_SAMPLES]
        flow.samples = list(zip(reals[SAMPLE_AT : SAMPLE_AT + n], values[SAMPLE_BYTES : SAMPLE_BYTES + n], strict=True))
        n = values[N_RATES]
        flow.rates = list(zip(reals[RATE_AT : RATE_AT + n], reals[RATE : RATE + n], strict=True))
        segments: list[int] = self.views[at * SEGMENTS : at * SEGMENTS + values[N_SEGMENTS]].tolist()
        return segments

    def _restore_unrecorded(self, at: int, queue: InputQueue, ticks: range) -> None:
        """Moves back what an input queue has at an edge alone.

        Args:
            at: the row.
            queue: the input queue.
            ticks: the ticks whose inputs were taken and whose records have not come.
        """
        sent = self.taken[2 * at]
        queue.sent = self.input_of(sent, self.taken[2 * at + 1]) if sent >= 0 else None
        queue.unrecorded = {}
        for tick in ticks:
            slot = (at * self.most + tick % self.most) * UNRECORDED
            status, head, aim = self.unrecorded[slot : slot + UNRECORDED].tolist()
            queue.unrecorded[tick] = status, self.input_of(head, aim)

    def count(self, at: int, queue: InputQueue) -> None:
        """Adds the counts of a row since it was written, or since the latest call, to an input queue."""
        queue.settle = None
        base = at * WIDTH
        queue.late += self.numbers[base + LATE]
        queue.used += self.numbers[base + USED]
        queue.substituted += self.numbers[base + SUBSTITUTED]
        queue.refused += self.numbers[base + REFUSED]
        for column in (LATE, USED, SUBSTITUTED, REFUSED):
            self.numbers[base + column] = 0

    def taken_by(self, rows: Iterable[int]) -> dict[int, Input]:
        """Returns the inputs that `traffic.take_inputs` has taken for these rows, by entity."""
        taken, sessions = self.taken, self.sessions
        return {
            session.entity: self.input_of(taken[2 * row], taken[2 * row + 1])
            for row in rows
            if (session := sessions[row]) is not None
        }

    def coming(self, at: int, tick: int, repeats: int) -> Input:
        """Returns the input of a row that would be taken for a tick now, like `InputQueue.coming`."""
        slot, base = (at * self.slots + tick % self.slots) * SLOT, at * WIDTH
        if self.ring[slot] == tick:
            return self.input_of(self.ring[slot + 1], self.ring[slot + 2])
        if tick > self.numbers[base + HELD_TO] and self.numbers[base + MISSING] + 1 > repeats:
            return self.input_of(0, 0)
        return self.input_of(self.numbers[base + HELD], self.numbers[base + HELD_AIM])

    def input_of(self, head: int, aim: int) -> Input:
        """Returns the input with these first three bytes and these six bytes of its aim."""
        input_ = self._inputs.get((head, aim))
        if input_ is None:
            if len(self._inputs) >= INPUTS_KEPT:
                self._inputs.clear()
            packed = head.to_bytes(ROW.size, "little") + (aim.to_bytes(6, "little") if self._aim else b"")
            input_ = self._inputs[head, aim] = decoded(packed)
        return input_

    @staticmethod
    def _words(packed: bytes) -> tuple[int, int]:
        return int.from_bytes(packed[: ROW.size], "little"), int.from_bytes(packed[ROW.size :], "little")


def _refuse(message: bytes) -> None:
    """Stands for the outlet of a free row."""
    raise AssertionError("a free row sends nothing")


def fits(session: Session, tick: int, newest: int, slots: int) -> bool:
    """Returns whether a row can hold the state of a session that was just sent the snapshot of a tick.

    Args:
        session: the session.
        tick: the tick.
        newest: the latest tick whose inputs were taken.
        slots: slots of a row.
    """
    queue, stream, player = session.inputs, session.stream, session.player
    view, segments = stream.view, stream.view.plain
    return (
        player is not None
        and player.session is session
        and (type(queue) is InputQueue or _is_plain_at_edge(session, queue, range(tick + 1, newest + 1)))
        and queue.override is None
        and not session.closed
        and session.greeting is None
        and 0 <= queue.first <= newest
        and queue.accepted <= newest + slots
        and len(queue.margins) <= KEPT // 2
        and len(queue.statuses) <= 1
        and stream.acked >= 0
        and stream.tick == view.tick == tick
        and stream.flow.steady
        and len(stream.flow.samples) < SAMPLES
        and len(stream.flow.rates) < RATES
        and segments is not None
        and len(segments) <= SEGMENTS
        and not (stream.terrain_now or stream.terrain_due or stream.shared_due or stream.private_due)
        and not (player.verdicts or player.outbox.due)
    )


def _is_plain_at_edge(session: Session, queue: InputQueue, ticks: range) -> bool:
    """Returns whether a row can hold what the input queue of a session has at an edge.

    Args:
        session: the session.
        queue: its input queue.
        ticks: the ticks whose inputs were taken and whose records have not come.
    """
    waits = queue.unrecorded
    if waits is None or session.beside or len(waits) != len(ticks):
        return False
    return all(tick in waits and waits[tick][0] != IDLE for tick in ticks)
