"""The inputs that a client has sent, by tick: the messages for new ones, and what a snapshot says about earlier ones.

Theory of operation. A changed input is sent in its tick. One that stays the same is not: a `Held` of 4 bytes says that
it holds for the next `Bounds.repeats` ticks. There is one in every tick until the server has the change, and then one
every `RENEW_S` seconds. A later input replaces it at once, so nothing is sent later than in a message per tick. The
server uses the same input in every tick as if it had got one for each. Two things differ. There is an arrival margin
per message, not per tick. And where an input changes while the one before holds, the server does not miss a late
message: the status of the tick is USED although the input before was used (`replaced`). The margin says so. It may come
in a snapshot after that of the status or, from an edge of a cluster, in one before.

TCP detects a lost message by the answer to a later one. So the loss of a `Held` delays it for longer than in a message
per tick, by the time until the next one is sent. A changed input does not meet that delay, because there is a message
in every tick after it. The lead is for changed inputs, so it does not count (`filled`).
"""

import math
from collections.abc import Iterator, Sequence
from struct import iter_unpack
from typing import NamedTuple

from shared import priced
from shared.bounds import bounds, in_ticks
from shared.messages import MARGIN_REFUSED, USED, Held, Inputs, Message, Snapshot
from shared.ring import Ring

ROWS_MAX = 16
"""Limit of the inputs in one message."""
RENEW_S = 0.0625
"""Seconds after which an input that stays the same is sent again."""
PRICE_S = 2 * priced.PRICE_S
"""Price of all inputs being late, in seconds of lead. With half as many messages, half as many are lost. With twice the
price, the lead covers the same losses as with a message per tick."""
DETECTED_RTT = 1.25
"""Round trips from the arrival of the message that reveals a loss to that of the lost one: one, and a quarter in which
TCP waits for packets that have only changed places (RFC 8985, section 6.2)."""
CHANGED, RENEWED, QUIET = range(3)
"""Kinds of ticks by what was sent for them: the input; that the input before holds; nothing."""


def margins_of(snapshot: Snapshot) -> Iterator[tuple[int, int]]:
    """Yields the ticks of a snapshot's arrival margins, and the margins in units of the wire."""
    first = snapshot.newest + 1 - len(snapshot.margins) // 2
    return ((tick, margin) for tick, (margin,) in enumerate(iter_unpack("<h", snapshot.margins), first))


class Arrival(NamedTuple):
    """The arrival of a message with an input at the server.

    `tick` is the tick of the input. `need` is the phase that would just have been enough (`client_sdk.timing.lead`). An
    input that was `refused` was too early, by at least `Bounds.ahead` ticks. `late`: it was late, and had changed.
    """

    tick: int
    need: float
    late: bool
    refused: bool


