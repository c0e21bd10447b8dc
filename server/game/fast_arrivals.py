"""Messages that have arrived for sessions on the fast path (`server.game.fast_path`), and wait for the next tick."""

from array import array
from collections.abc import Callable, Sequence
from functools import partial

from server.config.limits import Limits, catch_up_ticks
from server.game.clocks import Clocks
from server.game.fast_rows import Arguments, Rows, lent
from server.game.session import Session
from server.replication import flow_control
from shared.bounds import bounds
from shared.kernels import Kernel
from shared.messages import Held, Inputs, Ping, head_of
from shared.scene import Scene
from shared.session_rows import ALLOWANCE, FLOATS, PROBE_AT, PROBE_BYTES, RECEIVED_AT, WIDTH
from shared.traffic import ANSWERED, FRAME_HEAD_BYTES, LEFT

WAITING_MAX = 4096
"""Maximum number of messages that wait for the next tick."""
TAKEN, PING = (head_of(Inputs), head_of(Held)), head_of(Ping)
"""First two bytes of the messages that do not take a session off the fast path."""
FRAME, MASKED = 0x82, 0x80
"""First byte of a WebSocket frame with a whole binary message, and what is added to its second one, the size."""
FRAMED_MAX = 125
"""Maximum bytes of a message in the shortest kind of frame."""


class Arrivals:
    """The messages that wait.

    Args:
        scene: the scene.
        newest: returns the latest tick whose inputs were taken.
        rows: the rows of the sessions.
        limits: the limits.
        clocks: the time of the tick, and the allowances of messages.
        recall: takes a session off the fast path.
        receive: takes a message of a session that is not on the fast path: session, message, time of arrival.
        kernel: the kernel to use.
    """

    def __init__(
        self,
        scene: Scene,
        newest: Callable[[], int],
        rows: Rows,
        limits: Limits,
        clocks: Clocks,
        recall: Callable[[Session], None],
        receive: Callable[[Session, bytes, float], None],
        kernel: Kernel,
    ) -> None:
        rate = scene.tick_rate
        self._newest, self._rows, self._limits, self._clocks = newest, rows, limits, clocks
        self._recall, self._receive, self._kernel = recall, receive, kernel
        ahead, most = bounds(rate).ahead, limits.input_rows_max
        room = min(ahead, rows.slots)
        facts = (0, ahead, scene.input_row_bytes, most, rows.slots, bounds(rate).repeats, room)
        self._rules = Arguments(kernel, "q", values=facts)
        self._clock = Arguments(
            kernel,
            "d",
            values=(
                0.0,
                rate,
                catch_up_ticks(rate),
                bounds(rate).margin_one,
                clocks.burst,
                flow_control.RATE_WINDOW_S,
                flow_control.RTT_SPAN_S,
            ),
        )
        self._arrived: list[tuple[int, int, bytes, float]] = []
        """Row, size in bytes (negative: in a frame), bytes, time of arrival."""
        self._frame_max = FRAME_HEAD_BYTES + min(FRAMED_MAX, limits.message_bytes_max)
        """Maximum size of a frame that waits."""

    def post(self, session: Session, data: bytes, now: float) -> bool:
        """Handles a message of a session on the fast path. Returns False if it was recalled instead."""
        head, row = data[:2], session.row
        if head in TAKEN and len(data) <= self._limits.message_bytes_max:
            self._arrived.append((row, len(data), data, now))
            if len(self._arrived) >= WAITING_MAX:
                self.flush()
            return True
        if head == PING and self._rows.floats[row * FLOATS + ALLOWANCE] - 1 >= -self._clocks.burst:
            self._rows.floats[row * FLOATS + RECEIVED_AT] = now
            self._rows.floats[row * FLOATS + ALLOWANCE] -= 1
        else:
            self._recall(session)
        return False

    def post_frame(self, row: int, data: bytes, now: float) -> bool:
        """Takes what has arrived on a WebSocket if it is one frame with an input message. Returns whether it is."""
        size = len(data)
        if (
            FRAME_HEAD_BYTES + 2 <= size <= self._frame_max
            and data[0] == FRAME
            and data[1] == MASKED + size - FRAME_HEAD_BYTES
            and bytes((data[2] ^ data[6], data[3] ^ data[7])) in TAKEN
            and len(self._arrived) < WAITING_MAX
        ):
            self._arrived.append((row, -size, data, now))
            return True
        return False

    def flush(self) -> None:
        """Takes all messages that have arrived."""
        if not self._arrived:
            return
        numbers, sizes, data, times = zip(*self._arrived, strict=True)
        self._arrived = []
        rows, lend = self._rows, partial(lent, self._kernel)
        fates = bytearray(len(data))
        self._rules.values[0], self._clock.values[0] = self._newest(), self._clocks.deadline
        text, lengths = bytearray().join(data), lend(array("q", sizes), "q")
        self._kernel.unmask(lend(text, "B"), lengths)
        self._kernel.take_messages(
            rows.numbers_lent,
            rows.floats_lent,
            rows.ring_lent,
            lend(text, "B"),
            lend(array("q", numbers), "q"),
            lengths,
            lend(array("d", times), "d"),
            lend(fates, "B"),
            self._rules.lent,
            self._clock.lent,
        )
        if any(fates):
            self._handle(fates, numbers, sizes, text, times)

    def _handle(
        self, fates: bytearray, numbers: Sequence[int], sizes: Sequence[int], text: bytearray, times: Sequence[float]
    ) -> None:
        """Does for messages what the compiled code has left to Python.

        Args:
            fates: fate of each message.
            numbers: row of each.
            sizes: size of each in bytes; negative: with its frame.
            text: all of them.
            times: time of arrival of each.
        """
        rows, at = self._rows, 0
        sessions = rows.sessions.copy()
        for fate, row, size, now in zip(fates, numbers, sizes, times, strict=True):
            start, at = at + (FRAME_HEAD_BYTES if size < 0 else 0), at + abs(size)
            session = sessions[row]
            if session is None:
                continue
            if fate == ANSWERED and session.row >= 0:
                self._answered(session, now)
            elif fate == LEFT:
                self._recall(session)
                self._receive(session, bytes(text[start:at]), now)

    def _answered(self, session: Session, now: float) -> None:
        """Takes an answer to the probe of the round trip."""
        row, floats = session.row, self._rows.floats
        flow, rtt_s = session.flow, now - floats[row * FLOATS + PROBE_AT]
        size = self._rows.numbers[row * WIDTH + PROBE_BYTES]
        if now - flow.full_at < flow_control.RATE_WINDOW_S + rtt_s:
            self._recall(session)  # its rates matter
        flow.answered(rtt_s, size, now)
        if session.row >= 0:
            self._rows.write_rtts(row, flow)
