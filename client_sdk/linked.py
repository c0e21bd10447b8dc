"""A core behind a worse connection than it has: to feel bad links while developing.

Theory of operation. Whole messages are held back, in order, between the core and whatever carries them: each way is a
`links.Wire`, the model of TCP that the network lab measures with, and its time is the `now` of the calls. So there is
no thread, nothing sleeps, and with a clock of one's own all of it happens again exactly. That the connection is lost
is heard behind what was sent before; what was still to go out is gone with it. While a slow line is busy, nothing more
should be read (`appetite`): what waits for it then waits at the server, which sends less, as it does on a real one.
Over a socket the kernels hide some of that: with "thin", snapshots are 0.4 to 1.4 s old at p50, more than in the lab.
"""

import math

from client_sdk.core import Core
from client_sdk.links import Agenda, Path, Weather, Wire, named

LOST = b""
"""Stands for the loss of the connection among the messages; an empty one is not taken."""
CLEAR = Path()
SLOW_READ_BYTES = 1152
"""A slow line is given so much at once."""


class LinkedCore(Core):
    """A `Core` with a `link`, which may change at any time; without one it is a `Core`.

    All that chance does on a link comes from `seed`. Arguments are those of `Core`.
    """

    seed = 1
    _link: Path | None = None
    _line: "_Line | None" = None
    _now = 0.0
    _opened = False

    @property
    def link(self) -> Path | None:
        """The path on top of the real one, None for none; may be set to the name of a preset, too.

        Raises:
            ValueError: there is no preset of that name.
        """
        return self._link

    @link.setter
    def link(self, link: str | Path | None) -> None:
        self._link = named(link)
        if self._line is not None:  # what is on it stays in front
            self._line.follow(self._link or CLEAR, self.seed)

    @property
    def appetite(self) -> int:
        """See `Core.appetite`."""
        link, line = self._link, self._line
        if link is None or (link.rate == math.inf and link.dip is None):
            return super().appetite
        return 0 if line is not None and line.down.busy else SLOW_READ_BYTES

    def open(self, now: float) -> None:
        """See `Core.open`."""
        self._opened = True
        self._off()
        self._on(now)
        super().open(now)

    def receive(self, data: bytes, now: float) -> None:
        """See `Core.receive`."""
        line = self._on(now)
        if line is None or data == LOST:  # an empty message is malformed, whenever it comes
            super().receive(data, now)
        else:
            line.down.send(data)
            line.advance(now)

    def lost(self, code: int, reason: str, now: float) -> None:
        """See `Core.lost`."""
        line = self._on(now) if self._opened else None
        if line is None:
            self._opened = False
            super().lost(code, reason, now)
        else:
            line.losses.append((code, reason))
            line.down.send(LOST)
            line.advance(now)

    def update(self, now: float) -> None:
        """See `Core.update`."""
        line = self._on(now)
        if line and self._link is None and line.down.idle and line.up.idle and not line.ready:
            self._off()
        super().update(now)

    def next_update(self, now: float) -> float:
        """See `Core.next_update`."""
        due = super().next_update(now)
        return due if self._line is None else max(min(due, self._line.due), now)

    def outgoing(self) -> list[bytes]:
        """See `Core.outgoing`; the time is that of the latest call that told it."""
        out, line = super().outgoing(), self._line
        if line is None:
            return out
        for message in out:
            line.up.send(message)
        line.advance(self._now)
        ready, line.ready = line.ready, []
        if self.state == "closed":  # the goodbye does not wait
            ready += line.up.waiting()
            self._off()
        return ready

    def outstanding(self) -> int:
        """Bytes on the way in, as the other end sees them."""
        return 0 if self._line is None else self._line.down.outstanding()

    def _on(self, now: float) -> "_Line | None":
        """The line as it is now, if there is one or should be one."""
        self._now = now
        if self._line is not None:
            self._line.advance(now)
        if self._line is None and self._link is not None and self._opened and self.state != "closed":
            self._line = _Line(self._link, self.seed, now, self)
        return self._line

    def _off(self) -> None:
        """What is on the line is lost."""
        if self._line is not None:
            self._line.ready.clear()
        self._line = None

    def _arrived(self, message: bytes) -> None:
        if self._line is None:  # cut, a moment ago
            return
        if message == LOST:
            code, reason = self._line.losses[0]
            self._opened = False
            self._off()
            super().lost(code, reason, self._now)
        else:
            super().receive(message, self._now)

    def _gone(self, message: bytes) -> None:
        if self._line is not None:
            self._line.ready.append(message)


class _Line:
    """Both directions of a link, and their time, which begins with it."""

    def __init__(self, path: Path, seed: int, now: float, core: LinkedCore) -> None:
        self.agenda = Agenda(0.0)
        self.weather = Weather(path, seed)
        self.up = Wire(self.agenda, self.weather, seed + 1, core._gone)
        self.down = Wire(self.agenda, self.weather, seed + 2, core._arrived)
        self.ready: list[bytes] = []
        """What has come through on its way up."""
        self.losses: list[tuple[int, str]] = []
        """What the `LOST` on its way down stand for."""
        self._began = now

    @property
    def due(self) -> float:
        """When it has to be advanced."""
        return self._began + self.agenda.due

    def advance(self, now: float) -> None:
        """Delivers what has arrived by now."""
        self.agenda.advance(now - self._began)

    def follow(self, path: Path, seed: int) -> None:
        """Becomes another path."""
        self.weather = Weather(path, seed)
        self.up.follow(self.weather)
        self.down.follow(self.weather)
