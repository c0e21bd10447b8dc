"""A player: a participant with an entity, who stays while connections are lost and replaced."""

import math
from collections import deque
from typing import TYPE_CHECKING, Any

from server.players.input_queue import InputQueue
from server.players.outbox import Outbox
from shared.inputs import Input
from shared.messages import Command

if TYPE_CHECKING:
    from server.game.session import Session

SUBJECT_MAX = 64
"""Maximum length of the subject of a token, in characters."""
SETTLED_MAX = 128
"""Maximum number of verdicts kept for one player, in case that its client lost the connection before it got them."""


class Player:
    """A participant of the game. The player exists as long as its entity, also without a connection.

    Args:
        entity: number of the player's entity.
        name: the name that the client gave.
        subject: the subject of the client's token; empty if the server does not authenticate.
        inputs: input queue of the player; None: one for the default tick rate, in a scene without aim.
    """

    def __init__(self, entity: int, name: str = "", subject: str = "", inputs: InputQueue | None = None) -> None:
        self.entity = entity
        self.row = -1
        """Number of the row of the player's session on the fast path (`server.game.fast_path`); -1: none."""
        self.name = name
        self.subject = subject
        self.announced = True
        """Whether `on_join` has been called for the player."""
        self.loaded: Any = None
        """Result of `Rules.load_player`; not saved."""
        self.handed: Any = None
        """Data that the rules of another world handed over with the player (`GameApi.send_away`); not saved."""
        self._inputs = inputs or InputQueue()
        self.commands: deque[Command] = deque()
        """Commands that wait for their tick."""
        self.command = -1
        """Highest number of a command so far."""
        self._verdicts: list[tuple[int, int]] = []
        self.settled: dict[int, int] = {}
        """Latest verdicts by the number of the command. A client that lost its connection before it received a verdict
        sends the command again and gets the same verdict."""
        self.reasons: dict[int, str] = {}
        """Reasons of the refusals among `settled` for which the rules gave one."""
        self.edits_left, self.edits_tick = math.inf, 0
        """Number of edits that the player could do in a tick, and that tick. It grows with time up to a limit."""
        self.tokens: list[bytes] = []
        """Digests of the valid resume tokens: the newest one, and the one before until the client has the newest."""
        self.reconnect_until = math.inf
        """Time in seconds at which a player without a connection leaves."""
        self.session: Session | None = None
        """Present connection; None: the connection is lost."""
        self._outbox = Outbox()

    def __repr__(self) -> str:
        return f"<Player {self.name!r}, entity {self.entity}>"

    @property
    def inputs(self) -> InputQueue:
        """Input queue of the player."""
        self.recall()
        return self._inputs

    @inputs.setter
    def inputs(self, inputs: InputQueue) -> None:
        self.recall()
        self._inputs = inputs

    @property
    def counts(self) -> InputQueue:
        """The input queue, for its counts alone; reading it does not recall the session."""
        return self._inputs

    @property
    def verdicts(self) -> list[tuple[int, int]]:
        """Numbers and verdicts of commands, to be sent."""
        self.recall()
        return self._verdicts

    @property
    def outbox(self) -> Outbox:
        """Game events that wait to be sent."""
        self.recall()
        return self._outbox

    def coming(self, tick: int) -> Input:
        """Returns the input that would be taken for a tick now. Changes nothing."""
        if self.row >= 0 and self.session is not None and self.session.fast_path is not None:
            return self.session.fast_path.coming(self.row, tick)
        return self._inputs.coming(tick)

    def recall(self) -> None:
        """Takes the player's session off the fast path, where its client would get no verdicts and events."""
        if self.row >= 0 and self.session is not None:
            self.session.recall()

    def drop_older_tokens(self) -> None:
        """Invalidates all resume tokens but the newest one, which the client has now."""
        del self.tokens[:-1]

    def settle(self, number: int, verdict: int, reason: str = "") -> None:
        """Queues the verdict of a command to be sent, and keeps it in case that the client asks again.

        Args:
            number: number of the command.
            verdict: its verdict.
            reason: the reason that the rules gave for a refusal; empty: none.
        """
        self.verdicts.append((number, verdict))
        self.settled[number] = verdict
        self.command = max(self.command, number)  # also of a player who was restored from notes, or of a replica
        if reason:
            self.reasons[number] = reason
        if len(self.settled) > SETTLED_MAX:
            oldest = next(iter(self.settled))
            del self.settled[oldest]
            self.reasons.pop(oldest, None)
