"""Simulated links: a model of a TCP connection in simulated time. Messages may be late, then arrive in a burst; no
message is lost or reordered.

Theory of operation. A message is cut into packets. Each packet waits until the line is free (`rate`), travels (`delay`,
jitter, spikes; packets leave the path in the order in which they entered it), and may be lost. The sender detects a
lost packet as RACK does: a packet sent after it was acknowledged (acknowledgements are lost as often as packets), and a
reorder window of a quarter of the round trip has passed. If no other packet is sent, a time-out detects the loss: a
round trip and 200 ms, doubled each time. The packet is sent again, may be lost again, and everything that arrived
behind it waits. Not modelled, because a game's thin stream hardly ever meets them: the congestion window, delayed
acknowledgements, tail loss probes.

`LinkEvents` has the link events that concern both directions of a connection at the same time. They are drawn from a
seed as time goes on.
"""

import heapq
import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from typing import Protocol

from shared.checks import SceneError, duration, shown

PACKET_BYTES = 1448
"""Largest payload of a packet, in bytes."""
HEADER_BYTES = 66
"""Headers of a packet in bytes: Ethernet, IP, and TCP with time stamps."""
FRAME_BYTES = 6
"""Header of a message in bytes: the WebSocket frame."""
TIMEOUT_S = 0.2
"""Part of the first retransmission time-out that is added to the round trip, in seconds."""
TIMER_S = 0.01
"""Delay with which an operating system's timer for the reorder window fires, in seconds: two to three jiffies of
4 ms."""


class Scheduler(Protocol):
    """Simulated time."""

    now: float

    def at(self, when: float, act: Callable[[], None]) -> None:
        """Plans the call of `act` for the time `when`, in seconds."""


