"""The way of a client from world to world on one server: where it connects next, and how often.

Theory of operation. A server names another path by `Go`. The client then ends its connection (`leaving`), and connects
to that path as a new player as soon as the end of the old connection is known. The transport keeps host and port,
unless the `Go` names another server. The servers that `Edges` names have the same world, or know the way to it: after a
lost connection, the client tries them in turn. If one of these answers with a `Go`, the world is at another server by
now: the client goes on there with its resume token (`redirect`). Any other `Go` ahead of a welcome came from a lobby.
If the world that a lobby named does not take the client, the client asks the lobby again. If a world has sent the
client away and the connection breaks on the way, it tries the new path again, the last time without the seat. All of
these are bounded, and so is the number of worlds without play in between.
"""

import math

from client_sdk.events import Matched, Moved, Waiting
from shared import fields, messages, payloads
from shared.messages import Bye, Go, ProtocolError

FINAL = (messages.WRONG_VERSION, messages.WRONG_SCENE, messages.MALFORMED, messages.UNAUTHORISED, messages.KICKED)
"""Close codes after which a client does not ask a lobby for another world: that would not take it, either."""
LOBBIES = ("match", "create", "join", "worlds")
"""First parts of paths that are no names of worlds."""
ATTEMPTS_MAX = 3
"""Number of further attempts if the new path does not take the client."""
AGAIN_S = 0.25
"""Wait before the first further attempt, in seconds; it doubles with each."""
LOOP_S_MAX = 2.0
"""Longest wait before a redirect is followed, in seconds."""
WAIT_S_MAX = 10.0
"""Longest wait that a server may ask for before a further attempt, in seconds. Beyond it, the client leaves."""
REDIRECTS_MAX = 64
"""Limit of the redirects of a client that reconnects; all but the first two in a row wait."""
WORLDS_MAX = 8
"""Limit of the worlds that a client is sent to without `PLAYED_S` seconds of play in between."""
PLAYED_S = 1.0
"""Time of play after which the worlds are counted anew, in seconds."""


