"""The clients that wait for a world of one kind."""

from collections.abc import Iterable, Iterator

from server.observability.errors import FaultReporter
from server.players.ticket import Property, Ticket
from server.worlds.kinds import Kind
from server.worlds.lobby import TELL_S, Lobby, LobbySession

PAIR_S = 1.0
"""Seconds between two calls of `Rules.pair`, unless somebody has come since."""
PAIR_SOON_S = 0.1
"""Seconds between two calls of `Rules.pair` if somebody has come since."""
FULL_S = 1.0
"""Seconds after which clients that found no world are looked at again, unless somebody has come since."""
MISSES_MAX = 32
"""Maximum number of different requests without a world in one pass."""


class Queue:
    """The clients that wait for a world of one kind.

    Args:
        kind: the kind.
        faults: where a `Rules.pair` that raises is reported.
    """

    def __init__(self, kind: Kind, faults: FaultReporter) -> None:
        self._kind, self._faults = kind, faults
        self._waiting: dict[LobbySession, None] = {}
        self._new = False
        self._misses: set[tuple[int, frozenset[tuple[str, Property]]]] = set()
        self._paired_at = self._full_at = float("-inf")

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, session: LobbySession) -> None:
        """Adds a client with its ticket."""
        self._waiting[session] = None
        self._new = True

    def drop(self, session: LobbySession) -> None:
        """Removes a client, if it is there."""
        self._waiting.pop(session, None)

    def wait(self, group: list[LobbySession]) -> None:
        """Takes note that there is no world for a group now."""
        self._misses.add(_wish(group[0]))

    def groups(self, now: float) -> Iterator[list[LobbySession]]:
        """Yields the groups that play together now: those that `Rules.pair` forms, or each client by itself.

        A client whose wish is that of one for whom there was no world (`wait`) is left out.
        """
        self._misses.clear()
        if self._kind.pair is not None:
            yield from self._paired(now)
            return
        if now - self._full_at < FULL_S and not self._new:
            return
        self._new = False
        for session in tuple(self._waiting):
            if _wish(session) not in self._misses:
                yield [session]
            if len(self._misses) >= MISSES_MAX:
                break
        if self._misses:
            self._full_at = now

    def tell(self, lobby: Lobby, now: float) -> None:
        """Tells those who wait, every `TELL_S` seconds, how it goes."""
        count = len(self._waiting)
        for place, session in enumerate(self._waiting, 1):
            if now - session.told_at >= TELL_S:
                assert session.ticket is not None
                waited_s = round(now - session.ticket.since, 1)
                lobby.tell(session, {"waiting": count, "position": place, "waited_s": waited_s}, now)

    def _paired(self, now: float) -> list[list[LobbySession]]:
        """Returns the groups of the kind's `pair`; none if it is not time for it, or if its result is not valid."""
        if now - self._paired_at < (PAIR_SOON_S if self._new else PAIR_S):
            return []
        self._paired_at, self._new = now, False
        sessions: dict[Ticket, LobbySession] = {}
        for session in self._waiting:
            assert session.ticket is not None
            session.ticket.waited_s = now - session.ticket.since
            sessions[session.ticket] = session
        assert self._kind.pair is not None
        try:
            return self._checked(self._kind.pair(list(sessions)), sessions)
        except Exception:
            self._faults.report(f"pair of the kind {self._kind.name}")
            return []

    def _checked(
        self, groups: Iterable[Iterable[Ticket]], sessions: dict[Ticket, LobbySession]
    ) -> list[list[LobbySession]]:
        """Returns the sessions of groups of tickets.

        Raises:
            ValueError: a group has a ticket that does not wait or is in two groups, is empty, or is too large.
        """
        found = []
        for group in groups:
            tickets = list(group)
            if not tickets or any(ticket not in sessions for ticket in tickets):
                raise ValueError(f"pair returned {tickets}: must be groups of waiting tickets, each in one group")
            if sum(ticket.seats for ticket in tickets) > self._kind.players_max:
                raise ValueError(f"pair returned {tickets}: more seats than a world has ({self._kind.players_max})")
            found.append([sessions.pop(ticket) for ticket in tickets])
        return found


def _wish(session: LobbySession) -> tuple[int, frozenset[tuple[str, Property]]]:
    """Returns the number of seats and the properties that a client wants."""
    return session.request.seats, frozenset(session.request.properties.items())