@dataclass(frozen=True)
class Link:
    """The properties of a simulated link, equal for both directions. Times in seconds.

    Args:
        delay_s: least time from one end to the other.
        jitter_s: largest additional delay, drawn evenly for each packet.
        loss: share of packets that are lost, 0 to 1.
        rate: bits per second.
        dip: during the last `dip[1]` of every `dip[0]` seconds, the rate is `dip[2]` bits per second.
        spike: about every `spike[0]` seconds, for about `spike[1]` seconds, the delay is up to `spike[2]` longer.
        outage: during the last `outage[1]` of every `outage[0]` seconds, everything is lost.

    Raises:
        ValueError: a delay or the loss is negative, the loss is above 1, or the rate is not above 0.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    rate: float = math.inf
    dip: tuple[float, float, float] | None = None
    spike: tuple[float, float, float] | None = None
    outage: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("delay_s", "jitter_s", "loss"):
            duration(getattr(self, name), name)
        if not self.loss <= 1:
            raise SceneError(f"loss = {shown(self.loss)}: must be from 0 to 1")
        if duration(self.rate, "rate", endless=True) == 0:
            raise SceneError(f"rate = {shown(self.rate)}: must be more than 0")

    @property
    def rtt_s(self) -> float:
        """The average round trip in seconds, without loss and link events."""
        return 2 * self.delay_s + self.jitter_s


def path(rtt_ms: float, jitter_ms: float, loss: float = 0.0) -> Link:
    """Returns a link whose round trip is `rtt_ms` +- `jitter_ms` (milliseconds)."""
    return Link((rtt_ms - jitter_ms) / 2000, jitter_ms / 1000, loss)


PRESETS = {
    "lan": path(0.5, 0.1),
    "regional": path(30, 2, 0.001),
    "typical": path(100, 10, 0.01),
    "far": path(200, 25, 0.02),
    "wifi": replace(path(8.5, 2), spike=(10.0, 1.0, 0.0708)),
    "dip": replace(path(50, 2), rate=2e6, dip=(40.0, 10.0, 120e3)),
    "outage": replace(path(50, 2), outage=(3.0, 0.12)),
    "thin": replace(path(60, 5), rate=30e3),
}
"""Simulated links by name."""


def named(link: str | Link | None) -> Link | None:
    """Returns the preset of that name. Returns a `Link`, or None (no link), unchanged.

    Raises:
        ValueError: no preset has that name.
    """
    if isinstance(link, str):
        if link not in PRESETS:
            raise ValueError(f"link = {shown(link)}: must be one of {', '.join(PRESETS)}, a Path, or None")
        return PRESETS[link]
    if link is not None and not isinstance(link, Link):
        raise ValueError(f"link = {shown(link)}: must be one of {', '.join(PRESETS)}, a Path, or None")
    return link


class EventQueue:
    """An event queue: a scheduler whose calls are made, in order of time, when `advance` reaches their times."""

    def __init__(self, now: float) -> None:
        self.now = now
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._number = count()

    @property
    def due(self) -> float:
        """The time of the next call, in seconds; `inf` if none is planned."""
        return self._queue[0][0] if self._queue else math.inf

    def at(self, when: float, act: Callable[[], None]) -> None:
        """Plans the call of `act` for the time `when`, in seconds."""
        heapq.heappush(self._queue, (when, next(self._number), act))

    def advance(self, now: float) -> None:
        """Makes all calls that are due by `now`."""
        while self._queue and self._queue[0][0] <= now:
            self.now, _, act = heapq.heappop(self._queue)
            act()
        self.now = max(self.now, now)


class LinkEvents:
    """The link events of a path, which concern both directions: spikes, dips and outages.

    Args:
        path: properties of the link.
        seed: all chance of the link events comes from it.
    """

    def __init__(self, path: Link, seed: int) -> None:
        self.path = path
        self.spikes: list[tuple[float, float, float]] = []
        """Spikes drawn until now: begin and end (seconds), extra delay (seconds)."""
        self._rng = random.Random(seed)
        self._drawn = 0.0 if path.spike else math.inf

    def rate(self, now: float) -> float:
        """Returns the rate at the time `now`, in bits per second."""
        path = self.path
        return path.dip[2] if path.dip and _late(now, path.dip) else path.rate

    def out(self, now: float) -> bool:
        """Returns whether there is an outage at the time `now`."""
        return self.path.outage is not None and _late(now, self.path.outage)

    def extra(self, now: float) -> float:
        """Returns the extra delay of a spike at the time `now`, in seconds; 0 if there is none."""
        while now >= self._drawn:
            self._draw()
        for begin, end, extra in reversed(self.spikes):
            if begin <= now:
                return extra if now < end else 0.0
        return 0.0

    def dipped(self, now: float) -> float:
        """Returns the seconds since the current dip began; negative if there is none."""
        dip = self.path.dip
        return now % dip[0] - (dip[0] - dip[1]) if dip else -1.0

    def _draw(self) -> None:
        assert self.path.spike is not None
        every, length, extra = self.path.spike
        begin = self._drawn + every * self._rng.uniform(0.4, 1.6)
        end = begin + length * self._rng.uniform(0.7, 1.3)
        self.spikes.append((begin, end, extra * self._rng.uniform(0.4, 1.0)))
        self._drawn = end


def _late(now: float, cycle: tuple[float, ...]) -> bool:
    return now % cycle[0] >= cycle[0] - cycle[1]


_Packet = tuple[int, int, bytes | None]
"""A packet: its number in the stream, its payload in bytes, and the message that it completes, or None."""


class _Loss:
    """A transmission that does not arrive, with its retransmission time-out."""

    def __init__(self, packet: _Packet, sent: float, timeout_s: float) -> None:
        self.packet = packet
        self.sent = sent
        self.timeout_s = timeout_s


class TcpStream:
    """One direction of a simulated TCP connection.

    Args:
        time: the simulated time, which calls the deliveries.
        link_events: the link and its events; the other direction uses the same object.
        seed: all chance of this direction comes from it.
        deliver: called with each message that arrives, in order.
    """

    def __init__(self, time: Scheduler, link_events: LinkEvents, seed: int, deliver: Callable[[bytes], None]) -> None:
        self._time, self._link_events, self._path, self._deliver = time, link_events, link_events.path, deliver
        self._random = random.Random(seed).random
        self._flying: deque[_Packet] = deque()  # on the way, in order of transmission and of arrival
        self._missing: list[_Loss] = []  # lost, and not yet sent again
        self._early: dict[int, _Packet] = {}  # arrived, but wait for a packet before them
        self._numbers = count()
        self._next = 0  # number of the packet to deliver next
        self._free = 0.0  # time at which the line is free
        self._last = 0.0  # time at which the newest transmission arrives
        self._bytes = 0
        self._unacked: deque[tuple[float, int]] = deque()  # time at which an acknowledgement is back, bytes
        self.sent_bytes = 0
        """Number of bytes that were transmitted, including headers."""
        self.resent = 0
        """Number of packets that were sent again."""

    def send(self, message: bytes) -> None:
        """Sends a message; never blocks."""
        left = len(message) + FRAME_BYTES
        self._bytes += left
        while left > PACKET_BYTES:
            left -= PACKET_BYTES
            self._transmit((next(self._numbers), PACKET_BYTES, None))
        self._transmit((next(self._numbers), left, message))

    def cut(self) -> None:
        """Cuts the connection: messages on the way, and those sent from now on, are lost."""
        self._deliver = _nowhere

    @property
    def idle(self) -> bool:
        """Whether every packet has arrived."""
        return not self._flying and not self._missing

    @property
    def busy(self) -> bool:
        """Whether the line is still transmitting."""
        return self._free > self._time.now

    def waiting(self) -> list[bytes]:
        """Returns the messages that have not arrived, in order."""
        packets = [*self._flying, *(loss.packet for loss in self._missing), *self._early.values()]
        return [message for _, _, message in sorted(packets) if message is not None]

    def follow(self, link_events: LinkEvents) -> None:
        """Changes to another link; packets that are under way stay in front."""
        self._link_events, self._path = link_events, link_events.path

    def outstanding(self) -> int:
        """Returns the bytes that were sent and are not acknowledged yet."""
        while self._unacked and self._unacked[0][0] <= self._time.now:
            self._bytes -= self._unacked.popleft()[1]
        return self._bytes

    def _transmit(self, packet: _Packet, lost: _Loss | None = None) -> None:
        """Transmits a packet, for the first time or again after the loss `lost`."""
        path, link_events, now, free = self._path, self._link_events, self._time.now, self._free
        size = packet[1] + HEADER_BYTES
        self.sent_bytes += size
        rate = path.rate if path.dip is None else link_events.rate(now)
        gone = self._free = max(now, free) + 8 * size / rate
        if self._random() < path.loss or (path.outage is not None and link_events.out(gone)):
            timeout_s = 2 * lost.timeout_s if lost else TIMEOUT_S + path.rtt_s
            loss = _Loss(packet, now, timeout_s)
            self._missing.append(loss)
            self._time.at(now + (gone - now + timeout_s), lambda: self._timeout(loss))
            return
        extra = 0.0 if path.spike is None else link_events.extra(gone)
        comes = gone + path.delay_s + self._random() * path.jitter_s + extra
        if comes < self._last:
            comes = self._last
        self._last = comes
        self._flying.append(packet)
        self._time.at(comes, self._arrive)
        if self._missing and self._random() >= path.loss:  # its acknowledgement reveals the missing packets
            noticed = comes + path.delay_s + path.jitter_s / 2 + extra + path.rtt_s / 4 + TIMER_S
            self._time.at(noticed, lambda: self._find_missing(now))

    def _find_missing(self, sent: float) -> None:
        found = [loss for loss in self._missing if loss.sent < sent]
        if found:
            self._missing = [loss for loss in self._missing if loss.sent >= sent]
            for loss in found:
                self._resend(loss)

    def _timeout(self, loss: _Loss) -> None:
        if loss in self._missing:
            self._missing.remove(loss)
            self._resend(loss)

    def _resend(self, loss: _Loss) -> None:
        self.resent += 1
        self._transmit(loss.packet, loss)

    def _arrive(self) -> None:
        first = self._flying.popleft()
        now, path, early, unacked = self._time.now, self._path, self._early, self._unacked
        if unacked and unacked[0][0] <= now:
            self.outstanding()  # removes acknowledged packets, in case no caller asks for the number
        if first[0] != self._next:
            early[first[0]] = first
            return
        back = now + path.delay_s + path.jitter_s / 2
        packet: _Packet | None = first
        while packet is not None:
            number, size, message = packet
            self._next = number + 1
            unacked.append((back, size))
            if message is not None:
                self._deliver(message)
            packet = early.pop(number + 1, None) if early else None


def _nowhere(message: bytes) -> None:
    """Discards a message that was sent over a cut connection."""
