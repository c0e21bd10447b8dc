"""The lobby: connections of clients that ask for a world. A client says hello, waits, and is sent to its world.

    /match?kind=arena&mode=2v2&seats=2    find a world with these properties, or make one
    /create?kind=arena&private=1          make a world
    /join?code=K7F3QD                     find a private world

`server.worlds.matchmaking` answers each client; the connection then closes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol
from urllib.parse import parse_qsl

import msgpack

from server.auth.identity import identified
from server.bucket import Bucket
from server.config.limits import Limits
from server.game.joining import other_version
from server.game.loading import Runner, not_loaded
from server.observability.errors import FaultReporter
from server.players.ticket import Ticket
from server.replication.client_stream import Transport
from server.worlds.kinds import Kind, WorldsError, checked_properties
from shared import fields, messages
from shared.messages import Bye, Go, Hello, Ping, ProtocolError, Waiting, decode_from_client, encode

MESSAGES_PER_S, MESSAGES_BURST = 20.0, 40.0
"""Messages that a client may send per second, and at once."""
TELL_S = 2.0
"""Seconds between two messages with progress; a client that hears nothing for 10 s gives the connection up."""
VERBS = ("match", "create", "join")
"""Paths of lobby connections."""


class Request:
    """The request of a client for a world.

    Args:
        verb: "match", "create" or "join".
        query: the query of its path.

    Raises:
        WorldsError: the query is not valid.
    """

    def __init__(self, verb: str, query: str) -> None:
        try:
            given = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query), max_num_fields=24)
        except ValueError:
            raise WorldsError(f"the query {query[:100]!r} is not valid") from None
        values = dict(given)
        if len(values) < len(given):
            raise WorldsError("the query has a field twice")
        self.verb, self.query = verb, query
        self.here = values.pop("here", "") != ""
        """Whether another process of the fleet has sent the client here to be matched."""
        self.kind, self.code = values.pop("kind", ""), values.pop("code", "").upper()
        self.private = values.pop("private", "0") in ("1", "true")
        seats = values.pop("seats", "1")
        if not (seats.isascii() and seats.isdecimal() and len(seats) < 3 and 1 <= int(seats) <= fields.SEATS_MAX):
            raise WorldsError(f"seats = {seats[:20]!r}: must be a whole number from 1 to {fields.SEATS_MAX}")
        self.seats = int(seats)
        self.properties = checked_properties(values)


class LobbySession:
    """The connection of a client that asks for a world.

    Args:
        link: the connection.
        request: what the client asks for.
        now: time in seconds at which the connection opened.
    """

    def __init__(self, link: Transport, request: Request, now: float) -> None:
        self.link, self.request = link, request
        self.opened = self.told_at = now
        self.ticket: Ticket | None = None
        """The client's ticket; None: it has not said hello yet, or its data are being loaded."""
        self.greeted = self.closed = False
        self.messages, self.received_at = Bucket(MESSAGES_PER_S, MESSAGES_BURST), now
        self.reached_at = now
        """Time in seconds at which the client was seen to have everything that was sent."""


class Matchmaker(Protocol):
    """The matchmaking that answers the clients of a lobby."""

    def kind(self, name: str) -> Kind:
        """Returns a kind. Raises `WorldsError`: there is none of that name."""
        ...

    def ask(self, session: LobbySession, now: float) -> None:
        """Takes the ticket of a client: answers it now or later."""

    def gone(self, session: LobbySession) -> None:
        """Takes the end of a lobby connection."""