class Travel:
    """The path of the client's world, and the attempts to get there."""

    def __init__(self) -> None:
        self.path = ""
        """The path and query of the next connection; empty: those of the transport's address."""
        self.server = ""
        """Address of the server of the next connection; empty: that of the transport's address."""
        self.edges: list[str] = []
        """Addresses of other servers of the same world, or of servers that know the way to it."""
        self.fronts = False
        """Whether they only know the way to it; a lobby has named them."""
        self._sent_to = ""
        """Address of the server that a `Go` has named latest; empty: that of the transport's address."""
        self._tried = self._redirects = 0
        self.fresh = False
        """Whether the next connection leads to one of `edges` that was not tried since the client played last."""
        self.code = ""
        """The code of the world if it is a private one."""
        self.seats: tuple[str, ...] = ()
        """The paths of the seats that were reserved for others."""
        self.sent = False
        """Whether a `Go` has led to the world."""
        self.leaving = False
        """Whether the old connection is being closed, because the next one leads elsewhere."""
        self._wait_s = 0.0
        self._arriving = False
        """Whether a `Go` led here, and no welcome has come yet."""
        self._lobby = ""
        """The path of the lobby that has sent the client on; empty: none has."""
        self._failed = 0
        self._worlds = 0
        self._playing_since = math.inf

    @property
    def world(self) -> str:
        """The name of the world; empty in the default world, and in a lobby."""
        name = self.path.partition("?")[0].strip("/")
        return "" if name in LOBBIES else name

    def go(self, go: Go, now: float, *, lobby: bool) -> Matched | Moved | None:
        """Takes the path of another world. Returns the event for the program.

        The result is None if the path leads to another lobby, or to the server of the world that the client wants.

        Args:
            go: the server's message.
            now: local time in seconds.
            lobby: whether the connection has had no welcome yet.

        Raises:
            ProtocolError: the client was sent to too many worlds without play in between.
        """
        if now - self._playing_since >= PLAYED_S:
            self._worlds = 0
        self._playing_since = math.inf
        self._worlds += 1
        if self._worlds > WORLDS_MAX:
            raise ProtocolError(
                f"Go.path = {go.path!r}: world {self._worlds} in a row with less than {PLAYED_S:g} s of play"
            )
        if lobby:
            self._lobby = self._lobby or self.server + self.path
        else:
            self._lobby, self._failed = "", 0
        same = lobby and self.here(go)
        server, self.path = fields.split_place(go.path)
        self.server = self._sent_to = server or self.server
        if not lobby:
            self.edges = []
        if not same:
            self.code, self.seats = go.code, tuple(go.seats)
        self.sent = self.leaving = self._arriving = True
        self._wait_s = 0.0
        if same or (lobby and self.path.partition("?")[0].strip("/") in LOBBIES):
            return None
        return Matched(self.world, self.code, self.seats) if lobby else Moved(self.world, go.reason)

    def here(self, go: Go) -> bool:
        """Returns whether a message names the world that the client is in, maybe at another server."""
        return fields.split_place(go.path)[1].partition("?")[0] == self.path.partition("?")[0]

    def redirect(self, go: Go) -> None:
        """Takes the present server of a world, on the way back to it after a lost connection.

        Raises:
            ProtocolError: the client was redirected too often.
        """
        self._redirects += 1
        if self._redirects > REDIRECTS_MAX:
            raise ProtocolError(f"Go.path = {go.path!r}: redirected {self._redirects} times without play")
        server, self.path = fields.split_place(go.path)
        self.path = without_seat(self.path)
        self.server = self._sent_to = server or self.server
        self.leaving = True
        self._wait_s = 0.0 if self._redirects <= 2 else min(AGAIN_S * self._redirects, LOOP_S_MAX)

    def left(self) -> float:
        """Notes that the old connection has ended. Returns the wait before the next one, in seconds."""
        self.leaving = False
        return self._wait_s

    def again(self, bye: Bye | None = None, spread: int = 0) -> bool:
        """Takes the failure of the way to a world, before its welcome. Returns whether there is a further attempt.

        Args:
            bye: the refusal; None: there was no connection, or it was lost.
            spread: as for `elsewhere`.
        """
        if bye is not None and 0 <= bye.wait <= WAIT_S_MAX and self._tried < ATTEMPTS_MAX and self.elsewhere(spread):
            self.leaving, self._wait_s = True, bye.wait
            return True
        wait_s = max(bye.wait if bye else 0.0, AGAIN_S * 2**self._failed)
        final = bye is not None and (bye.code in FINAL or not self._lobby)
        if not self._arriving or final or self._failed >= ATTEMPTS_MAX or wait_s > WAIT_S_MAX:
            return False
        self._failed += 1
        if self._lobby:
            self.server, self.path = fields.split_place(self._lobby)
            self.code, self.seats, self._arriving = "", (), False
        elif self._failed == ATTEMPTS_MAX:  # the seat counts once, and a connection that broke off may have used it
            self.path = without_seat(self.path)
        self.leaving, self._wait_s = True, wait_s
        return True

    def welcomed(self) -> None:
        """Notes that a world has taken the client. From now on, the client reconnects without its seat."""
        self.path = without_seat(self.path)
        self._arriving, self._lobby, self._failed = False, "", 0

    def plays(self, now: float) -> None:
        """Notes that play has begun."""
        self._playing_since, self._tried, self._redirects, self.fresh = now, 0, 0, False

    def elsewhere(self, spread: int) -> bool:
        """Chooses the server of the next connection after a lost one. Returns whether there is another one.

        These are the other servers of the world in turn, or the one to which the client was sent, and then the one that
        the program has named.

        Args:
            spread: any whole number. Clients with different numbers begin with different servers.
        """
        self.fresh = self._tried < len(self.edges)
        edges = self.edges or ([self._sent_to] if self._sent_to else [])
        if not edges:
            return False
        at = self._tried % (len(edges) + 1)
        self.server = edges[(at + spread) % len(edges)] if at < len(edges) else ""
        self._tried += 1
        return True


def without_seat(path: str) -> str:
    """Returns a path whose query has no reserved seat."""
    name, _, query = path.partition("?")
    kept = "&".join(field for field in query.split("&") if field.partition("=")[0] != "seat")
    return f"{name}?{kept}" if kept else name


def progress(message: messages.Waiting) -> Waiting:
    """Returns the event for a message to a client that waits.

    Raises:
        ProtocolError: the message is malformed.
    """
    table = payloads.unpack_value(message.payload)
    if not isinstance(table, dict) or not all(type(name) is str for name in table):
        raise ProtocolError("Waiting.payload: must be a table of names")
    position, waiting, waited_s = (table.pop(name, 0) for name in ("position", "waiting", "waited_s"))
    for name, value in (("position", position), ("waiting", waiting)):
        if not fields.count(value):
            raise ProtocolError(f"Waiting.{name}: must be a whole number from 0 to {fields.COMMAND_MAX}")
    if type(waited_s) not in (int, float) or not 0 <= waited_s < math.inf:
        raise ProtocolError("Waiting.waited_s: must be a time in seconds")
    return Waiting(position, waiting, float(waited_s), table)
