"""A simulated link between a core and its transport, to try bad connections while developing.

Theory of operation. Whole messages are held back, in order, between the core and its transport. Each direction is a
`links.Wire`, the model of TCP that the network lab measures with. Its time is the `now` of the calls. So there is no
thread, nothing sleeps, and a program with a clock of its own gets exactly the same run again.

The loss of the connection reaches the core after the messages that the server sent before it. Messages that still wait
to be sent are lost with the connection. While a slow line is busy, the transport should read nothing more (`appetite`).
Further messages then wait at the server, which sends less, as it does over a real slow connection. Over a socket, the
buffers of the operating systems hide a part of this: with "thin", snapshots are 0.4 to 1.4 s old at p50, more than in
the lab.
"""

import math
from typing import cast

from client_sdk.core import Core
from client_sdk.handover import SecondPort
from client_sdk.netsim.links import EventQueue, Link, LinkEvents, TcpStream, named

LOST = b""
"""Message that stands for the loss of the connection; a real message is never empty."""
CLEAR = Link()
"""Link without delay, loss or limits."""
SLOW_READ_BYTES = 1152
"""Number of bytes that a transport reads at once while a slow link is set."""


class LinkedPort:
    """A core's `Port` behind a simulated link, which may change at any time.

    Install it as `core.port`. While there is no link, it passes everything on at once.

    Args:
        core: the core behind the link.
        seed: all chance on the link comes from it.
    """

    def __init__(self, core: Core | SecondPort, seed: int = 1) -> None:
        self.core = cast("Core", core)
        self._seed = seed
        self._link: Link | None = None
        self._line: _Line | None = None
        self._now = 0.0
        self._opened = core.connected

    @property
    def link(self) -> Link | None:
        """The simulated link on top of the real connection; None: no link. May also be set to the name of a preset.

        Raises:
            ValueError: no preset has that name.
        """
        return self._link

    @link.setter
    def link(self, link: str | Link | None) -> None:
        self._link = named(link)
        if self._line is not None:  # messages on the old link arrive before those on the new one
            self._line.follow(self._link or CLEAR, self._seed)

    @property
    def appetite(self) -> int:
        """The number of bytes that the transport should read at once; 0 while a slow line is busy."""
        link, line = self._link, self._line
        if link is None or (link.rate == math.inf and link.dip is None):
            return self.core.appetite
        return 0 if line is not None and line.down.busy else SLOW_READ_BYTES

    def open(self, now: float) -> None:
        """Takes a new connection, and sends Hello over a new line."""
        self._opened = True
        self._off()
        self._on(now)
        self.core.open(now)

    def receive(self, data: bytes, now: float) -> None:
        """Takes one message of the server, which the core gets at the end of the line."""
        line = self._on(now)
        if line is None or data == LOST:  # an empty message is malformed; the core refuses it at once
            self.core.receive(data, now)
        else:
            line.down.send(data)
            line.advance(now)

    def lost(self, code: int, reason: str, now: float) -> None:
        """Takes the loss of the connection, which the core gets after the messages that are on the line."""
        line = self._on(now) if self._opened else None
        if line is None:
            self._opened = False
            self.core.lost(code, reason, now)
        else:
            line.losses.append((code, reason))
            line.down.send(LOST)
            line.advance(now)

    def update(self, now: float) -> None:
        """Delivers what has arrived on the line, then predicts every tick that is due and sends pings that are due."""
        line = self._on(now)
        if line and self._link is None and line.down.idle and line.up.idle and not line.ready:
            self._off()
        self.core.update(now)

    def next_update(self, now: float) -> float:
        """Returns the local time at which `update` has something to do, for the core or for the line."""
        due = self.core.next_update(now)
        return due if self._line is None else max(min(due, self._line.due), now)

    def outgoing(self) -> list[bytes]:
        """Returns the messages that have come through the line, as of the latest `now` of another call."""
        out, line = self.core.outgoing(), self._line
        if line is None:
            return out
        for message in out:
            line.up.send(message)
        line.advance(self._now)
        ready, line.ready = line.ready, []
        if self.core.state == "closed":  # the Bye leaves at once, with everything that waits in front of it
            ready += line.up.waiting()
            self._off()
        return ready

    def outstanding(self) -> int:
        """Returns the bytes on the way to this client that are not acknowledged yet, as the server sees them."""
        return 0 if self._line is None else self._line.down.outstanding()

    def beside(self, port: SecondPort) -> "LinkedPort":
        """Returns the same simulated link in front of the port of a second connection."""
        linked = LinkedPort(port, self._seed + 1000)
        linked.link = self._link
        return linked

    def taken_by(self, core: Core) -> "LinkedPort":
        """Makes this the port of the core's only connection, and returns it."""
        self.core = core
        return self

    def _on(self, now: float) -> "_Line | None":
        """Advances the line to `now`, and creates it if a link needs one. Returns it; None if there is no link."""
        self._now = now
        if self._line is not None:
            self._line.advance(now)
        if self._line is None and self._link is not None and self._opened and self.core.state != "closed":
            self._line = _Line(self._link, self._seed, now, self)
        return self._line

    def _off(self) -> None:
        """Removes the line, and loses the messages that are on it."""
        if self._line is not None:
            self._line.ready.clear()
        self._line = None

    def _arrived(self, message: bytes) -> None:
        if self._line is None:  # an earlier delivery of this call has removed the line
            return
        if message == LOST:
            code, reason = self._line.losses[0]
            self._opened = False
            self._off()
            self.core.lost(code, reason, self._now)
        else:
            self.core.receive(message, self._now)

    def _gone(self, message: bytes) -> None:
        if self._line is not None:
            self._line.ready.append(message)


class _Line:
    """Both directions of a link, with their own time, which is 0 when the line is created."""

    def __init__(self, path: Link, seed: int, now: float, port: LinkedPort) -> None:
        self.event_queue = EventQueue(0.0)
        self.link_events = LinkEvents(path, seed)
        self.up = TcpStream(self.event_queue, self.link_events, seed + 1, port._gone)
        self.down = TcpStream(self.event_queue, self.link_events, seed + 2, port._arrived)
        self.ready: list[bytes] = []
        """Messages of the core that have come through and can be sent."""
        self.losses: list[tuple[int, str]] = []
        """Close code and reason for each `LOST` on the line."""
        self._began = now

    @property
    def due(self) -> float:
        """The local time at which the line has to be advanced, in seconds."""
        return self._began + self.event_queue.due

    def advance(self, now: float) -> None:
        """Delivers the messages that have arrived by `now`."""
        self.event_queue.advance(now - self._began)

    def follow(self, path: Link, seed: int) -> None:
        """Changes the line to another link; messages that are under way stay in front."""
        self.link_events = LinkEvents(path, seed)
        self.up.follow(self.link_events)
        self.down.follow(self.link_events)
