"""The clients of the edges, as the sequencer sees them: sessions without a connection, seated by requests."""

from typing import Any

from server.game.joining import Joining
from server.game.roster import Roster
from server.game.session import Session
from server.players.input_queue import InputQueue
from server.players.player import Player
from shared import messages
from shared.bounds import Bounds
from shared.inputs import NEUTRAL, Input


class RemoteLink:
    """The link of a client of an edge. What is sent is dropped: the edge sends by itself. An end is reported to it.

    Args:
        edge, client: the edge, and its number of the client.
        token: digest of the resume token that the edge gives the client; empty: it was taken over with its player.
        ended: where an end is reported (`Record.ended`).
    """

    def __init__(self, edge: str, client: int, token: bytes, ended: list[Any]) -> None:
        self.edge, self.client, self.token, self._ended = edge, client, token, ended

    def send(self, message: bytes) -> None:
        pass

    def outstanding(self) -> int:
        return 0

    def close(self, code: int, reason: str) -> None:
        self._ended += (self.edge, self.client, code, reason)


class BatchInputs(InputQueue):
    """The input of a player as its edge sent it last. It is repeated while batches are missing."""

    def __init__(self, bounds: Bounds) -> None:
        super().__init__(bounds)
        self.latest: Input = NEUTRAL
        self.missing = 0
        """Ticks since the edge's newest batch."""

    def coming(self, tick: int) -> Input:
        if self.override is not None:
            return self.override
        return self.latest if self._bounds.stands_in(self.missing) else NEUTRAL

    def take(self, tick: int) -> Input:
        if self.missing:
            self._substituted += 1
        else:
            self._used += 1
            if self.override is None:
                return self.latest
        return self.coming(tick)


class RemoteRoster(Roster):
    """A roster whose tokens are digests: the edges make the tokens."""

    def _queue(self) -> InputQueue:
        return BatchInputs(self._bounds)

    def _digest(self, token: bytes) -> bytes:
        return token

    def lost(self, session: Session, now: float) -> None:
        super().lost(session, now)
        player, link = session.player, session.link
        if player is not None and player.session is None and isinstance(link, RemoteLink) and not link.token:
            player.reconnect_until = now + self._limits.resume_s  # taken over; the log does not say what it has seen

    def issue(self, player: Player) -> bytes:
        assert player.session is not None
        assert isinstance(player.session.link, RemoteLink)
        self.grant(player, player.session.link.token)
        return b""


class RemoteJoining(Joining):
    """The joins of clients of the edges. They get their welcomes from their edges."""

    seated: list[Any]
    """Clients that have joined (`Record.seated`)."""

    def _admit(self, session: Session, player: Player) -> None:
        assert isinstance(session.link, RemoteLink)
        self._roster.issue(player)
        self.seated += (session.link.edge, session.link.client, player.entity, False)

    def seat_beside(self, session: Session, resume: bytes) -> bool:
        """Lets a client prepare a change to another edge. Returns whether its player was found.

        The resume token stays valid: the client gets no new one, because it may never see the second welcome.

        Args:
            session: its second session.
            resume: digest of its resume token.
        """
        assert isinstance(session.link, RemoteLink)
        players = self._roster.players.values() if resume else ()
        player = next((each for each in players if resume in each.tokens and each.subject == session.subject), None)
        home = None if player is None or player.session is None else player.session.link
        if player is None or not isinstance(home, RemoteLink) or home.edge == session.link.edge:
            self._connections.refuse(session, messages.GOING_AWAY, "there is no player who can change over")
            return False
        session.player = player
        self.seated += (session.link.edge, session.link.client, player.entity, True)
        return True
