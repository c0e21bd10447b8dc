"""The clients of an edge that go on at other edges, and the list of edges that an edge tells its clients.

Theory of operation. The log has the address of each edge that takes clients. Each client gets those of the other edges
(`Edges`), so that it can go on at one of them when its connection is lost. An edge that is about to stop, or has too
much to do, asks clients to go on at another edge (`HandOver`), the one with the fewest players. A client that is still
here after `HANDOVER_S` seconds is closed if the edge is about to stop; it then reconnects elsewhere.
"""

from collections import Counter
from collections.abc import Iterable

from server.game.connections import Connections
from server.game.session import Session
from server.scale.replica import Replica
from shared import fields, messages
from shared.checks import SceneError, shown
from shared.messages import Edges, HandOver, encode

HANDOVER_S = 10.0
"""Seconds in which a client may go on elsewhere after it was asked to."""
DRAINED_PER_S = 64.0
"""Number of clients per second that an edge asks to go on elsewhere before it stops."""
STOPPING = "this server is about to stop"
"""Reason for clients of an edge that drains."""


class Moves:
    """The moves of the clients of one edge.

    Args:
        name: name of the edge.
        address: address of the edge for clients, as in ws://HOST:PORT; empty: the others do not know the edge.
        replica: the replica of the world.
        connections: the sessions of the edge.
    """

    def __init__(self, name: str, address: str, replica: Replica, connections: Connections) -> None:
        if address and not fields.address(address):
            raise SceneError(f"address = {shown(address)}: must be like ws://HOST:PORT")
        self._name, self._address, self._replica, self._connections = name, address, replica, connections
        self.draining = False
        """Whether the edge is about to stop."""
        self.asked = 0
        """Number of clients that were asked to go on elsewhere so far."""
        self._asked: dict[Session, float] = {}
        """Times in seconds at which clients were asked to go on elsewhere."""
        self._told: list[str] = []
        self._allowance = 0.0

    @property
    def others(self) -> list[str]:
        """Addresses of the other edges, first the one with the fewest players."""
        return [address for _, address in sorted(self._loads())]

    @property
    def request(self) -> str | None:
        """The address to report to the sequencer; None: it knows."""
        address = "" if self.draining else self._address
        return None if self._replica.edges.get(self._name, "") == address else address

    def tell(self, sessions: Iterable[Session]) -> None:
        """Sends the clients the other edges if these have changed."""
        edges = self._replica.edges
        told = sorted(edges[name] for name in edges if name != self._name)
        if told != self._told:
            self._told = told
            message = self.message()
            for session in [session for session in sessions if session.entity and session.greeting is None]:
                session.send(message)

    def message(self) -> bytes:
        """Returns the message with the addresses of the other edges."""
        return encode(Edges(self.others[: fields.EDGES_MAX]))

    def refuse(self, session: Session) -> None:
        """Sends a client that wants to join to another edge."""
        session.send(self.message())
        self._connections.end(session, messages.GOING_AWAY, STOPPING, 0.0)

    def shed(self, number: int, reason: str, now: float) -> int:
        """Asks clients to go on at other edges. Returns the number of clients that were asked.

        Args:
            number: maximum number of clients.
            reason: the reason, sent to the clients.
            now: the current time in seconds.
        """
        loads = self._loads()
        if not loads:
            return 0
        here = [session for session in self._connections.sessions if self._plays(session)]
        for session in here[:number]:
            loads.sort()
            players, address = loads[0]
            loads[0] = (players + 1, address)
            self.ask(session, address, reason, now)
        return len(here[:number])

    def ask(self, session: Session, address: str, reason: str, now: float) -> bool:
        """Asks a client to go on at another edge. Returns whether it plays here and can do so.

        Args:
            session: the client's session.
            address: address of the other edge.
            reason: the reason, sent to the client.
            now: the current time in seconds.
        """
        if not self._plays(session):
            return False
        self._asked[session] = now
        self.asked += 1
        session.send(encode(HandOver(address, reason)))
        return True

    def check(self, now: float, tick_s: float) -> None:
        """Asks the next clients of an edge that drains, and closes those that have not gone on elsewhere in time."""
        if self.draining:
            self._allowance = min(self._allowance + DRAINED_PER_S * tick_s, DRAINED_PER_S)
            self._allowance -= self.shed(int(self._allowance), STOPPING, now)
        for session, asked in list(self._asked.items()):
            if session.closed or now - asked >= HANDOVER_S:
                del self._asked[session]
                if self.draining and not session.closed:
                    self._connections.end(session, messages.GOING_AWAY, STOPPING, 0.0)

    def _plays(self, session: Session) -> bool:
        """Returns whether a client plays over a session, and was not asked to go on elsewhere."""
        playing = session.entity > 0 and session.greeting is None and not (session.beside or session.closed)
        return playing and session not in self._asked

    def _loads(self) -> list[tuple[int, str]]:
        """Returns the number of players and the address of each other edge."""
        players = Counter(edge for edge, _ in self._replica.homes.values())
        return [(players[name], address) for name, address in self._replica.edges.items() if name != self._name]
