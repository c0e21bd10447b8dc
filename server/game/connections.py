"""The connections of a game, and the ways in which one ends.

A client that may not join is refused. A client that breaks a rule is kicked. An exception in our own code costs the
client that it affected its connection, and the tick goes on. A link may report itself as lost during a call of its
`send` or `close`, so loops in which that can happen iterate over a copy of the sessions.
"""

import math

from server.game.roster import Roster
from server.game.session import Session
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.player import Player
from server.replication.client_stream import Transport
from shared import fields, messages
from shared.messages import Bye, Go, encode


class Connections:
    """The sessions of one game.

    Args:
        roster: the players, who may reconnect after some of the ends.
        counters: where ends are counted.
        faults: where exceptions in our own code are reported.
    """

    def __init__(self, roster: Roster, counters: Counters, faults: FaultReporter) -> None:
        self._roster, self._counters, self._faults = roster, counters, faults
        self.sessions: list[Session] = []
        self.fast = 0
        """Number of sessions on the fast path (`server.game.fast_path`)."""
        self._others: dict[Session, None] = {}
        """Sessions that are not on it."""
        self._opened = 0

    @property
    def all_fast(self) -> bool:
        """Whether all sessions are on the fast path, so that each of them plays and has nothing special to do."""
        return self.fast == len(self.sessions)

    @property
    def mostly_fast(self) -> bool:
        """Whether most sessions are on the fast path, so that it pays to look at the others alone."""
        return 2 * self.fast > len(self.sessions)

    @property
    def others(self) -> list[Session]:
        """The sessions that are not on the fast path, in the order in which they opened. A copy."""
        if len(self._others) < 2:
            return [*self._others]
        if self.mostly_fast:
            return sorted(self._others, key=_number)
        return [session for session in self.sessions if session.row < 0]

    def open(self, link: Transport, now: float) -> Session:
        """Adds a new connection and returns its session."""
        session = Session(link, now)
        self._opened += 1
        session.number = self._opened
        self.sessions.append(session)
        self._others[session] = None
        return session

    def enrol(self, session: Session) -> None:
        """Notes that a session has come to the fast path."""
        self.fast += 1
        del self._others[session]

    def withdraw(self, session: Session) -> None:
        """Notes that a session has left the fast path."""
        self.fast -= 1
        self._others[session] = None

    def lost(self, session: Session, now: float) -> None:
        """Removes a session whose connection is gone. Its player may reconnect."""
        session.recall()
        session.closed = True
        if session in self._others:
            del self._others[session]
            self.sessions.remove(session)
        self._roster.lost(session, now)

    def leave(self, session: Session) -> None:
        """Closes the connection of a client that has said goodbye. Its player leaves."""
        self._roster.dismiss(session)
        session.close(messages.GOING_AWAY, "goodbye")

    def refuse(self, session: Session, code: int, reason: str) -> None:
        """Closes the connection of a client that may not join."""
        self._counters.refused += 1
        self.end(session, code, reason)

    def kick(self, session: Session, code: int, reason: str) -> None:
        """Closes the connection of a client that has broken a rule. Its player may not reconnect."""
        self._counters.kicked += 1
        if code != messages.TOO_SLOW:  # slowness is the network's fault: the player may reconnect
            self._roster.dismiss(session)
        self.end(session, code, reason)

    def remove(self, player: Player, code: int, reason: str) -> None:
        """Makes a player leave in the next tick, and closes its connection with a code and a reason."""
        if player.session is not None and not player.session.closed:
            self.kick(player.session, code, reason)
        player.session, player.reconnect_until = None, -math.inf

    def fail(self, session: Session, what: str) -> None:
        """Handles an exception in our own code that affects one client: closes its connection, and the tick goes on.

        The player may reconnect.

        Args:
            session: the client's session.
            what: what the exception interrupted, for the log.
        """
        self._faults.report(what)
        try:
            session.close(messages.INTERNAL, "internal error")
        except Exception:
            self._faults.report("closing a link")
        self.lost(session, session.received_at)

    def end(self, session: Session, code: int, reason: str, wait: float = -1.0) -> None:
        """Sends a Bye and closes the connection.

        Args:
            session: the client's session.
            code: the close code.
            reason: the reason, sent to the client.
            wait: seconds after which the client should reconnect; negative: the client is not asked to.
        """
        reason = reason.encode(errors="replace").decode()[: fields.REASON_MAX]
        self._counters.closed[code] = self._counters.closed.get(code, 0) + 1
        try:
            session.send(encode(Bye(code, reason, wait)))
            session.close(code, reason)
        except Exception:
            self.fail(session, "saying goodbye")

    def send_away(self, player: Player, go: Go) -> None:
        """Sends the client of a player to another world. The player leaves in the next tick."""
        session = player.session
        if session is not None and not session.closed:
            self._roster.dismiss(session)
            try:
                session.send(encode(go))
                session.close(1000, "")
            except Exception:
                self.fail(session, "sending a client away")
        player.session, player.reconnect_until = None, -math.inf

    def shut_down(self, reason: str, wait: float, code: int = messages.GOING_AWAY) -> None:
        """Ends all connections. Arguments as for `end`."""
        for session in tuple(self.sessions):
            if not session.closed:
                self.end(session, code, reason, wait)


def _number(session: Session) -> int:
    """Returns the number of a session, by which sessions are sorted."""
    return session.number
