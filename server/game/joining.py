"""The handshake of a client: its Hello is checked when it arrives, and answered by a Welcome in a tick."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

from server.auth.identity import identified
from server.config.limits import Limits
from server.game.commands import Commands
from server.game.connections import Connections
from server.game.loading import Runner, at_once, not_loaded
from server.game.roster import Roster
from server.game.session import Session
from server.journal.recorded_world import RecordedWorld
from server.observability.counters import Counters
from server.observability.errors import FaultReporter
from server.players.player import Player
from server.rules import Rules
from shared import messages
from shared.messages import Hello, Welcome, head_of, pack

WELCOME_HEAD = head_of(Welcome) + pack(messages.VERSION)
"""First bytes of each welcome of this version."""


class Door(Protocol):
    """The door of a world, which decides whether new players may join."""

    def refusal(self, session: Session) -> tuple[int, str] | None:
        """Returns the close code and the reason for which a new player may not join; None: the player may join."""
        ...


class Joining:
    """The handshakes of one game.

    Args:
        world: the world.
        limits: the limits.
        counters: where reconnects are counted.
        faults: where wrong results of `authenticate` are reported.
        connections: the sessions.
        roster: the players.
        commands: says up to which tick the world is durable.
        authenticate: returns the subject of a token, as for `Game`; None: anyone may play.
        rules: the rules, whose `load_player` is run before a join if they have one.
    """

    def __init__(
        self,
        world: RecordedWorld,
        limits: Limits,
        counters: Counters,
        faults: FaultReporter,
        connections: Connections,
        roster: Roster,
        commands: Commands,
        authenticate: Callable[[str], str] | None,
        rules: Rules,
    ) -> None:
        self._world, self._limits, self._counters, self._faults = world, limits, counters, faults
        self._connections, self._roster, self._commands = connections, roster, commands
        self._table = pack(world.scene.to_table())
        self.authenticate = authenticate
        self.run: Runner = at_once
        """Runner of `load_player`."""
        self.door: Door | None = None
        """Decides whether new players may join one of many worlds; None: it is the only one."""
        self._load = rules.load_player if type(rules).load_player is not Rules.load_player else None

    def hello(self, session: Session, hello: Hello, now: float) -> None:
        """Checks a Hello. Its client joins in one of the next ticks, or is refused now."""
        if hello.version != messages.VERSION:
            self._connections.refuse(session, messages.WRONG_VERSION, other_version(hello))
            return
        if hello.scene and (differ := _differing(self._world.scene.digests, hello.scene)):
            reason = f"the server plays another scene ({', '.join(name[:40] for name in differ)} differ)"
            self._connections.refuse(session, messages.WRONG_SCENE, reason)
            return
        if len(hello.name) > self._limits.name_max:
            reason = f"a name longer than {self._limits.name_max} characters"
            self._connections.refuse(session, messages.MALFORMED, reason)
            return
        if not self._authenticated(session, hello.token):
            return
        session.stream.flow.answered(now - session.opened, 0, now)  # a round trip with nothing on the way
        if hello.token:
            hello = hello._replace(token="")
        if self._load is None or self._roster.knows(hello.resume, session.subject):
            session.hello = hello
            return
        session.loading = True
        self.run(self._load(hello.name, session.subject), partial(self._loaded, session, hello))

    def _loaded(self, session: Session, hello: Hello, result: Any, error: BaseException | None) -> None:
        """Lets a client join whose data was loaded, or refuses it."""
        if session.closed:
            return
        session.loading = False
        if error is None:
            session.loaded, session.hello = result, hello
            return
        self._connections.refuse(session, *not_loaded(error, self._faults))

    def join(self, now: float) -> None:
        """Lets the clients that wait join, at most `Limits.joins_per_tick` of them. Call it before the step.

        Their time limits begin now: a client sends nothing while its player is loaded.
        """
        if self._connections.all_fast:
            return
        others = self._connections.others
        joining = [session for session in others if session.hello is not None and not session.closed]
        for session in joining[: self._limits.joins_per_tick]:
            session.received_at = session.stream.sent_at = now
            try:
                self._welcome(session)
            except Exception:
                self._connections.fail(session, "a join")

    def greet(self, session: Session, tick: int, welcome: bytes) -> bool:
        """Sends the welcome once the resume token in it is durable, or at once if nothing can be saved.

        Args:
            session: the client's session.
            tick, welcome: `Session.greeting`.

        Returns:
            Whether the welcome has been sent.
        """
        if self._commands.durable_tick < tick and not self._commands.trouble:
            return False
        session.send(welcome)
        session.greeting = None
        if session.beginning:
            session.send(session.beginning)
        return True

    def _authenticated(self, session: Session, token: str) -> bool:
        """Sets the subject of a session. Returns False if the client was refused."""
        try:
            session.subject = identified(self.authenticate, token, self._faults)
        except ValueError as error:
            self._connections.refuse(session, messages.UNAUTHORISED, str(error))
            return False
        except Exception:
            self._connections.fail(session, "authenticating a client")
            return False
        return True

    def _welcome(self, session: Session) -> None:
        """Seats a session at its player, a known or a new one, and prepares the welcome; or refuses the client."""
        assert session.hello is not None
        player, new = self._roster.find(session.hello.resume, session.subject) or self._roster.seated(session), False
        if player is not None:
            self._counters.resumed += 1
            player.outbox.reconnect()
            if player.session is not None and not player.session.closed:
                reason = "the player goes on over another connection"
                self._connections.end(player.session, messages.TAKEN_OVER, reason)
            session.seat(player)
        elif self.door is not None and (refusal := self.door.refusal(session)) is not None:
            self._connections.refuse(session, *refusal)
            return
        elif self._roster.full:
            reason = f"the server is full ({self._limits.clients_max} clients)"
            self._connections.refuse(session, messages.FULL, reason)
            return
        else:
            name, reason = self._roster.admit(session.hello.name, session.subject)
            if reason:
                self._connections.refuse(session, messages.NOT_ADMITTED, reason)
                return
            player, new = self._roster.enter(session, name, session.loaded), True
            if player is None:
                self._connections.refuse(session, messages.FULL, "no room to spawn")
                return
        try:
            self._admit(session, player)
        except Exception:
            if new:
                self._roster.expel(player)
            raise

    def _admit(self, session: Session, player: Player) -> None:
        """Prepares the welcome of a client that has joined."""
        token = self._roster.issue(player)
        welcome = join_welcome(self._world.tick, player.entity, self._table, token)
        session.stream.private_due = self._roster.private_of(player)
        session.greeting = (self._world.tick + 1, welcome)


def _differing(mine: Mapping[str, bytes], theirs: Mapping[str, bytes]) -> list[str]:
    """Returns the names of the parts of two scenes that differ, by their digests."""
    return sorted(name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name))


def other_version(hello: Hello) -> str:
    """Returns the reason for refusing a client that speaks another version of the protocol."""
    newer = "older" if hello.version < messages.VERSION else "newer"
    return f"the client is {newer}: protocol version {hello.version}, the server speaks {messages.VERSION}"


def join_welcome(tick: int, entity: int, scene: bytes, resume: bytes) -> bytes:
    """Returns an encoded `Welcome` of this version.

    Args:
        tick, entity, resume: fields of `Welcome`.
        scene: the field `scene`, packed already; all clients of a world share it.
    """
    return b"".join((WELCOME_HEAD, pack(tick), pack(entity), scene, pack(resume)))
