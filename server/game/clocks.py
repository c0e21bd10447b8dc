"""The time limits of clients, their allowances of messages, and the server time that they are sent.

Delays of the server itself do not count against a client: after a pause, all time limits start again, and while ticks
are late, the messages of that time are allowed besides.
"""

from server.config.limits import Limits, catch_up_ticks
from server.game.connections import Connections
from server.game.roster import Roster
from server.game.session import Session
from shared import messages
from shared.bounds import in_ticks

BURST_S, BURST_TICKS_MIN = 1.0, 32
"""Size of a burst of messages: a client may send those of this many seconds (at least of this many ticks) at once.
If ticks of the server are late, the messages of that time are allowed besides."""
AWAY_S = 1.0
"""Seconds. After a longer pause between two ticks, the silence of clients during it is not counted against them."""


class Clocks:
    """The clocks of one game.

    Args:
        rate: ticks per second.
        limits: the limits.
        connections: the sessions.
        roster: the players, some of whom may have lost their connection.
    """

    def __init__(self, rate: int, limits: Limits, connections: Connections, roster: Roster) -> None:
        self._rate, self._limits, self._connections, self._roster = rate, limits, connections, roster
        self._catch_up = catch_up_ticks(rate)
        self.burst = in_ticks(BURST_S, rate, BURST_TICKS_MIN) * limits.messages_per_tick
        """Number of messages of a burst."""
        self._deadline: float | None = None
        self._ticked: float | None = None

    def begin(self, deadline: float, now: float) -> None:
        """Begins a tick. After a pause of the server itself, such as a suspended process, extends all time limits.

        Args:
            deadline: the time at which the tick was due, in seconds of the same clock as `now`.
            now: the current time in seconds.
        """
        paused_s = 0.0 if self._ticked is None else now - self._ticked - 1 / self._rate
        if paused_s > AWAY_S:
            credit = paused_s * self._rate * self._limits.messages_per_tick
            for session in self._connections.sessions:
                session.recall()
                session.opened = session.received_at = session.stream.sent_at = now
                session.allowance += credit
            self._roster.excuse(paused_s, now)
        self._deadline, self._ticked = deadline, now

    @property
    def deadline(self) -> float:
        """The time in seconds at which the latest tick was due."""
        assert self._deadline is not None
        return self._deadline

    def allow(self, session: Session, now: float) -> bool:
        """Counts one message of a client. Returns False if these are more than the client may send."""
        session.received_at = now
        session.allowance -= 1
        return session.allowance >= -self.burst or self._owes(session, now)

    def refill(self) -> None:
        """Lets each client send further messages, those of one tick. The fast path does it for its sessions."""
        if self._connections.all_fast:
            return
        most = self._limits.messages_per_tick
        for session in self._connections.others:
            if session.allowance < 0:  # messages beyond the burst were allowed because of late ticks
                session.allowance = min(max(session.allowance, -self.burst) + most, 0.0)
            elif session.allowance:  # credit for messages that waited during a pause of the server
                session.allowance = max(session.allowance - most, 0.0)

    def check(self, now: float) -> None:
        """Closes the connections of clients that have exceeded a time limit."""
        if self._connections.all_fast:
            return
        limits, kick = self._limits, self._connections.kick
        for session in self._connections.others:
            if session.closed:
                continue
            if not session.entity:
                if session.hello is None and not session.loading and now - session.opened > limits.hello_s:
                    kick(session, messages.NO_HELLO, f"no hello within {limits.hello_s:g} s")
            elif now - session.received_at > limits.silence_s:
                kick(session, messages.TOO_SLOW, f"no message received for {limits.silence_s:g} s")
            elif now - session.stream.sent_at > limits.stalled_s:
                kick(session, messages.TOO_SLOW, f"the client read nothing for {limits.stalled_s:g} s")

    def ticks_left(self, now: float) -> float:
        """Returns the ticks until the next tick's deadline, with a fraction; negative if it has passed.

        If more ticks are missed than are caught up on, the schedule drops the earliest. They do not count here;
        otherwise clients would be sent a server time that never comes.
        """
        if self._deadline is None:
            return 1.0
        passed = (now - self._deadline) * self._rate
        return 1.0 - passed if passed < self._catch_up + 1 else 1.0 - self._catch_up - passed % 1.0

    def _owes(self, session: Session, now: float) -> bool:
        """Returns whether the ticks that are late now explain why a session exceeds its allowance of messages."""
        behind = 0.0 if self._ticked is None else max((now - self._ticked) * self._rate - 1, 0.0)
        return session.allowance >= -self.burst - behind * self._limits.messages_per_tick