class Lobby:
    """All lobby connections of a server.

    Args:
        matchmaker: answers the clients.
        limits: the limits.
        authenticate: returns the subject of a token, as for `Game`; None: anyone may play.
        faults: where exceptions in our own code are reported.
        run: runs `Rules.load_player`.
    """

    def __init__(
        self,
        matchmaker: Matchmaker,
        limits: Limits,
        authenticate: Callable[[str], str] | None,
        faults: FaultReporter,
        run: Runner,
    ) -> None:
        self.sessions: dict[LobbySession, None] = {}  # in the order in which they opened
        self.run = run
        self._matchmaker, self._limits = matchmaker, limits
        self._authenticate, self._faults = authenticate, faults

    def open(self, link: Transport, request: Request, now: float) -> LobbySession:
        """Adds a new connection and returns its session."""
        session = LobbySession(link, request, now)
        self.sessions[session] = None
        return session

    def receive(self, session: LobbySession, data: bytes, now: float) -> None:
        """Takes one message of a client: a Hello, and pings."""
        if session.closed:
            return
        session.received_at = now
        if not session.messages.take(now):
            self.refuse(session, messages.MALFORMED, "too many messages")
            return
        try:
            message = decode_from_client(data)
        except ProtocolError as error:
            self.refuse(session, messages.MALFORMED, str(error))
            return
        if isinstance(message, Hello) and not session.greeted:
            session.greeted = True
            self._hello(session, message, now)
        elif isinstance(message, Bye):
            self._close(session, messages.GOING_AWAY, "goodbye")
        elif not isinstance(message, Ping):
            self.refuse(session, messages.MALFORMED, f"unexpected {type(message).__name__} in the lobby")

    def lost(self, session: LobbySession, now: float) -> None:
        """Removes a session whose connection is gone."""
        session.closed = True
        self.sessions.pop(session, None)
        self._matchmaker.gone(session)

    def tick(self, now: float) -> None:
        """Closes connections without a hello or to clients that are gone, and tells the others how it goes."""
        for session in tuple(self.sessions):
            if not session.link.outstanding():
                session.reached_at = now
            elif now - session.reached_at > self._limits.silence_s:
                self.refuse(session, messages.TOO_SLOW, f"nothing reached the client for {self._limits.silence_s:g} s")
            if not session.greeted and now - session.opened > self._limits.hello_s:
                self.refuse(session, messages.NO_HELLO, f"no hello within {self._limits.hello_s:g} s")
            elif session.greeted and now - session.told_at >= TELL_S and not session.closed:
                self.tell(session, {}, now)

    def tell(self, session: LobbySession, progress: dict[str, Any], now: float) -> None:
        """Tells a client how its waiting goes."""
        session.told_at = now
        session.link.send(encode(Waiting(msgpack.packb(progress))))

    def send_on(self, session: LobbySession, go: Go) -> None:
        """Sends a client to a world, and closes its connection."""
        session.link.send(encode(go))
        self._close(session, 1000, "")

    def refuse(self, session: LobbySession, code: int, reason: str, wait: float = -1.0) -> None:
        """Closes a connection with a code and a reason. The client may come back after `wait` seconds; -1: never."""
        reason = reason.encode(errors="replace").decode()[: fields.REASON_MAX]
        session.link.send(encode(Bye(code, reason, wait)))
        self._close(session, code, reason)

    def shut_down(self, reason: str, wait: float) -> None:
        """Closes all connections, because the server goes down."""
        for session in tuple(self.sessions):
            session.link.send(encode(Bye(messages.GOING_AWAY, reason, wait)))
            self._close(session, messages.GOING_AWAY, reason)

    def _close(self, session: LobbySession, code: int, reason: str) -> None:
        if not session.closed:
            session.closed = True
            session.link.close(code, reason)

    def _hello(self, session: LobbySession, hello: Hello, now: float) -> None:
        if hello.version != messages.VERSION:
            self.refuse(session, messages.WRONG_VERSION, other_version(hello))
            return
        if len(hello.name) > self._limits.name_max:
            self.refuse(session, messages.MALFORMED, f"a name longer than {self._limits.name_max} characters")
            return
        try:
            subject = identified(self._authenticate, hello.token, self._faults)
        except ValueError as error:
            self.refuse(session, messages.UNAUTHORISED, str(error))
            return
        except Exception:
            self._faults.report("authenticating a client")
            self.refuse(session, messages.INTERNAL, "internal error")
            return
        request = session.request
        ticket = Ticket(hello.name, subject, request.properties, request.seats, now)
        try:
            kind = self._matchmaker.kind(request.kind) if request.verb == "match" else None
        except WorldsError as error:
            self.refuse(session, messages.NOT_ADMITTED, str(error))
            return
        if kind is None or kind.pair is None:
            session.ticket = ticket
            self._matchmaker.ask(session, now)
            return
        self.run(kind.rules().load_player(hello.name, subject), partial(self._loaded, session, ticket))

    def _loaded(self, session: LobbySession, ticket: Ticket, result: Any, error: BaseException | None) -> None:
        """Takes the result of `load_player`, and lets the client wait for a match."""
        if session.closed:
            return
        if error is None:
            ticket.loaded, session.ticket = result, ticket
            self._matchmaker.ask(session, session.received_at)
            return
        self.refuse(session, *not_loaded(error, self._faults))