class SentInputs:
    """The inputs that one client has sent.

    Args:
        rate: ticks per second.
        row_bytes: length of one input in a message, `Scene.input_row_bytes`.
    """

    def __init__(self, rate: int, row_bytes: int) -> None:
        self._bounds, self._row_bytes = bounds(rate), row_bytes
        self.renew = in_ticks(RENEW_S, rate, 1)
        """Number of ticks after which an input that stays the same is sent again."""
        self._due = self._newest = self._changed = self._received = 0
        self.restart()
        self.forget()

    def restart(self) -> None:
        """Makes the next input count as changed, because the server may not have the latest one."""
        self._latest = b""

    def forget(self) -> None:
        """Forgets what was sent, because it was withdrawn."""
        size = self._bounds.predicted
        self._sent: Ring[tuple[float, int, int]] = Ring(size)
        """Phase of the timeline, kind, and the tick from which on the input has been the same, by tick."""
        self._late: list[Ring[float]] = [Ring(size), Ring(size)]
        """Arrival (in ticks) of changed inputs that were late, by tick; over the connection and over a second one."""

    def change_over(self) -> None:
        """Notes that the second connection has taken the place of the first."""
        self._late = [self._late[1], Ring(self._bounds.predicted)]

    def send(self, first: int, rows: bytes, phases: Sequence[float], acked: int) -> list[Message]:
        """Files the inputs of new ticks. Returns the messages to send.

        Args:
            first: the first tick.
            rows: the inputs of this tick and of those after it, packed.
            phases: phases of the timeline, one per input.
            acked: tick of the newest snapshot that was applied.
        """
        size, to = self._row_bytes, first + len(phases) - 1
        at = max(first, self._due)
        if rows != self._latest * len(phases) or to > at + self._bounds.repeats or acked > at:
            for tick, phase in enumerate(phases, first):
                self._sent.put(tick, (phase, CHANGED, tick))
            self._changed = to
            self._latest, self._newest, self._due = rows[-size:], to, to + 1
            return [
                Inputs(first + at, acked, rows[size * at : size * (at + ROWS_MAX)])
                for at in range(0, len(phases), ROWS_MAX)
            ]
        for tick, phase in enumerate(phases, first):
            self._sent.put(tick, (phase, RENEWED if tick == at else QUIET, self._changed))
        if at > to:
            return []
        renew = self.renew if self._received >= self._changed else 1
        after, self._newest, self._due = at - self._newest, at, max(at + renew, to + 1)
        return [Held(after, at - acked)]

    def again(self, since: int, to: int) -> None:
        """Notes that the inputs after the tick `since`, up to `to`, are sent again, also those that were forgotten."""
        for tick in range(since + 1, to + 1):
            if not self.has(tick):
                self._sent.put(tick, (0.0, QUIET, tick))

    def has(self, tick: int) -> bool:
        """Returns whether the server was sent an input for a tick, or that the input before holds."""
        return self._sent.get(tick) is not None

    def changed(self, tick: int) -> bool:
        """Returns whether the input of a tick was sent by itself."""
        sent = self._sent.get(tick)
        return sent is not None and sent[1] == CHANGED

    def filled(
        self, needs: Sequence[tuple[int, float]], before: int, last: float, rtt: float
    ) -> Iterator[tuple[int, float]]:
        """Yields the needs of messages, and of the ticks between them for which nothing was sent.

        Messages that have arrived together waited for the first of them, which was lost. If the second one revealed
        that, a message per tick would have ended the delay earlier, by the ticks between the two. If the second one was
        lost as well, the line was out, and for how long does not depend on the messages.

        Args:
            needs: ticks and needs of the messages that a snapshot reports.
            before, last: tick and need of the latest message before them.
            rtt: round trip in ticks.
        """
        least, revealed = min((need for _, need in needs), default=0.0), True
        for i, (tick, need) in enumerate(needs):
            if i + 1 < len(needs) and self.quiet(tick + 1, needs[i + 1][0]):
                after, gap = needs[i + 1][1], needs[i + 1][0] - tick
                together = need > after + gap - 1
                revealed = not together or (revealed and after - least <= DETECTED_RTT * rtt + gap / 2)
                if together and revealed:
                    need = after + gap - 1
            gap = tick - before
            if gap <= self._bounds.repeats and self.quiet(before + 1, tick):
                for k in range(1, gap):
                    yield before + k, last + (need - last) * k / gap
            yield tick, need
            before, last = tick, need

    def quiet(self, first: int, end: int) -> bool:
        """Returns whether the input before held in the ticks from `first` to `end` - 1, of which there are any."""
        return first < end and all(
            (sent := self._sent.get(tick)) is not None and sent[1] == QUIET for tick in range(first, end)
        )

    def arrived(self, snapshot: Snapshot, connection: int = 0) -> list[Arrival]:
        """Takes from a snapshot up to which tick inputs have arrived, and the margins: which changed ones were late.

        Args:
            snapshot: the snapshot.
            connection: 1 for a second connection, else 0.

        Returns:
            The arrivals of messages that were sent.
        """
        if not connection:
            self._received = snapshot.newest
        arrivals, one = [], self._bounds.margin_one
        for tick, margin in margins_of(snapshot):
            sent = self._sent.get(tick)
            if sent is None or sent[1] == QUIET:
                continue
            late = MARGIN_REFUSED < margin < 0 and sent[1] == CHANGED
            if late:
                self._late[connection].put(tick, tick - margin / one)
            refused = margin == MARGIN_REFUSED
            if refused:
                self.restart()
                margin = math.floor(self._bounds.ahead * one)
            arrivals.append(Arrival(tick, sent[0] - margin / one, late, refused))
        return arrivals

    def replaced(self, snapshot: Snapshot) -> int:
        """Returns the number of ticks of a snapshot with the status USED in which another input was used.

        In such a tick, the server did not know yet that the input had changed, or the client sent nothing. `arrived`
        comes first.
        """
        return sum(
            status == USED and self._was_replaced(tick, snapshot.newest)
            for tick, status in enumerate(snapshot.statuses, snapshot.first)
        )

    def _was_replaced(self, tick: int, newest: int) -> bool:
        """Returns whether the server used another input in a tick, while it had those up to the tick `newest`."""
        sent = self._sent.get(tick)
        if sent is None or sent[2] > newest:
            return True
        arrived = self._late[0].get(sent[2])
        return arrived is not None and tick < arrived
